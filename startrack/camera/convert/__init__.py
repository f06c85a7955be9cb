"""Camera files of other programs, read and written in their own conventions.

All of them share our axes (x right, y down, z along the boresight) and our radial polynomial; none of them has
mirrored images, image circles, calibrated angles, sensors or covariances.
"""

from __future__ import annotations

from collections.abc import Callable

from startrack.camera import Camera
from startrack.camera.convert import colmap, kalibr, opencv, ros
from startrack.types import BadInput

TITLES = {"ros": "ROS", "kalibr": "Kalibr", "colmap": "COLMAP", "opencv": "OpenCV"}
WRITERS: dict[str, Callable[[Camera], str]] = {
    "ros": ros.to_text,
    "kalibr": kalibr.to_text,
    "colmap": colmap.to_text,
    "opencv": opencv.to_text,
}
READERS: dict[str, Callable[[str, str], Camera]] = {
    "ros": ros.from_text,
    "kalibr": kalibr.from_text,
    "colmap": colmap.from_text,
    "opencv": opencv.from_text,
}


def to_text(camera: Camera, program: str) -> str:
    """The camera as text of a file of `program`. Raises BadInput bad_calibration if its format cannot hold the lens."""
    return WRITERS[program](camera)


def from_text(text: str, program: str, name: str) -> Camera:
    """The camera of the `text` of a file of `program`, called `name` unless the file names it.

    Raises BadInput bad_calibration.
    """
    try:
        return READERS[program](text, name)
    except (ValueError, KeyError, TypeError) as error:
        cause = f"{error} is missing" if isinstance(error, KeyError) else error
        text = f"not a camera file of {TITLES[program]} that can be used: {cause}"
        raise BadInput("bad_calibration", " ".join(text.split())) from error
