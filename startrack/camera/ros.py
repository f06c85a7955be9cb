"""Camera files of ROS: camera_info, as a file (camera_calibration_parsers) or as messages printed from a topic."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from startrack.camera.camera import Camera
from startrack.camera.format_parts import (
    Coefficients,
    Part,
    keys_of,
    matrix_of,
    read_distortion,
    read_numbers,
    read_yaml,
    yaml_list,
)

ROS_FILE_ARRAYS = {
    "k": "camera_matrix", "d": "distortion_coefficients", "r": "rectification_matrix", "p": "projection_matrix",
}  # fmt: skip


def write_ros(camera: Camera, k: Coefficients) -> str:
    """A camera_info file (camera_calibration_parsers): equidistant for fisheyes, plumb_bob for pinholes."""
    model, coefficients = ("plumb_bob", (0.0,) * 5) if k is None else ("equidistant", k)
    (fx, fy), (cx, cy) = camera.focal_px, camera.centre_px
    name = json.dumps(camera.name, ensure_ascii=False)  # a JSON string is one of YAML
    return (
        f"image_width: {camera.size_px[0]}\nimage_height: {camera.size_px[1]}\ncamera_name: {name}\n"
        f"camera_matrix:\n  rows: 3\n  cols: 3\n  data: {yaml_list(matrix_of(camera))}\n"
        f"distortion_model: {model}\n"
        f"distortion_coefficients:\n  rows: 1\n  cols: {len(coefficients)}\n  data: {yaml_list(coefficients)}\n"
        "rectification_matrix:\n  rows: 3\n  cols: 3\n  data: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]\n"
        "projection_matrix:\n  rows: 3\n  cols: 4\n"
        f"  data: {yaml_list([fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0])}\n"
    )


def split_ros(text: str) -> list[Part]:
    """The camera_info of a file, or those printed from a topic, whose keys ROS 1 writes in capitals.

    Names are their numbers; the message's header does not count.
    """
    found = []
    for number, document in enumerate(read_yaml(text), 1):
        d = {str(key).lower(): value for key, value in document.items() if key != "header"}
        if "camera_matrix" in d:
            for key, name in ROS_FILE_ARRAYS.items():
                if name in d:
                    d[key] = d.pop(name)["data"]
            d["width"], d["height"] = d.pop("image_width"), d.pop("image_height")
        found.append(Part(str(number), f"{d['width']} x {d['height']}", d))
    return found


def read_ros(d: dict[str, Any], _angle_rad: float | None) -> dict[str, Any]:
    """A camera_info. Width, height and matrix are of the whole sensor: region of interest, then binning, are applied.

    A pixel of the picture covers pixels of the sensor: its centre is between theirs.
    """
    coefficients = read_distortion(
        d["distortion_model"], d["d"], ("equidistant", "fisheye"), ("plumb_bob", "rational_polynomial")
    )
    fx, skew, cx, _, fy, cy, *_ = read_numbers(d["k"], 9, "camera matrix")
    if skew:
        raise ValueError("a skewed camera matrix has no counterpart")
    size = np.array([int(d["width"]), int(d["height"])])
    roi = d.get("roi") or {}
    start, window = ([int(roi.get(key, 0)) for key in keys] for keys in (("x_offset", "y_offset"), ("width", "height")))
    window = window if any(window) else size.tolist()  # 0: the whole sensor
    by = [max(int(d.get(key, 0)), 1) for key in ("binning_x", "binning_y")]  # 0: none
    if min(start) < 0 or min(window) < 1 or (np.add(start, window) > size).any():
        raise ValueError(f"roi {window[0]} x {window[1]} at {start[0]}, {start[1]} is not within the sensor")
    centre_px = (np.array([cx, cy]) - start + 0.5) / by - 0.5
    picture = np.array(window) // by
    notes = []
    if max(by) > 1 or (picture != size).any():
        notes.append(
            f"binning {by[0]} x {by[1]} and region of interest {window[0]} x {window[1]} at {start[0]}, {start[1]} are "
            f"applied: the camera is of pictures of {picture[0]} x {picture[1]} px"
        )
    r, p = read_numbers(d.get("r", np.eye(3).ravel().tolist()), 9, "r"), d.get("p")
    shift = [] if p is None else read_numbers(p, 12, "p")[3::4]
    if (any(r) and not np.array_equal(np.reshape(r, (3, 3)), np.eye(3))) or any(shift):
        notes.append("the rectification of a stereo camera (r, p) is left out: the camera is of pictures as taken")
    keys = keys_of(picture.tolist(), (fx / by[0], fy / by[1]), (float(centre_px[0]), float(centre_px[1])), coefficients)
    return keys | {"name": str(d.get("camera_name") or ""), "notes": tuple(notes)}
