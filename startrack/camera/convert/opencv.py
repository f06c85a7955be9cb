"""OpenCV FileStorage (YAML, or XML when reading), with the keys of OpenCV's own calibration program.

Pixel (0, 0) is the centre of the first pixel, as here. fisheye_model = 1: cv2.fisheye's four coefficients, which are
k1 to k4. cv2.fisheye itself mirrors rays past 90 degrees: the numbers are right, that program's geometry there is not.
"""

from __future__ import annotations

from startrack.camera import Camera
from startrack.camera.convert.intrinsics import (
    Intrinsics,
    camera_from_intrinsics,
    check_no_distortion,
    intrinsics_of,
    unreadable_file,
    without_decentring,
)
from startrack.types import BadInput


def to_text(camera: Camera) -> str:
    """The FileStorage file as YAML."""
    lens = intrinsics_of(without_decentring(camera))
    fisheye, coefficients = (0, [0.0] * 5) if lens.k is None else (1, list(lens.k))
    return (
        f"%YAML:1.0\n---\nimage_width: {lens.size_px[0]}\nimage_height: {lens.size_px[1]}\n"
        f"fisheye_model: {fisheye}\n"
        f"camera_matrix: {_matrix(3, 3, lens.matrix)}"
        f"distortion_coefficients: {_matrix(len(coefficients), 1, coefficients)}"
    )


def from_text(text: str, name: str) -> Camera:
    """The camera of a FileStorage file. Raises BadInput bad_calibration."""
    import cv2

    try:
        store = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        matrix, distortion = store.getNode("camera_matrix").mat(), store.getNode("distortion_coefficients").mat()
        size = (int(store.getNode("image_width").real()), int(store.getNode("image_height").real()))
        fisheye = store.getNode("fisheye_model").real() == 1
    except (cv2.error, SystemError) as cause:  # cv2 wraps its parser's errors in a SystemError
        raise unreadable_file("OpenCV", cause) from cause
    if matrix is None or matrix.shape != (3, 3) or distortion is None:
        raise unreadable_file("OpenCV", "camera_matrix or distortion_coefficients are missing")
    try:
        coefficients = [float(v) for v in distortion.ravel()]
        k: tuple[float, ...] | None = tuple(coefficients)
        if not fisheye:
            check_no_distortion(coefficients, "of the pinhole model")
            k = None
        elif len(coefficients) != 4 or matrix[0, 1]:
            raise ValueError("a fisheye has four coefficients and no skew")
        focal, centre = (matrix[0, 0], matrix[1, 1]), (matrix[0, 2], matrix[1, 2])
        return camera_from_intrinsics(
            Intrinsics(size, (float(focal[0]), float(focal[1])), (float(centre[0]), float(centre[1])), k), name
        )
    except BadInput:
        raise
    except ValueError as cause:
        raise unreadable_file("OpenCV", cause) from cause


def _matrix(rows: int, columns: int, data: list[float]) -> str:
    text = ", ".join(repr(float(v)) for v in data)
    return f"!!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [ {text} ]\n"
