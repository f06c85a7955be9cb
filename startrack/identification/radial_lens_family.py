"""One-parameter family of radial lens laws: all ideal fisheyes, the pinhole, and the laws between them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from startrack.camera import Lens
from startrack.core.types import Array

ORTHOGRAPHIC, EQUISOLID, EQUIDISTANT, STEREOGRAPHIC, PINHOLE = -1.0, -0.5, 0.0, 0.5, 1.0
LINEAR_SHAPE = 1e-4  # below this the law is the equidistant one
STEEPEST_RAD = 1.55  # of the argument of sine or tangent
STEEPEST_SINE = float(np.sin(STEEPEST_RAD))
WIDEST_SHAPE = 1.2  # of a fit
SHAPE_STEP = 1e-6  # for the numerical derivative by the shape


def radius(angle_rad: Array, shape: float) -> Array:
    """Radius [focal lengths] at the angles: sin(|q| a) / |q| for q < 0, a for q = 0, tan(q a) / q for q > 0.

    Orthographic is q = -1, equisolid -1/2, equidistant 0, stereographic 1/2, pinhole 1; real lenses lie between.
    """
    q = abs(shape)
    if q < LINEAR_SHAPE:
        return angle_rad
    x = np.minimum(q * angle_rad, STEEPEST_RAD)
    return (np.sin(x) if shape < 0 else np.tan(x)) / q


def angle(radius_focal: Array, shape: float) -> Array:
    """Inverse of `radius` [rad]; the steepest angle where the radius is outside the image circle."""
    q = abs(shape)
    if q < LINEAR_SHAPE:
        return radius_focal
    x = q * radius_focal
    return (np.arcsin(np.minimum(x, STEEPEST_SINE)) if shape < 0 else np.arctan(x)) / q


@dataclass(frozen=True)
class RadialFamily(Lens):
    """A lens of the family; used only during identification, not in camera files."""

    model: ClassVar[str] = "radial_family"
    label: ClassVar[str] = "one-parameter family"
    parameter_names: ClassVar[tuple[str, ...]] = ("shape",)

    shape: float

    @property
    def max_invertible_rad(self) -> float:  # type: ignore[override]
        """Angle up to which the radius rises [rad]."""
        return float(min(np.pi, STEEPEST_RAD / max(abs(self.shape), LINEAR_SHAPE)))

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

    def derivative(self, name: str, angle_rad: Array) -> Array:
        """d rho / d shape at the angles off the axis [rad]."""
        above, below = radius(angle_rad, self.shape + SHAPE_STEP), radius(angle_rad, self.shape - SHAPE_STEP)
        return (above - below) / (2 * SHAPE_STEP)

    def with_update(self, step: Mapping[str, float]) -> RadialFamily:
        """The lens with `step` added to its shape, kept within the family."""
        return RadialFamily(float(np.clip(self.shape + step.get("shape", 0.0), -WIDEST_SHAPE, WIDEST_SHAPE)))
