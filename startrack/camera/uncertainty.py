"""Errors of a camera's parameters and their effect on the projection: Jacobians and covariance over the image."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from startrack.camera.decentring import Decentring
from startrack.core.types import Array

if TYPE_CHECKING:
    from startrack.camera.camera import Camera

GRID_POINTS = 400
GOLDEN_ANGLE_RAD = np.pi * (3.0 - np.sqrt(5.0))


def lens_jacobian(camera: Camera, rays_cam: Array, order: tuple[str, ...]) -> Array:
    """d px / d parameter (..., 2, m) of a camera at `rays_cam` (..., 3), for the m parameters named in `order`.

    Names: as in `parameters.py` [px per px, or px per 1]. Raises ValueError for a name that the lens does not have.
    """
    rays_cam = np.asarray(rays_cam, dtype=np.float64)
    x, y, z = rays_cam[..., 0], rays_cam[..., 1], rays_cam[..., 2]
    off_axis = np.hypot(x, y)
    angle = np.arctan2(off_axis, z)
    u = np.stack([np.divide(c, off_axis, out=np.zeros_like(c), where=off_axis > 0) for c in (x, y)], axis=-1)
    st = angle[..., None] * u
    uv = camera.lens.rho(angle)[..., None] * u + camera.decentring.shift(st)  # image point [focal lengths]
    handed_px = np.array(camera.handed_focal_px)
    sign = np.array([-1.0 if camera.mirrored else 1.0, 1.0])
    x_only, y_only = np.array([1.0, 0.0]), np.array([0.0, 1.0])

    def column(name: str) -> Array:
        if name == "f":
            return uv * sign * [1.0, camera.focal_px[1] / camera.focal_px[0]]
        if name in ("fx", "fy"):
            return uv * sign * (x_only if name == "fx" else y_only)
        if name in ("cx", "cy"):
            return np.broadcast_to(x_only if name == "cx" else y_only, uv.shape)
        if name in ("p1", "p2"):
            return handed_px * Decentring(float(name == "p1"), float(name == "p2")).shift(st)
        return handed_px * camera.lens.derivative(name, angle)[..., None] * u

    return np.stack([column(name) for name in order], axis=-1)


def cap_grid(angle_rad: float, points: int = GRID_POINTS) -> Array:
    """Rays (`points`, 3) spread evenly in solid angle over the cap within `angle_rad` of the axis."""
    i = np.arange(points) + 0.5
    z = 1.0 - (1.0 - np.cos(angle_rad)) * i / points
    r = np.sqrt(np.maximum(1.0 - z * z, 0.0))
    return np.stack([r * np.cos(GOLDEN_ANGLE_RAD * i), r * np.sin(GOLDEN_ANGLE_RAD * i), z], axis=-1)


def compensating_rotation(camera: Camera, order: tuple[str, ...]) -> Array:
    """Rotation (3, m) of the camera [rad per parameter] that best compensates a change of each parameter in `order`.

    Least squares over the calibrated cap, evenly in solid angle. An image's attitude is found with the same camera, so
    that this part of a lens error does not reach a prediction.
    """
    grid = cap_grid(camera.calibrated_angle_rad)
    rotation = camera.jacobian_px_per_rad(grid).reshape(-1, 3)
    lens = lens_jacobian(camera, grid, order).reshape(-1, len(order))
    return np.asarray(-np.linalg.lstsq(rotation, lens, rcond=None)[0], dtype=np.float64)


def projection_covariance_px2(camera: Camera, rays_cam: Array) -> Array:
    """Covariance (..., 2, 2) [px^2] of the projected `rays_cam` (..., 3), best rotation removed; 0 if not known."""
    rays_cam = np.asarray(rays_cam, dtype=np.float64)
    if camera.covariance is None:
        return np.zeros((*rays_cam.shape[:-1], 2, 2))
    order = camera.covariance_order
    jacobian = lens_jacobian(camera, rays_cam, order)
    jacobian = jacobian + camera.jacobian_px_per_rad(rays_cam) @ compensating_rotation(camera, order)
    return jacobian @ camera.covariance @ np.swapaxes(jacobian, -1, -2)
