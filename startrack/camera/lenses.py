"""The lenses that startrack has, and the list of those that camera files and calibrations know."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np

from startrack.camera.lens import Lens, WcsProjection
from startrack.core.declaration import Key, List, Number
from startrack.core.types import Array

MAX_COEFFICIENTS = 4  # of a Kannala-Brandt lens
MAX_PINHOLE_RAD = 1.57  # 89.95 degrees: beyond this the tangent is no radius


@dataclass(frozen=True)
class KannalaBrandt(Lens):
    """A lens with rho = a + k1 a^3 + k2 a^5 + k3 a^7 + k4 a^9, a the angle off the axis [rad], rho in focal lengths.

    Without coefficients this is the equidistant lens. Valid past 90 degrees, up to the polynomial's first maximum.
    Source: Kannala & Brandt 2006, IEEE TPAMI 28, 1335, eq. 6 (with k of the linear term absorbed by the focal length).
    """

    model: ClassVar[str] = "kannala_brandt"
    label: ClassVar[str] = "Kannala-Brandt"
    law: ClassVar[str] = "a + k1 a^3 + k2 a^5 + k3 a^7 + k4 a^9"
    parameter_names: ClassVar[tuple[str, ...]] = tuple(f"k{n + 1}" for n in range(MAX_COEFFICIENTS))

    k: tuple[float, ...] = ()

    def rho(self, angle_rad: Array) -> Array:
        """Radius [focal lengths] at the angles `angle_rad` off the axis, any shape."""
        angle_rad = np.asarray(angle_rad)
        if not any(self.k):
            return np.asarray(angle_rad * 1.0)
        a2, polynomial = np.square(angle_rad), np.zeros_like(angle_rad)
        for k in reversed(self.k):
            polynomial = (polynomial + k) * a2
        return np.asarray(angle_rad * (1.0 + polynomial))

    def slope(self, angle_rad: Array) -> Array:
        """Slope d rho / d angle [1/rad] at the angles `angle_rad` off the axis, any shape."""
        a2 = np.square(angle_rad)
        polynomial = np.zeros_like(a2)
        for n in range(len(self.k), 0, -1):
            polynomial = (polynomial + (2 * n + 1) * self.k[n - 1]) * a2
        return 1.0 + polynomial

    def derivative(self, name: str, angle_rad: Array) -> Array:
        """Derivative d rho / d k_n = a^(2 n + 1), a = `angle_rad`, for the `name` "kn"; also of unused coefficients."""
        power = angle_rad
        for _ in range(self.parameter_names.index(name) + 1):
            power = power * np.square(angle_rad)
        return power

    @property
    def parameters(self) -> dict[str, float]:
        """The coefficients in use, by name."""
        return dict(zip(self.parameter_names, map(float, self.k), strict=False))

    def with_update(self, step: Mapping[str, float]) -> KannalaBrandt:
        """Copy of this lens with `step` added to its coefficients; those not in use begin at 0."""
        named = [n + 1 for n, name in enumerate(self.parameter_names) if name in step]
        k = np.zeros(max([len(self.k), *named]))
        k[: len(self.k)] = self.k
        for n in named:
            k[n - 1] += step[f"k{n}"]
        return KannalaBrandt(tuple(k.tolist()))

    def angle_rad(self, rho: Array) -> Array:
        """Angle off the axis [rad] at the radii `rho` [focal lengths], any shape."""
        if not any(self.k):
            return np.minimum(np.asarray(rho, dtype=np.float64), self.max_invertible_rad)
        return super().angle_rad(rho)

    @classmethod
    def file_keys(cls) -> dict[str, Key]:
        """Key `k` of camera files: the coefficients as one list."""
        return {"k": List(each=Number(low=-1e3, high=1e3), most=MAX_COEFFICIENTS, description="k1 to k4")}

    @classmethod
    def from_file(cls, values: Mapping[str, Any]) -> Self:
        """The lens of a camera file's checked `values`; without `k` the equidistant one."""
        return cls(values.get("k", ()))

    def file_values(self) -> dict[str, Any]:
        """Value of the key `k`: the coefficients as one list."""
        return {"k": [float(k) for k in self.k]}

    @classmethod
    def fit_sizes(cls) -> tuple[int, ...]:
        """Numbers of free coefficients that a calibration tries: none to all."""
        return tuple(range(MAX_COEFFICIENTS + 1))

    @classmethod
    def fit_start(cls, lens: Lens, size: int) -> KannalaBrandt:
        """Lens with the first `size` coefficients of `lens`, zeros where it has none."""
        return cls((*super().fit_start(lens, size).k, *(MAX_COEFFICIENTS * (0.0,)))[:size])

    @classmethod
    def fit_curve(cls, angle_rad: Array, rho: Array, size: int) -> tuple[KannalaBrandt, float]:
        """The lens of `size` coefficients and the focal length that fit the radii `rho` (n,) at `angle_rad` (n,) best.

        The focal length is in the unit of `rho`.
        """
        powers = np.asarray(angle_rad)[:, None] ** (2 * np.arange(size + 1) + 1)
        c, *_ = np.linalg.lstsq(powers, rho, rcond=None)
        return cls(tuple((c[1:] / c[0]).tolist())), float(c[0])

    @classmethod
    def typical_shapes(cls) -> tuple[Lens, ...]:
        """Equidistant, equisolid, stereographic and orthographic lenses as short polynomials."""
        return cls(), cls((-1 / 24,)), cls((1 / 12, 1 / 120)), cls((-1 / 6, 1 / 120))

    @classmethod
    def fit_text(cls, size: int) -> str:
        """Name of the lens with `size` coefficients in reports."""
        return f"{cls.label} with {size} k"

    def wcs_projection(self, max_angle_rad: float) -> WcsProjection:
        """FITS zenithal polynomial, or zenithal equidistant without coefficients: exact at any `max_angle_rad`."""
        if not any(self.k):
            return WcsProjection("ARC")
        cards = {f"PV2_{2 * n + 3}": float(k) for n, k in enumerate(self.k)}
        return WcsProjection("ZPN", {"PV2_0": 0.0, "PV2_1": 1.0, **cards})

    @property
    def opencv_coefficients(self) -> tuple[str, tuple[float, ...]]:
        """Name of OpenCV's fisheye model, with its coefficients k1 to k4."""
        return "fisheye", (*self.k, *(MAX_COEFFICIENTS * (0.0,)))[:MAX_COEFFICIENTS]


