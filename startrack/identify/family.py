"""Lenses of one shape number: all the ideal fisheyes, the pinhole, and everything between them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from startrack.types import Array

ORTHOGRAPHIC, EQUISOLID, EQUIDISTANT, STEREOGRAPHIC, PINHOLE = -1.0, -0.5, 0.0, 0.5, 1.0
STRAIGHT = 1e-4  # shapes below this are the equidistant lens
STEEPEST_RAD = 1.55  # of the tangent's or sine's own argument


def radius(angle_rad: Array, shape: Array | float) -> Array:
    """Radius [focal lengths] of the family: sin(|q| a) / |q| for q < 0, a for q = 0, tan(q a) / q for q > 0.

    Orthographic is q = -1, equisolid -1/2, equidistant 0, stereographic 1/2, pinhole 1; real lenses lie between.
    """
    q = np.abs(shape)
    some = np.maximum(q, STRAIGHT)
    x = np.minimum(some * angle_rad, STEEPEST_RAD)
    curved = np.where(np.asarray(shape) < 0, np.sin(x), np.tan(x)) / some
    return np.where(q < STRAIGHT, angle_rad, curved)


def angle(radius_focal: Array, shape: Array | float) -> Array:
    """Inverse of `radius` [rad]; the steepest angle where the radius is beyond the lens's reach."""
    q = np.abs(shape)
    some = np.maximum(q, STRAIGHT)
    x = some * radius_focal
    curved = np.where(np.asarray(shape) < 0, np.arcsin(np.minimum(x, np.sin(STEEPEST_RAD))), np.arctan(x)) / some
    return np.where(q < STRAIGHT, radius_focal, curved)


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
