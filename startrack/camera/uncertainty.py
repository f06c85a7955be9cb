"""How the errors of a lens's parameters move its map: Jacobians, and the map's sigma over the image."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from startrack.camera.decentring import Decentring
from startrack.types import Array

if TYPE_CHECKING:
    from startrack.camera.camera import Camera

GRID_POINTS = 400
GOLDEN_ANGLE_RAD = np.pi * (3.0 - np.sqrt(5.0))


def lens_jacobian(camera: Camera, rays_cam: Array, order: tuple[str, ...]) -> Array:
    """d px / d parameter (..., 2, m) at the rays (..., 3), for the parameters named in `order`.

    Names: fx, fy, cx, cy, k1 ... k4, p1, p2, and f for fx and fy together, fx : fy kept [px per px, or px per 1].
    """
    rays_cam = np.asarray(rays_cam, dtype=np.float64)
    x, y, z = rays_cam[..., 0], rays_cam[..., 1], rays_cam[..., 2]
    off_axis = np.hypot(x, y)
    angle = np.arctan2(off_axis, z)
    ux, uy = (np.divide(c, off_axis, out=np.zeros_like(c), where=off_axis > 0) for c in (x, y))
    fx, fy = camera.focal_px
    rho = camera.lens.rho(angle)
    shift = camera.decentring.shift(angle[..., None] * np.stack([ux, uy], axis=-1))
    hand = -1.0 if camera.mirrored else 1.0
    zero, one = np.zeros_like(rho), np.ones_like(rho)
    across, down = hand * (rho * ux + shift[..., 0]), rho * uy + shift[..., 1]
    columns = {"fx": (across, zero), "fy": (zero, down), "cx": (one, zero), "cy": (zero, one)}
    columns["f"] = (across, down * (fy / fx))
    power = angle
    for n in range(1, 5):
        power = power * np.square(angle)
        columns[f"k{n}"] = (hand * fx * power * ux, fy * power * uy)
    for name, unit in (("p1", Decentring(1.0, 0.0)), ("p2", Decentring(0.0, 1.0))):
        by = unit.shift(angle[..., None] * np.stack([ux, uy], axis=-1))
        columns[name] = (hand * fx * by[..., 0], fy * by[..., 1])
    return np.stack([np.stack(columns[name], axis=-1) for name in order], axis=-1)


def cap_grid(angle_rad: float, points: int = GRID_POINTS) -> Array:
    """Rays (n, 3) spread evenly in solid angle over the cap within `angle_rad` of the axis."""
    i = np.arange(points) + 0.5
    z = 1.0 - (1.0 - np.cos(angle_rad)) * i / points
    r = np.sqrt(np.maximum(1.0 - z * z, 0.0))
    return np.stack([r * np.cos(GOLDEN_ANGLE_RAD * i), r * np.sin(GOLDEN_ANGLE_RAD * i), z], axis=-1)


def without_turn(camera: Camera, order: tuple[str, ...]) -> Array:
    """Rotation (3, m) of the camera [rad per parameter] that undoes best what each parameter does to the map.

    Over the calibrated cap, evenly in solid angle. An image's attitude is found with the camera's own map, so that
    this part of a lens error never reaches a prediction.
    """
    grid = cap_grid(camera.calibrated_angle_rad)
    turn = camera.jacobian_px_per_rad(grid).reshape(-1, 3)
    lens = lens_jacobian(camera, grid, order).reshape(-1, len(order))
    return np.asarray(-np.linalg.lstsq(turn, lens, rcond=None)[0], dtype=np.float64)


def map_covariance_px2(camera: Camera, rays_cam: Array) -> Array:
    """Covariance (..., 2, 2) [px^2] of the map at the rays (..., 3), the best rotation removed; 0 if unknown."""
    rays_cam = np.asarray(rays_cam, dtype=np.float64)
    if camera.covariance is None:
        return np.zeros((*rays_cam.shape[:-1], 2, 2))
    order = camera.covariance_order
    jacobian = lens_jacobian(camera, rays_cam, order)
    jacobian = jacobian + camera.jacobian_px_per_rad(rays_cam) @ without_turn(camera, order)
    return jacobian @ camera.covariance @ np.swapaxes(jacobian, -1, -2)
