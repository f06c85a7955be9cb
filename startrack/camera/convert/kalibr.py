"""Kalibr camchain YAML: pinhole with equidistant distortion for fisheyes; the mount as T_cam_imu.

Pixel (0, 0) is the centre of the first pixel, as here (its corners come from OpenCV). T_cam_imu takes points of the
rover's body (Kalibr's imu) into the camera.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

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
    """The camchain file, one camera: cam0."""
    lens = plain(centred(camera))
    model, coefficients = ("radtan", [0.0] * 4) if lens.k is None else ("equidistant", list(lens.k))
    R_cam_body = camera.R_body_cam.T
    rows = "".join(f"  - {flow([*row, 0.0])}\n" for row in R_cam_body.tolist())
    return (
        f"cam0:\n  cam_overlaps: []\n  camera_model: pinhole\n  distortion_coeffs: {flow(coefficients)}\n"
        f"  distortion_model: {model}\n  intrinsics: {flow([*lens.focal_px, *lens.centre_px])}\n"
        f"  resolution: [{lens.size_px[0]}, {lens.size_px[1]}]\n"
        f"  T_cam_imu:\n{rows}  - [0.0, 0.0, 0.0, 1.0]\n"
    )


def camera(text: str, name: str) -> Camera:
    """The first camera of a camchain file. Raises BadInput bad_calibration."""
    try:
        chain = parsed(text)
        d = chain.get("cam0", chain)
        if d["camera_model"] != "pinhole":
            raise ValueError(f"camera_model {d['camera_model']!r} has no counterpart")
        fx, fy, cx, cy = numbers(d["intrinsics"], 4, "intrinsics")
        width, height = numbers(d["resolution"], 2, "resolution")
        given = [float(v) for v in d.get("distortion_coeffs", [])]
        k: tuple[float, ...] | None = None
        if d["distortion_model"] in ("equidistant", "equi"):
            k = tuple(numbers(given, COEFFICIENTS, "distortion_coeffs"))
        else:
            no_other_distortion(given, str(d["distortion_model"]))
        made = camera_from(Plain((int(width), int(height)), (fx, fy), (cx, cy), k), name)
        if "T_cam_imu" not in d:
            return made
        R_cam_body = np.array([numbers(row, 4, "T_cam_imu")[:3] for row in d["T_cam_imu"][:3]])
        if R_cam_body.shape != (3, 3) or np.abs(R_cam_body @ R_cam_body.T - np.eye(3)).max() > 1e-6:
            raise ValueError("T_cam_imu holds no rotation")
        return replace(made, R_body_cam=R_cam_body.T)
    except BadInput:
        raise
    except (ValueError, KeyError, TypeError) as cause:
        raise unreadable("Kalibr", repr(cause)) from cause
