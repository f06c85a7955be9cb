"""Cameras: a lens (one file each, listed in `lenses.py`), a camera around it, and camera files."""

from startrack.camera.camera import Camera, Sensor
from startrack.camera.decentring import Decentring
from startrack.camera.io import camera_from_dict, camera_to_dict, save_camera
from startrack.camera.kannala_brandt import KannalaBrandt
from startrack.camera.lens import Lens
from startrack.camera.load import load_camera
from startrack.camera.pinhole import Pinhole

__all__ = [
    "Camera",
    "Decentring",
    "KannalaBrandt",
    "Lens",
    "Pinhole",
    "Sensor",
    "camera_from_dict",
    "camera_to_dict",
    "load_camera",
    "save_camera",
]
