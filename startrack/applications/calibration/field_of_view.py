"""The field of view of a calibration: as given, of an approximate camera, and of the fitted one."""

from __future__ import annotations

import numpy as np

from startrack.camera import Camera
from startrack.core.types import BadInput
from startrack.identification import WIDE_FIELD_RAD


def field_of_view_rad(camera: Camera | None, fov_rad: float | None) -> float:
    """Field of view [rad]: `fov_rad`, else of the approximate camera: image circle if wide, else frame width.

    Raises BadInput no_calibration where there is neither.
    """
    if fov_rad is not None:
        return fov_rad
    if camera is None:
        raise BadInput("no_calibration", "give the field of view (--fov DEG) or an approximate camera file (-c)")
    if 2.0 * camera.max_angle_rad >= WIDE_FIELD_RAD:
        return 2.0 * camera.max_angle_rad
    width, height = camera.size_px
    sides = np.array([[-0.5, (height - 1) / 2], [width - 0.5, (height - 1) / 2]])
    return float(min(np.sum(camera.angle_rad(sides)), 0.99 * WIDE_FIELD_RAD))


def corner_angle_rad(camera: Camera) -> float:
    """The largest angle off the axis [rad] of the frame's corners."""
    right, bottom = (side - 0.5 for side in camera.size_px)
    return float(np.max(camera.angle_rad(np.array([[x, y] for x in (-0.5, right) for y in (-0.5, bottom)]))))


def largest_angle_rad(fitted: Camera, start: Camera | None, fov_rad: float | None) -> float:
    """Edge of the image circle [rad]: as given, else the corner; at most the turning point of the polynomial."""
    edge = corner_angle_rad(fitted) if start is None else start.max_angle_rad
    if start is None and fov_rad is not None and fov_rad >= WIDE_FIELD_RAD:
        edge = 0.5 * fov_rad
    return float(max(min(edge, fitted.lens.max_invertible_rad), fitted.calibrated_angle_rad))
