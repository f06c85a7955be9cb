"""Cameras: lenses (listed in `lenses.py`), a camera around one, and camera files."""

from startrack.camera.camera import (
    MIN_THROUGHPUT_1,
    Camera,
    Decentring,
    Sensor,
    cap_grid,
    compensating_rotation,
    difference_px,
    lens_jacobian,
    projection_covariance_px2,
    with_covariance,
    with_update,
)
from startrack.camera.io import (
    REFRACTION_CONTAINED,
    REFRACTION_REMOVED,
    SENSOR,
    camera_from_dict,
    camera_from_foreign_text,
    camera_keys,
    camera_text,
    camera_to_dict,
    decentring_rms_px,
    foreign_text,
    load_camera,
    read_camera,
    read_foreign_camera,
    save_camera,
)
from startrack.camera.lens import Lens
from startrack.camera.lenses import KannalaBrandt, Pinhole, default_lens, lens_kinds
from startrack.camera.platepar import Platepar, platepar_of
from startrack.camera.virtualsky import VirtualSkyOverlay, virtualsky_of

__all__ = [
    "MIN_THROUGHPUT_1", "REFRACTION_CONTAINED", "REFRACTION_REMOVED", "SENSOR", "Camera", "Decentring", "KannalaBrandt",
    "Lens", "Pinhole", "Platepar", "Sensor", "VirtualSkyOverlay", "camera_from_dict", "camera_from_foreign_text",
    "camera_keys", "camera_text", "camera_to_dict", "cap_grid", "compensating_rotation", "decentring_rms_px",
    "default_lens", "difference_px", "foreign_text", "lens_jacobian", "lens_kinds", "load_camera", "platepar_of",
    "projection_covariance_px2", "read_camera", "read_foreign_camera", "save_camera", "virtualsky_of",
    "with_covariance", "with_update",
]  # fmt: skip
