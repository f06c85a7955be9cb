"""Kalibr camchain YAML: pinhole with equidistant distortion for fisheyes; the mount as T_cam_imu.

Pixel (0, 0) is the centre of the first pixel, as here (its corners come from OpenCV). T_cam_imu takes points of the
rover's body (Kalibr's imu) into the camera.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

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
from startrack.frames import ORTHONORMAL_1, quat_xyzw_from_R


def to_text(camera: Camera) -> str:
    """The camchain file, one camera: cam0."""
    lens = intrinsics_of(camera)
    model, coefficients = "radtan" if lens.k is None else "equidistant", lens.coefficients(4)
    R_cam_body = camera.R_body_cam.T
    rows = "".join(f"  - {yaml_list([*row, 0.0])}\n" for row in R_cam_body.tolist())
    return (
        f"cam0:\n  cam_overlaps: []\n  camera_model: pinhole\n  distortion_coeffs: {yaml_list(coefficients)}\n"
        f"  distortion_model: {model}\n  intrinsics: {yaml_list([*lens.focal_px, *lens.centre_px])}\n"
        f"  resolution: [{lens.size_px[0]}, {lens.size_px[1]}]\n"
        f"  T_cam_imu:\n{rows}  - [0.0, 0.0, 0.0, 1.0]\n"
    )


def from_text(text: str, name: str) -> Camera:
    """The first camera of a camchain file. Raises ValueError, KeyError, TypeError."""
    chain = read_yaml(text)
    d = chain.get("cam0", chain)
    if d["camera_model"] != "pinhole":
        raise ValueError(f"camera_model {d['camera_model']!r} has no counterpart")
    fx, fy, cx, cy = read_numbers(d["intrinsics"], 4, "intrinsics")
    width, height = read_numbers(d["resolution"], 2, "resolution")
    k = read_distortion(
        d["distortion_model"], d.get("distortion_coeffs", []), ("equidistant", "equi"), ("radtan", "none")
    )
    camera = camera_from_intrinsics(Intrinsics((int(width), int(height)), (fx, fy), (cx, cy), k), name)
    if "T_cam_imu" not in d:
        return camera
    R_cam_body = np.array([read_numbers(row, 4, "T_cam_imu")[:3] for row in d["T_cam_imu"][:3]])
    if R_cam_body.shape != (3, 3) or np.abs(R_cam_body).max() > 1 + ORTHONORMAL_1:
        raise ValueError("T_cam_imu holds no rotation")
    quat_xyzw_from_R(R_cam_body)  # ValueError for what is no proper rotation
    return replace(camera, R_body_cam=R_cam_body.T)
