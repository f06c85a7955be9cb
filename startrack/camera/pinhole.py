"""Pinhole lens: the radius is the tangent of the angle off the axis."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from startrack.types import Array

STEEPEST_RAD = 1.57  # 89.95 degrees: beyond this the tangent is no radius


@dataclass(frozen=True)
class Pinhole:
    """rho = tan a, a = angle off the axis [rad], rho in units of the focal length. Valid below 90 degrees."""

    model: str = field(default="pinhole", init=False)
    k: tuple[float, ...] = field(default=(), init=False)
    max_invertible_rad: float = field(default=STEEPEST_RAD, init=False)

    def rho(self, angle_rad: Array) -> Array:
        """Radius [focal lengths] at the angles off the axis [rad]; infinite beyond STEEPEST_RAD."""
        a = np.asarray(angle_rad, dtype=np.float64)
        return np.where(a <= STEEPEST_RAD, np.tan(np.minimum(a, STEEPEST_RAD)), np.inf)

    def slope(self, angle_rad: Array) -> Array:
        """d rho / d angle [1/rad]."""
        return 1.0 / np.square(np.cos(np.minimum(angle_rad, STEEPEST_RAD)))

    def angle_rad(self, rho: Array) -> Array:
        """Angle off the axis [rad] at the radii [focal lengths]."""
        return np.arctan(rho)