@dataclass(frozen=True)
class Pinhole(Lens):
    """A lens with rho = tan a, a the angle off the axis [rad], rho in focal lengths. Valid below 90 degrees."""

    model: ClassVar[str] = "pinhole"
    label: ClassVar[str] = "pinhole"
    law: ClassVar[str] = "tan a"
    max_fit_rad: ClassVar[float] = np.radians(65.0)

    def rho(self, angle_rad: Array) -> Array:
        """Radius [focal lengths] at the angles `angle_rad` off the axis, any shape; infinite beyond MAX_PINHOLE_RAD."""
        a = np.asarray(angle_rad, dtype=np.float64)
        return np.where(a <= MAX_PINHOLE_RAD, np.tan(np.minimum(a, MAX_PINHOLE_RAD)), np.inf)

    def slope(self, angle_rad: Array) -> Array:
        """Slope d rho / d angle [1/rad] at the angles `angle_rad` off the axis, any shape."""
        return 1.0 / np.square(np.cos(np.minimum(angle_rad, MAX_PINHOLE_RAD)))

    def angle_rad(self, rho: Array) -> Array:
        """Angle off the axis [rad] at the radii `rho` [focal lengths], any shape."""
        return np.arctan(rho)

    @property
    def max_invertible_rad(self) -> float:  # type: ignore[override]
        """Angle up to which rho rises [rad]: MAX_PINHOLE_RAD."""
        return MAX_PINHOLE_RAD

    def wcs_projection(self, max_angle_rad: float) -> WcsProjection:
        """FITS gnomonic projection: exact at any `max_angle_rad`."""
        return WcsProjection("TAN")

    @property
    def opencv_coefficients(self) -> tuple[str, tuple[float, ...]]:
        """Name of OpenCV's pinhole model, which has no coefficients."""
        return "pinhole", ()


DEFAULT = KannalaBrandt  # can follow any curve
LENSES: tuple[type[Lens], ...] = (
    DEFAULT,
    Pinhole,
)


def lens_kinds() -> dict[str, type[Lens]]:
    """Lenses by their names in camera files."""
    return {lens.model: lens for lens in LENSES}


def default_lens() -> type[KannalaBrandt]:
    """The lens of a camera file without the key `model`, and of a camera that is found without one."""
    return DEFAULT
