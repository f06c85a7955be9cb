"""Lenses of one shape number: all the ideal fisheyes, the pinhole, and everything between them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from startrack.types import Array

ORTHOGRAPHIC, EQUISOLID, EQUIDISTANT, STEREOGRAPHIC, PINHOLE = -1.0, -0.5, 0.0, 0.5, 1.0
STRAIGHT = 1e-4  # shapes below this are the equidistant lens
STEEPEST_RAD = 1.55  # of the tangent's or sine's own argument
STEEPEST_SINE = float(np.sin(STEEPEST_RAD))


def radius(angle_rad: Array, shape: float) -> Array:
    """Radius [focal lengths] of the family: sin(|q| a) / |q| for q < 0, a for q = 0, tan(q a) / q for q > 0.

    Orthographic is q = -1, equisolid -1/2, equidistant 0, stereographic 1/2, pinhole 1; real lenses lie between.
    """
    q = abs(shape)
    if q < STRAIGHT:
        return angle_rad
    x = np.minimum(q * angle_rad, STEEPEST_RAD)
    return (np.sin(x) if shape < 0 else np.tan(x)) / q


def angle(radius_focal: Array, shape: float) -> Array:
    """Inverse of `radius` [rad]; the steepest angle where the radius is beyond the lens's reach."""
    q = abs(shape)
    if q < STRAIGHT:
        return radius_focal
    x = q * radius_focal
    return (np.arcsin(np.minimum(x, STEEPEST_SINE)) if shape < 0 else np.arctan(x)) / q


@dataclass(frozen=True)
class Family:
    """A lens of the family, as the camera's `Lens` protocol wants it; used only while identifying."""

    shape: float
    model: str = field(default="family", init=False)
    k: tuple[float, ...] = field(default=(), init=False)

    @property
    def max_invertible_rad(self) -> float:
        """Angle up to which the radius rises [rad]."""
        return float(min(np.pi, STEEPEST_RAD / max(abs(self.shape), STRAIGHT)))

    def rho(self, angle_rad: Array) -> Array:
        """Radius [focal lengths] at the angles off the axis [rad]."""
        return radius(np.asarray(angle_rad, dtype=np.float64), self.shape)

    def slope(self, angle_rad: Array) -> Array:
        """d rho / d angle [1/rad]."""
        x = np.minimum(abs(self.shape) * np.asarray(angle_rad, dtype=np.float64), STEEPEST_RAD)
        return np.cos(x) if self.shape < 0 else 1.0 / np.square(np.cos(x))

    def angle_rad(self, rho: Array) -> Array:
        """Angle off the axis [rad] at the radii [focal lengths]."""
        return angle(np.asarray(rho, dtype=np.float64), self.shape)
