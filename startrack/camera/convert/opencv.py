"""OpenCV FileStorage (YAML, or XML when reading), with the keys of OpenCV's own calibration program.

Pixel (0, 0) is the centre of the first pixel, as here. fisheye_model = 1: cv2.fisheye's four coefficients, which are
k1 to k4. cv2.fisheye itself mirrors rays past 90 degrees: the numbers are right, that program's geometry there is not.
"""

from __future__ import annotations

from startrack.camera import Camera
from startrack.camera.convert.intrinsics import Intrinsics, camera_from_intrinsics, intrinsics_of, read_distortion


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
    """The camera of a FileStorage file. Raises ValueError."""
    import cv2

    try:
        store = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        matrix, distortion = store.getNode("camera_matrix").mat(), store.getNode("distortion_coefficients").mat()
        size_px = (int(store.getNode("image_width").real()), int(store.getNode("image_height").real()))
        model = "fisheye" if store.getNode("fisheye_model").real() == 1 else "pinhole"
    except (cv2.error, SystemError) as cause:  # cv2 wraps its parser's errors in a SystemError
        raise ValueError(str(cause)) from cause
    if matrix is None or matrix.shape != (3, 3) or distortion is None:
        raise ValueError("camera_matrix or distortion_coefficients are missing")
    k = read_distortion(model, distortion.ravel().tolist(), ("fisheye",), ("pinhole",))
    return camera_from_intrinsics(Intrinsics.from_matrix(size_px, matrix.ravel().tolist(), k), name)


def _matrix(rows: int, columns: int, data: list[float]) -> str:
    text = ", ".join(repr(float(v)) for v in data)
    return f"!!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [ {text} ]\n"
