"""ROS camera_info YAML (camera_calibration_parsers): equidistant for fisheyes, plumb_bob for pinholes.

Pixel (0, 0) is the centre of the first pixel, as here (REP 104, image_geometry, OpenCV).
"""

from __future__ import annotations

from startrack.camera import Camera
from startrack.camera.convert.intrinsics import (
    FISHEYE_COEFFICIENTS,
    Intrinsics,
    camera_from_intrinsics,
    check_no_distortion,
    intrinsics_of,
    read_numbers,
    read_yaml,
    unreadable_file,
    without_decentring,
    yaml_list,
)
from startrack.types import BadInput


def to_text(camera: Camera) -> str:
    """The camera_info file."""
    lens = intrinsics_of(without_decentring(camera))
    model, coefficients = ("plumb_bob", [0.0] * 5) if lens.k is None else ("equidistant", list(lens.k))
    (fx, fy), (cx, cy) = lens.focal_px, lens.centre_px
    return (
        f"image_width: {lens.size_px[0]}\nimage_height: {lens.size_px[1]}\ncamera_name: {camera.name}\n"
        f"camera_matrix:\n  rows: 3\n  cols: 3\n  data: {yaml_list(lens.matrix)}\n"
        f"distortion_model: {model}\n"
        f"distortion_coefficients:\n  rows: 1\n  cols: {len(coefficients)}\n  data: {yaml_list(coefficients)}\n"
        "rectification_matrix:\n  rows: 3\n  cols: 3\n  data: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]\n"
        "projection_matrix:\n  rows: 3\n  cols: 4\n"
        f"  data: {yaml_list([fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0])}\n"
    )


def from_text(text: str, name: str) -> Camera:
    """The camera of a camera_info file. Raises BadInput bad_calibration."""
    try:
        d = read_yaml(text)
        fx, skew, cx, _, fy, cy, *_ = read_numbers(d["camera_matrix"]["data"], 9, "camera_matrix")
        if skew:
            raise ValueError("a skewed camera_matrix has no counterpart")
        model = d["distortion_model"]
        distortion = [float(v) for v in d["distortion_coefficients"]["data"]]
        size = (int(d["image_width"]), int(d["image_height"]))
        if model in ("equidistant", "fisheye"):
            k: tuple[float, ...] | None = tuple(
                read_numbers(distortion, FISHEYE_COEFFICIENTS, "distortion_coefficients")
            )
        elif model in ("plumb_bob", "rational_polynomial"):
            check_no_distortion(distortion, model)
            k = None
        else:
            raise ValueError(f"distortion_model {model!r} is not known")
        return camera_from_intrinsics(Intrinsics(size, (fx, fy), (cx, cy), k), str(d.get("camera_name") or name))
    except BadInput:
        raise
    except (ValueError, KeyError, TypeError) as cause:
        raise unreadable_file("ROS", repr(cause)) from cause
