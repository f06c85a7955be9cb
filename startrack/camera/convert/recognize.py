"""Which program a camera file is from, by its content."""

from __future__ import annotations

import re

from startrack.camera.convert.intrinsics import read_yaml
from startrack.camera.convert.opencv import DISTORTION, OPENCV_HEAD

COLMAP_LINE = re.compile(r"\d+\s+[A-Z_]+\s+\d+\s+\d+\s")  # CAMERA_ID, MODEL, WIDTH, HEIGHT
KALIBR_CHAIN, KALIBR_KEYS = "cam0", {"camera_model", "intrinsics"}
ROS_KEYS, OPENCV_KEYS = {"camera_matrix", "distortion_model"}, {"camera_matrix", DISTORTION}


def find_program(text: str) -> str | None:
    """The program whose camera file the `text` is: ros, kalibr, colmap or opencv; None if it is of none of them."""
    if "<opencv_storage>" in text or OPENCV_HEAD.search(text):
        return "opencv"
    lines = (line.strip() for line in text.splitlines())
    if COLMAP_LINE.match(next((line for line in lines if line and not line.startswith("#")), "")):
        return "colmap"
    try:
        keys = read_yaml(text).keys()
    except ValueError:
        return None
    if KALIBR_CHAIN in keys or keys >= KALIBR_KEYS:
        return "kalibr"
    if keys >= ROS_KEYS:
        return "ros"
    return "opencv" if keys >= OPENCV_KEYS else None
