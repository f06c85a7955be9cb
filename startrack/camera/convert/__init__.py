"""Camera files of other programs, read and written in their own conventions.

All of them share our axes (x right, y down, z along the boresight) and our radial polynomial; none of them has
mirrored images, image circles, calibrated angles, sensors or covariances.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from startrack.camera import Camera
from startrack.camera.convert import colmap, kalibr, opencv, ros
from startrack.camera.convert.intrinsics import nearest_edge_rad
from startrack.core.types import BadInput

TITLES = {"ros": "ROS", "kalibr": "Kalibr", "colmap": "COLMAP", "opencv": "OpenCV"}
MAX_CAUSE_CHARS = 200  # of a parser's message
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


def from_text(text: str, program: str, name: str, calibrated_angle_rad: float | None = None) -> Camera:
    """The camera of the `text` of a file of `program`, called `name` unless the file names it.

    No such file states up to which angle off the axis [rad] the lens was calibrated: None takes the angle at the edge
    of the frame that is nearest to the centre. Raises BadInput bad_calibration.
    """
    try:
        camera = READERS[program](text, name)
        angle = nearest_edge_rad(camera) if calibrated_angle_rad is None else calibrated_angle_rad
        camera = replace(camera, calibrated_angle_rad=min(angle, camera.max_angle_rad))
    except BadInput as error:
        raise BadInput("bad_calibration", f"{_refusal(program)}: {error}") from error
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
        cause = f"{error} is missing" if isinstance(error, KeyError) else error
        cause_text = " ".join(str(cause)[:MAX_CAUSE_CHARS].split())
        raise BadInput("bad_calibration", f"{_refusal(program)}: {cause_text}") from error
    return camera


def _refusal(program: str) -> str:
    return f"not a camera file of {TITLES[program]} that can be used"
