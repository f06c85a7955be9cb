"""Pinhole lens: the radius is the tangent of the angle off the axis."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from startrack.types import Array


@dataclass(frozen=True)
class Pinhole:
    """rho = tan a, a = angle off the axis [rad], rho in units of the focal length. Valid below 90 degrees."""

    model: str = field(default="pinhole", init=False)
    k: tuple[float, ...] = field(default=(), init=False)
    max_invertible_rad: float = field(default=np.pi / 2, init=False)

    def rho(self, angle_rad: Array) -> Array:
        """Radius [focal lengths] at the angles off the axis [rad]; infinite from 90 degrees on."""
        a = np.asarray(angle_rad, dtype=np.float64)
        return np.where(a < self.max_invertible_rad, np.tan(np.minimum(a, 1.57)), np.inf)

    def slope(self, angle_rad: Array) -> Array:
        """d rho / d angle [1/rad]."""
        return 1.0 / np.square(np.cos(np.minimum(angle_rad, 1.57)))

    def angle_rad(self, rho: Array) -> Array:
        """Angle off the axis [rad] at the radii [focal lengths]."""
        return np.arctan(rho)
