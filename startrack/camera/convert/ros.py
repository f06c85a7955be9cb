"""ROS camera_info YAML (camera_calibration_parsers): equidistant for fisheyes, plumb_bob for pinholes.

Pixel (0, 0) is the centre of the first pixel, as here (REP 104, image_geometry, OpenCV).
"""

from __future__ import annotations

import json

from startrack.camera import Camera
from startrack.camera.convert.intrinsics import (
    Intrinsics,
    camera_from_intrinsics,
    intrinsics_of,
    read_distortion,
    read_numbers,
    read_yaml,
    yaml_list,
)


def to_text(camera: Camera) -> str:
    """The camera_info file."""
    lens = intrinsics_of(camera)
    model, coefficients = "plumb_bob" if lens.k is None else "equidistant", lens.coefficients(5)
    (fx, fy), (cx, cy) = lens.focal_px, lens.centre_px
    name = json.dumps(camera.name, ensure_ascii=False)  # a JSON string is one of YAML
    return (
        f"image_width: {lens.size_px[0]}\nimage_height: {lens.size_px[1]}\ncamera_name: {name}\n"
        f"camera_matrix:\n  rows: 3\n  cols: 3\n  data: {yaml_list(lens.matrix)}\n"
        f"distortion_model: {model}\n"
        f"distortion_coefficients:\n  rows: 1\n  cols: {len(coefficients)}\n  data: {yaml_list(coefficients)}\n"
        "rectification_matrix:\n  rows: 3\n  cols: 3\n  data: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]\n"
        "projection_matrix:\n  rows: 3\n  cols: 4\n"
        f"  data: {yaml_list([fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0])}\n"
    )


def from_text(text: str, name: str) -> Camera:
    """The camera of a camera_info file. Raises ValueError, KeyError, TypeError."""
    d = read_yaml(text)
    k = read_distortion(
        d["distortion_model"], d["distortion_coefficients"]["data"],
        ("equidistant", "fisheye"), ("plumb_bob", "rational_polynomial"),
    )  # fmt: skip
    matrix = read_numbers(d["camera_matrix"]["data"], 9, "camera_matrix")
    size_px = (int(d["image_width"]), int(d["image_height"]))
    return camera_from_intrinsics(Intrinsics.from_matrix(size_px, matrix, k), str(d.get("camera_name") or name))
