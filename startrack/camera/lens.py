"""The lens protocol: a radial law, its parameters, and its entries in files.

A new lens is one file beside this one and one line in LENSES of `lenses.py`. It needs `model`, `rho` and `slope`; with
parameters also `parameter_names`, `derivative` and a dataclass field of that name for each. The rest has defaults.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, Self, cast

import numpy as np

from startrack.core.declaration import Key, Number
from startrack.core.types import Array

MAX_INVERSION_STEPS = 60  # near the turning point Newton's steps only halve the error
INVERSION_STEP_RAD = 1e-9  # the last one: the error that it leaves is its square
INVERSION_TOLERANCE_1 = 1e-15  # of the radius
TURNING_GRID_POINTS = 4001  # over 0 to pi
WCS_DEGREE, WCS_GRID_POINTS = 13, 401  # of the fitted polynomial; FITS allows PV2_0 to PV2_20
MAX_WCS_ERROR_1 = 1e-4  # in focal lengths: 20 arcsec on the axis, as much as aberration bends a whole sky


@dataclass(frozen=True)
class WcsProjection:
    """A FITS projection: its code, its cards PV2_m, and its largest error [focal lengths], 0 if it equals the lens."""

    code: str
    cards: Mapping[str, float] = field(default_factory=dict)
    error_1: float = 0.0


class Lens(ABC):
    """Radial law of a lens: a ray at the angle a off the axis [rad] is imaged at rho(a) focal lengths from the centre.

    rho(a) = a + O(a^3), so that the focal length is the scale on the axis. Lenses are frozen dataclasses.
    """

    model: ClassVar[str]  # key `model` of camera files
    label: ClassVar[str]  # in reports
    law: ClassVar[str] = ""  # rho(a) as text, for the schema of camera files
    parameter_names: ClassVar[tuple[str, ...]] = ()  # of the radial law, beside focal length, centre and decentring
    max_fit_rad: ClassVar[float] = np.pi  # a calibration tries this lens if all its stars are nearer to the axis

    @abstractmethod
    def rho(self, angle_rad: Array) -> Array:
        """Radius [focal lengths] at the angles `angle_rad` off the axis, any shape."""

    @abstractmethod
    def slope(self, angle_rad: Array) -> Array:
        """d rho / d angle [1/rad] at the angles `angle_rad` off the axis, any shape."""

    def derivative(self, name: str, angle_rad: Array) -> Array:
        """Derivative d rho / d parameter `name` [1 per 1] at the angles `angle_rad` off the axis, any shape."""
        raise ValueError(f"the {self.model} lens has no parameter {name}")

    @property
    def parameters(self) -> dict[str, float]:
        """Values of the parameters in use, by name."""
        return {name: float(getattr(self, name)) for name in self.parameter_names}

    def with_update(self, step: Mapping[str, float]) -> Self:
        """Copy of this lens with `step` added to the parameters that it names; other names are ignored."""
        values = {name: value + step[name] for name, value in self.parameters.items() if name in step}
        return replace(self, **values) if values else self  # type: ignore[type-var]

    @cached_property
    def max_invertible_rad(self) -> float:
        """Angle up to which rho rises [rad]; pi if it rises everywhere."""
        a = np.linspace(0.0, np.pi, TURNING_GRID_POINTS)
        falling = np.flatnonzero(self.slope(a) <= 0)
        return float(a[max(falling[0] - 1, 0)]) if len(falling) else float(np.pi)

    def angle_rad(self, rho: Array) -> Array:
        """Angle off the axis [rad] at the radii `rho` [focal lengths], any shape.

        Inverse of `rho` by safeguarded Newton steps. Radii beyond that of `max_invertible_rad` give this angle.
        """
        rho = np.asarray(rho, dtype=np.float64)
        top = self.max_invertible_rad
        low = np.zeros_like(rho)
        high = np.full_like(rho, top)
        a = np.clip(rho, 0.0, top)
        for _ in range(MAX_INVERSION_STEPS):
            excess = self.rho(a) - rho
            low = np.where(excess < 0, a, low)
            high = np.where(excess < 0, high, a)
            slope = self.slope(a)
            step = np.divide(excess, slope, out=np.full_like(excess, np.inf), where=slope > 0)
            newton = a - step
            # A step that leaves the bracket is replaced by bisection: convergence does not depend on the law's shape.
            following = np.where((newton >= low) & (newton <= high), newton, 0.5 * (low + high))
            near = np.abs(following - a) <= INVERSION_STEP_RAD
            a = following
            if np.all(near | (np.abs(excess) <= INVERSION_TOLERANCE_1)):
                break
        return a

    # Camera files

    @classmethod
    def file_keys(cls) -> dict[str, Key]:
        """Keys of the lens itself in camera files: by default each parameter by its name."""
        return {name: Number(required=True, low=-1e3, high=1e3) for name in cls.parameter_names}

    @classmethod
    def from_file(cls, values: Mapping[str, Any]) -> Self:
        """The lens of a camera file's checked `values`. Raises ValueError with a line that names the wrong key."""
        return cls(**{key: values[key] for key in cls.file_keys() if key in values})

    def file_values(self) -> dict[str, Any]:
        """Values of `file_keys`, such that `from_file` gives the lens back."""
        return dict(self.parameters)

    # Calibration

    @classmethod
    def fit_sizes(cls) -> tuple[int, ...]:
        """Numbers of free parameters that a calibration tries, ascending: by default all or none."""
        return (len(cls.parameter_names),)

    @classmethod
    def fit_size(cls, at_most: int) -> int:
        """The largest of `fit_sizes` that does not exceed `at_most`, or the smallest there is."""
        sizes = cls.fit_sizes()
        return max((size for size in sizes if size <= at_most), default=sizes[0])

    @classmethod
    def fit_start(cls, lens: Lens, size: int) -> Self:
        """A lens of this kind with `size` free parameters, to begin a fit: `lens` itself if it is of this kind."""
        return cast(Self, lens) if lens.model == cls.model else cls()

    @classmethod
    def typical_shapes(cls) -> tuple[Lens, ...]:
        """Lenses of this kind that a calibration without a camera file tries first."""
        return (cls(),)

    @classmethod
    def fit_text(cls, size: int) -> str:
        """Name of the lens with `size` free parameters in reports."""
        return f"{cls.label} with {', '.join(cls.parameter_names[:size])}" if size else cls.label

    # Other formats

    def wcs_projection(self, max_angle_rad: float) -> WcsProjection | None:
        """The FITS projection of this lens, right to MAX_WCS_ERROR_1 within `max_angle_rad` of the axis, or None.

        By default the best odd zenithal polynomial (ZPN). Source: Calabretta & Greisen 2002, A&A 395, 1077, sec. 5.1.7.
        """
        top = min(max_angle_rad, self.max_invertible_rad)
        a = np.linspace(0.0, top, WCS_GRID_POINTS)
        powers = np.arange(1, WCS_DEGREE + 1, 2)
        terms = (a[:, None] / top) ** powers
        scaled = np.linalg.lstsq(terms, self.rho(a), rcond=None)[0]
        error = float(np.max(np.abs(terms @ scaled - self.rho(a))))
        rising = bool(np.all(np.diff(terms @ scaled) > 0))
        if not rising or not error <= MAX_WCS_ERROR_1:
            return None
        cards = {f"PV2_{n}": float(c) for n, c in zip(powers.tolist(), scaled / top**powers, strict=True)}
        return WcsProjection("ZPN", {"PV2_0": 0.0, **cards}, error)

    @property
    def opencv_coefficients(self) -> tuple[str, tuple[float, ...]] | None:
        """Name and coefficients of OpenCV's model that equals this lens, or None.

        ("pinhole", ()) or ("fisheye", (k1, k2, k3, k4)); ROS, Kalibr and COLMAP use the same two models.
        """
        return None
