"""ROS camera_info YAML (camera_calibration_parsers): equidistant for fisheyes, plumb_bob for pinholes.

Pixel (0, 0) is the centre of the first pixel, as here (REP 104, image_geometry, OpenCV).
"""

from __future__ import annotations

from startrack.camera import Camera
from startrack.camera.convert.intrinsics import (
    COEFFICIENTS,
    Plain,
    camera_from,
    centred,
    no_other_distortion,
    numbers,
    plain,
    unreadable,
)
from startrack.camera.convert.yaml_text import flow, parsed
from startrack.types import BadInput


def text(camera: Camera) -> str:
    """The camera_info file."""
    lens = plain(centred(camera))
    model, coefficients = ("plumb_bob", [0.0] * 5) if lens.k is None else ("equidistant", list(lens.k))
    (fx, fy), (cx, cy) = lens.focal_px, lens.centre_px
    return (
        f"image_width: {lens.size_px[0]}\nimage_height: {lens.size_px[1]}\ncamera_name: {camera.name}\n"
        f"camera_matrix:\n  rows: 3\n  cols: 3\n  data: {flow(lens.matrix)}\n"
        f"distortion_model: {model}\n"
        f"distortion_coefficients:\n  rows: 1\n  cols: {len(coefficients)}\n  data: {flow(coefficients)}\n"
        "rectification_matrix:\n  rows: 3\n  cols: 3\n  data: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]\n"
        "projection_matrix:\n  rows: 3\n  cols: 4\n"
        f"  data: {flow([fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0])}\n"
    )


def camera(text: str, name: str) -> Camera:
    """The camera of a camera_info file. Raises BadInput bad_calibration."""
    try:
        d = parsed(text)
        fx, skew, cx, _, fy, cy, *_ = numbers(d["camera_matrix"]["data"], 9, "camera_matrix")
        if skew:
            raise ValueError("a skewed camera_matrix has no counterpart")
        model = d["distortion_model"]
        given = [float(v) for v in d["distortion_coefficients"]["data"]]
        size = (int(d["image_width"]), int(d["image_height"]))
        if model in ("equidistant", "fisheye"):
            k: tuple[float, ...] | None = tuple(numbers(given, COEFFICIENTS, "distortion_coefficients"))
        elif model in ("plumb_bob", "rational_polynomial"):
            no_other_distortion(given, model)
            k = None
        else:
            raise ValueError(f"distortion_model {model!r} is not known")
        return camera_from(Plain(size, (fx, fy), (cx, cy), k), str(d.get("camera_name") or name))
    except BadInput:
        raise
    except (ValueError, KeyError, TypeError) as cause:
        raise unreadable("ROS", repr(cause)) from cause
