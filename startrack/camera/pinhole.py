"""Pinhole lens: the radius is the tangent of the angle off the axis."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from startrack.camera.lens import Lens, WcsProjection
from startrack.core.types import Array

MAX_ANGLE_RAD = 1.57  # 89.95 degrees: beyond this the tangent is no radius


@dataclass(frozen=True)
class Pinhole(Lens):
    """rho = tan a, a = angle off the axis [rad], rho in units of the focal length. Valid below 90 degrees."""

    model: ClassVar[str] = "pinhole"
    label: ClassVar[str] = "pinhole"
    max_fit_rad: ClassVar[float] = np.radians(65.0)

    def rho(self, angle_rad: Array) -> Array:
        """Radius [focal lengths] at the angles `angle_rad` off the axis, any shape; infinite beyond MAX_ANGLE_RAD."""
        a = np.asarray(angle_rad, dtype=np.float64)
        return np.where(a <= MAX_ANGLE_RAD, np.tan(np.minimum(a, MAX_ANGLE_RAD)), np.inf)

    def slope(self, angle_rad: Array) -> Array:
        """d rho / d angle [1/rad] at the angles `angle_rad` off the axis, any shape."""
        return 1.0 / np.square(np.cos(np.minimum(angle_rad, MAX_ANGLE_RAD)))

    def angle_rad(self, rho: Array) -> Array:
        """Angle off the axis [rad] at the radii `rho` [focal lengths], any shape."""
        return np.arctan(rho)

    @property
    def max_invertible_rad(self) -> float:  # type: ignore[override]
        """MAX_ANGLE_RAD."""
        return MAX_ANGLE_RAD

    def wcs_projection(self, max_angle_rad: float) -> WcsProjection:
        """Gnomonic: exact at any `max_angle_rad`."""
        return WcsProjection("TAN")

    @property
    def opencv_coefficients(self) -> tuple[str, tuple[float, ...]]:
        """No distortion."""
        return "pinhole", ()
