"""OpenCV FileStorage (YAML, or XML when reading), with the keys of OpenCV's own calibration program.

Pixel (0, 0) is the centre of the first pixel, as here. fisheye_model = 1: cv2.fisheye's four coefficients, which are
k1 to k4. cv2.fisheye itself mirrors rays past 90 degrees: the numbers are right, that program's geometry there is not.
OpenCV's own parser is not used: damaged files end its process.
"""

from __future__ import annotations

import re
from typing import Any

from startrack.camera import Camera
from startrack.camera.convert.intrinsics import (
    Intrinsics,
    camera_from_intrinsics,
    intrinsics_of,
    read_distortion,
    read_numbers,
    read_yaml,
)

DISTORTION = "distortion_coefficients"
DISTORTION_COUNTS = 4, 5, 8, 12, 14  # of OpenCV's models
OPENCV_HEAD = re.compile(r"\A\s*%YAML[: ]1\.0|!!opencv-matrix")  # which YAML itself does not have


def to_text(camera: Camera) -> str:
    """The FileStorage file as YAML."""
    lens = intrinsics_of(camera)
    fisheye, coefficients = 0 if lens.k is None else 1, lens.coefficients(5)
    return (
        f"%YAML:1.0\n---\nimage_width: {lens.size_px[0]}\nimage_height: {lens.size_px[1]}\n"
        f"fisheye_model: {fisheye}\n"
        f"camera_matrix: {_matrix(3, 3, lens.matrix)}"
        f"distortion_coefficients: {_matrix(len(coefficients), 1, coefficients)}"
    )


def from_text(text: str, name: str) -> Camera:
    """The camera of a FileStorage file. Raises ValueError, KeyError, TypeError."""
    d = _read_xml(text) if text.lstrip().startswith("<") else read_yaml(OPENCV_HEAD.sub("", text))
    matrix = _read_matrix(d["camera_matrix"], "camera_matrix", (9,))
    distortion = _read_matrix(d[DISTORTION], DISTORTION, DISTORTION_COUNTS)
    model = "fisheye" if float(d.get("fisheye_model", 0)) == 1 else "pinhole"
    k = read_distortion(model, distortion, ("fisheye",), ("pinhole",))
    size_px = (int(d["image_width"]), int(d["image_height"]))
    return camera_from_intrinsics(Intrinsics.from_matrix(size_px, matrix, k), name)


def _read_matrix(entry: dict[str, Any], key: str, counts: tuple[int, ...]) -> list[float]:
    """The numbers of a matrix, row by row. Raises ValueError, KeyError, TypeError."""
    count = int(entry["rows"]) * int(entry["cols"])
    if count not in counts:
        raise ValueError(f"{key} must hold {' or '.join(map(str, counts))} numbers, not {count}")
    return read_numbers(entry["data"], count, key)


def _read_xml(text: str) -> dict[str, Any]:
    """The entries of a file in XML: texts, and matrices as dictionaries. Raises ValueError."""
    from xml.etree import ElementTree

    try:
        entries = ElementTree.fromstring(text)
    except ElementTree.ParseError as cause:
        raise ValueError(str(cause)) from cause
    found: dict[str, Any] = {}
    for entry in entries:
        parts = {part.tag: (part.text or "").strip() for part in entry}
        found[entry.tag] = {**parts, "data": parts.get("data", "").split()} if parts else (entry.text or "").strip()
    return found


def _matrix(rows: int, columns: int, data: list[float]) -> str:
    text = ", ".join(repr(float(v)) for v in data)
    return f"!!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [ {text} ]\n"
