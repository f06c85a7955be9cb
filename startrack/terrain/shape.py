"""Errors of a ground's map: those of its shape, what a file states about them, and what counts where it is silent."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from startrack.core.declaration import Either, List, Number
from startrack.core.types import Array, Ints
from startrack.frames import AIR_KEYS, USUAL_SIGMA_1, Air

NO_POST = -1
EXACT = 0.0  # sigma of a ground without the error
MAX_LENGTH_M = 1e7  # five times the Moon's radius
LENGTH = Number(low=0.0, high=MAX_LENGTH_M, above=True)
AMOUNT = replace(LENGTH, above=False)  # a length or a sigma [m] that may be zero


@dataclass(frozen=True, kw_only=True)
class Prior:
    """The prior of an error: normal about 0 with `sigma`, or with `gross_probability` with the wider `gross_sigma`."""

    sigma: float
    gross_probability: float = 0.0
    gross_sigma: float = 0.0
    scales: bool = False  # an error of a round crater's size: positions are that much farther from its axis too


@dataclass(frozen=True, kw_only=True)
class ShapeError(Prior):
    """An error that all azimuths share, in the unit that its name ends with.

    Errors of a pair (the terms of an ellipse, the axes of a tilt) have the same `fact`, and one gross part: both are
    gross, or neither. Of a stated error `gross_sigma` is what it would be if the statement were wrong.
    """

    name: str  # such as "depth_1" (relative), "bias_rad", "camera_height_m"
    fact: str  # the key of the terrain file that states it, such as "depth_sigma_m"
    mean: float = 0.0  # before: not 0 of a ground whose errors are counted from another one than the stated
    wave: int = 0  # of the horizon's error: how often it rises around the compass; 0: another error
    keeps_gross: bool = False  # what a file states does not exclude a gross error: a seam in its map

    @property
    def is_stated(self) -> bool:
        """Whether a file states `sigma`."""
        return self.gross_probability == 0.0 or self.keeps_gross


@dataclass(frozen=True, kw_only=True)
class Fact(Prior):
    """A key of the terrain file that states the sigma of some errors, and the prior of each where it is absent."""

    key: str
    errors: tuple[str, ...]  # names of the errors
    meaning: str  # for those who are asked for it
    limits: Number  # of the value in the file

    def errors_of_shape(self, stated: float | None, beside: float = 0.0) -> list[ShapeError]:
        """Errors of this fact that count; `stated` is the sigma in the unit of the errors, None where no file has it.

        `beside` is the sigma of an independent error with the same effect.
        """
        sigma, probability = (self.sigma, self.gross_probability) if stated is None else (float(stated), 0.0)
        sigma = float(np.hypot(sigma, beside))
        return [
            ShapeError(
                name=name, fact=self.key, sigma=sigma, gross_probability=probability, gross_sigma=self.gross_sigma,
                scales=self.scales,
            )
            for name in self.errors
            if sigma > 0.0 or self.gross_sigma > 0.0
        ]  # fmt: skip


DEPTH = Fact(
    key="depth_sigma_m", errors=("depth_1",), sigma=1e-3, gross_probability=0.01, gross_sigma=0.01,
    meaning="error of the depth [m]",
    limits=replace(AMOUNT, description="if absent 0.1 % of it, and with probability 1 % 1 %"),
)  # fmt: skip
DIAMETER = replace(
    DEPTH, key="diameter_sigma_m", errors=("diameter_1",), scales=True, meaning="error of the width [m]"
)  # fmt: skip
ELLIPSE = Fact(
    key="ellipse_sigma_1", errors=("ellipse_cos_1", "ellipse_sin_1"), sigma=5e-4, gross_probability=0.01,
    gross_sigma=5e-3, meaning="each of the two terms of an elliptic rim, relative to its radius",
    limits=Number(low=0.0, high=0.1, description="relative, of each of the rim's two terms; if absent 0.0005, and with "
                  "probability 1 % 0.005"),
)  # fmt: skip
RIM_TILT = Fact(
    key="rim_tilt_sigma_deg", errors=("rim_tilt_east_rad", "rim_tilt_north_rad"), sigma=float(np.radians(0.002)),
    gross_probability=0.005, gross_sigma=float(np.radians(0.1)),
    meaning="tilt of the rim about each of two axes [deg]",
    limits=Number(low=0.0, high=5.0, description="of each of two axes; if absent 0.002, and with probability "
                  "0.5 % 0.1"),
)  # fmt: skip
BIAS = Fact(
    key="horizon_sigma_deg", errors=("bias_rad",), sigma=0.0, gross_sigma=float(np.radians(1.0)),
    meaning="error of the horizon that all azimuths share [deg]",
    limits=Number(low=0.0, high=9.99, description="of an error of height that all crests share, at the median crest"),
)  # fmt: skip
STRETCH = Fact(
    key="stretch_sigma_1", errors=("stretch_1",), sigma=0.0, gross_probability=0.005, gross_sigma=5e-3,
    meaning="error of the scale of heights, relative",
    limits=Number(low=0.0, high=0.2, description="of the factor of tan of the horizon, less 1; if absent 0, and with "
                  "probability 0.5 % 0.005"),
)  # fmt: skip
VERTICAL = Fact(
    key="vertical_sigma_deg", errors=("vertical_east_rad", "vertical_north_rad"), sigma=float(np.radians(0.0005)),
    gross_probability=0.005, gross_sigma=float(np.radians(0.02)),
    meaning="tilt of the whole map about each of two axes [deg]",
    limits=Number(low=0.0, high=5.0, description="of a tilt of the whole map, of each of two axes; if absent 0.0005, "
                  "and with probability 0.5 % 0.02"),
)  # fmt: skip
CAMERA_ERROR = Fact(
    key="camera_height_sigma_m", errors=("camera_height_m",), sigma=0.02, meaning="error of the camera's height [m]",
    limits=replace(AMOUNT, description="if absent 0.02 above a height map, and 0 in a cylinder"),
)  # fmt: skip
REFRACTION = Fact(
    key="terrestrial_refraction_sigma", errors=("terrestrial_refraction_1",), sigma=0.1,
    meaning="error of the coefficient of terrestrial refraction",
    limits=Number(low=0.0, high=0.5, description="of the coefficient; if absent 0.1"),
)  # fmt: skip
# Maps of the Earth count heights from the geoid. Its slope against the ellipsoid, the deflection of the vertical, is 7
# arcsec along each axis in the mean of the Earth, 10 to 15 in mountains, and up to 100.
VERTICAL_EARTH = replace(
    VERTICAL, sigma=float(np.radians(0.003)), gross_sigma=float(np.radians(0.02)),
    meaning="tilt of the whole map about each of two axes, the geoid's slope included [deg]",
)  # fmt: skip
REFRACTION_1 = (
    0.13  # mean coefficient of terrestrial refraction (Gauss 1826; Bomford, Geodesy: 0.13 by day, more at night)
)
EARTH_HIGHEST_M = 8850.0  # the highest ground of the Earth
# The rest of the horizon's error as a series over azimuth, from north through east. Default: see docs/terrain.md. Gross
# part: a seam of 5 to 20 m (13 m in the mean square) in a horizon 9 km away. Of 20 such seams over half of the horizon,
# by a sky of 7 and 30 %, 3 are beyond the 99.9 % circle with a probability of 0.03 and 5 with 0.01.
WAVE_COUNT = 8
EXACT_WAVES = (EXACT,) * WAVE_COUNT
WAVE_PER_POST = 0.3  # sigma of wave 1, in the horizon's by single posts: 0.14 to 0.42 on the shipped maps
WAVE_FALL = -0.5  # power of the number of the wave with which sigmas fall where one number states them
WAVES = Fact(
    key="horizon_waves_sigma_deg", sigma=0.0, gross_probability=0.03, gross_sigma=float(np.radians(0.08)),
    errors=tuple(f"wave_{m}_{part}_rad" for m in range(1, WAVE_COUNT + 1) for part in ("cos", "sin")),
    meaning="smooth error of the horizon over azimuth: waves 1 to 8, each of the cosine and of the sine [deg]",
    limits=Number(low=0.0, high=9.99),
)  # fmt: skip
WAVES_LIMITS = Either(
    kinds=(WAVES.limits, List(each=WAVES.limits, count=WAVE_COUNT)),
    description="of smooth errors of the horizon over azimuth, the cosine and the sine of waves 1 to 8 each; one "
                "number is of wave 1, and wave m has it over the root of m; if absent 0.3 of what height_sigma_m makes "
                "of the horizon, and with probability 3 % a seam of 0.08",
)  # fmt: skip
# Of the further maps of a file against its first one. The polar cap and Site01, two products, differ by 0.5 m.
OFFSETS = Fact(
    key="map_offset_sigma_m", errors=(), sigma=1.0, gross_probability=0.01, gross_sigma=15.0,
    meaning="offset of the heights of each further map of the file against its first one [m]",
    limits=replace(AMOUNT, description="of the heights of each further map against the first one; if absent 1, and "
                   "with probability 1 % 15"),
)  # fmt: skip
CYLINDER_FACTS = (DEPTH, DIAMETER, ELLIPSE, RIM_TILT)
MAP_FACTS = (BIAS, STRETCH, VERTICAL, WAVES, OFFSETS, CAMERA_ERROR)


STAR_REFRACTION = Fact(
    key="refraction_sigma_1", errors=("refraction_1",), sigma=USUAL_SIGMA_1,
    meaning="error of the refraction of the stars, relative", limits=AIR_KEYS["refraction_sigma_1"],
)  # fmt: skip


def radians(degrees: float | None) -> float | None:
    """Angle [rad] from `degrees`; None from None."""
    return None if degrees is None else float(np.radians(degrees))


def vertical_fact(body: str) -> Fact:
    """The fact of a tilt of the whole map, on the Moon or the Earth."""
    return VERTICAL_EARTH if body == "earth" else VERTICAL


def offset_names(maps: int) -> tuple[str, ...]:
    """Names of the errors of OFFSETS in a file of so many `maps`."""
    return tuple(f"map_{k}_offset_m" for k in range(2, maps + 1))


def sigmas_of_waves(sigma: float) -> tuple[float, ...]:
    """Sigmas of waves 1 to WAVE_COUNT where one number, the `sigma` of wave 1, states them."""
    return tuple(sigma * m**WAVE_FALL for m in range(1, WAVE_COUNT + 1))


def refraction_errors(air: Air | None) -> list[ShapeError]:
    """Error of the refraction of stars in an `air`, in a list that is empty without air."""
    return [] if air is None else STAR_REFRACTION.errors_of_shape(air.refraction_sigma_1)


def refraction_slopes_rad(air: Air | None, horizon_rad: Array) -> dict[str, Array]:
    """Change (...) [rad] of a skyline at the elevations `horizon_rad` (...) by one unit of each error, by its name."""
    return {} if air is None else {"refraction_1": -air.lift_rad(horizon_rad)}


def wave_errors(stated: tuple[float, ...] | None, post_rad: float) -> list[ShapeError]:
    """The errors of WAVES; `stated` holds the sigmas of the waves [rad], None where the file is silent.

    A map with stated waves may have a seam, but not one whose waves are stated as 0: pictures are rendered from it.
    `post_rad` is what the error of the posts makes of the horizon.
    """
    sigmas = stated or sigmas_of_waves(WAVE_PER_POST * post_rad)
    gross = tuple(
        max(2 / np.pi * WAVES.gross_sigma / m, sigma) for m, sigma in enumerate(sigmas, 1)
    )  # of half a horizon
    return [
        ShapeError(
            name=name, fact=WAVES.key, sigma=sigmas[k // 2], gross_sigma=gross[k // 2], wave=k // 2 + 1,
            gross_probability=WAVES.gross_probability if any(sigmas) or not stated else 0.0, keeps_gross=bool(stated),
        )
        for k, name in enumerate(WAVES.errors)
    ]  # fmt: skip


def wave_slopes_rad(azimuths_rad: Array) -> dict[str, Array]:
    """Rise (...) of the horizon at `azimuths_rad` (...) by one unit of each of the WAVES, by name."""
    turns = [m * np.asarray(azimuths_rad) for m in range(1, WAVE_COUNT + 1)]
    return dict(zip(WAVES.errors, [part(turn) for turn in turns for part in (np.cos, np.sin)], strict=True))


def select_slopes(errors: Sequence[ShapeError], slopes_rad: dict[str, Array], shape: Iterable[int]) -> Array:
    """Slopes (k, ...) of the errors in their order, each broadcast to `shape`, from a dictionary by name."""
    shape = tuple(shape)
    if not errors:
        return np.zeros((0, *shape))
    return np.stack([np.broadcast_to(slopes_rad[error.name], shape) for error in errors])


def errors_by_name(errors: Sequence[ShapeError], values: Array) -> dict[str, float]:
    """The `values` (k,) of the errors by name. Raises ValueError where there are not as many."""
    return {error.name: float(value) for error, value in zip(errors, values, strict=True)}


class ExpectedCrests(NamedTuple):
    """The skyline at n azimuths of ground whose posts err, by the moments of its elevation."""

    rise_rad: Array  # (n,) mean, above the map's
    own_sigma_rad: Array  # (n,) of the part that follows no post
    post: Ints  # (n, k) in the numbering of a terrain; NO_POST where fewer count
    rad_per_m: Array  # (n, k) mean rise with the height of each


class GroundErrors:
    """Errors of the map of a ground: of single posts, and of its shape, which all azimuths share.

    The defaults are those of exact ground. Arguments of the methods are as in `Terrain`: `points_m` (..., 2)
    positions; `centres_m` (..., 2) and `half_m` centres and half sides of boxes of positions; `point_m` (2,) one
    position; `azimuths_rad` (...) directions in enu; `azimuth_half_rad` half the width of a range of azimuths.
    """

    height_sigma_m: float = 0.0  # standard deviation of the height of a post, independent of the others
    common_sigma_rad: float = 0.0  # standard deviation of an error of the horizon that all azimuths and positions share
    shape: tuple[ShapeError, ...] = ()  # errors that all azimuths share, those that are stated as zero too
    crest_distance_m: float = 10_000.0  # of the skyline from about the origin: over it waves of the map's error change
    unknown_steepness_1: float = 0.0  # relative sigma of the horizon's tangent, where a search must find it; 0: known
    steepness_1: float = 1.0  # the horizon's tangent that errors are counted from, over that of the stated shape

    def slopes_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """Change (k, ...) [rad] of the horizon by one unit of each of the k errors of the shape, to first order.

        Seen from the points (..., 2) [m] at the azimuths (...) [rad].
        """
        return np.zeros((0, *np.broadcast_shapes(np.shape(points_m)[:-1], np.shape(azimuths_rad))))

    def sigma_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """Standard deviation (...) of the horizon [rad] by single posts; independent between azimuths."""
        return np.zeros(np.broadcast_shapes(np.shape(points_m)[:-1], np.shape(azimuths_rad)))

    def most_sigma_rad(self, centres_m: Array, half_m: float, azimuths_rad: Array, azimuth_half_rad: float) -> Array:
        """The largest `sigma_rad` (...) over boxes and azimuths, as in `Terrain.horizon_bounds_rad`."""
        return np.zeros(np.broadcast_shapes(np.shape(centres_m)[:-1], np.shape(azimuths_rad)))

    def expected_crests(self, point_m: Array, azimuths_rad: Array) -> ExpectedCrests | None:
        """Skyline seen from `point_m` (2,) at the azimuths (n,), with all errors of posts; None without such."""
        return None

    def ground_posts(self, point_m: Array, azimuths_rad: Array) -> tuple[Ints, Array]:
        """Posts (n, k) of the ground below a camera at `point_m` (2,), and the change of the horizon by each.

        The latter is (n, k), negative, at the azimuths (n,) [rad/m].
        """
        return np.zeros((len(azimuths_rad), 0), dtype=np.int64), np.zeros((len(azimuths_rad), 0))

    def post_positions_m(self, posts: Ints) -> Array:
        """Positions (n, 3) [m] in enu, east, north and up, of the posts with these numbers (n,)."""
        return np.zeros((len(posts), 3))

    def warnings(self) -> list[str]:
        """Lines of text on what makes the errors larger than they are stated."""
        return []
