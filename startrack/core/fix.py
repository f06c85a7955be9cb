"""Position and clock: what is known before an image is used, and what a localization gives.

The position has its errors, what was left out of it, and what nobody stated.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from startrack.core.values import Array, Bools, Value, array, vector

CARRIED_PART = 0.5  # of the information, by the groups that are named


@dataclass(frozen=True)
class PositionPrior:
    """A round normal distribution of the camera's position: mean and standard deviation [m] in enu.

    Raises ValueError for numbers that are not finite and a sigma that is not above 0.
    """

    east_m: float
    north_m: float
    sigma_m: float

    def __post_init__(self) -> None:
        if not np.isfinite([self.east_m, self.north_m, self.sigma_m]).all() or self.sigma_m <= 0:
            raise ValueError(f"prior {self}: three finite numbers are needed, and a sigma above 0")

    def __str__(self) -> str:
        return f"{self.east_m:g},{self.north_m:g},{self.sigma_m:g}"

    @property
    def mean_m(self) -> Array:
        """Mean position (2,) in enu, east and north [m]."""
        return np.array([self.east_m, self.north_m])

    def log_density(self, points_m: Array) -> Array:
        """Logarithm (n,) of the density at positions (n, 2) [m], less its maximum."""
        off = points_m - self.mean_m
        return np.asarray(-0.5 * np.einsum("ni,ni->n", off, off) / self.sigma_m**2)


@dataclass(frozen=True, kw_only=True)
class Clock(Value):
    """Effect of an error of the clock on directions in enu, with the prior of this error.

    A time called `offset_s` counts from the stated one, `later_s` from that of the directions. The prior is a mixture:
    `sigma_s`, or with `gross_probability` the wider `gross_sigma_s`, which is also what the error would be if a stated
    `sigma_s` were wrong.
    """

    turn_rad_s: Array = vector()  # rotation vector in enu: by one second that the true time is later
    sigma_s: float  # of the stated time
    offset_s: float = 0.0  # by which the directions' time is later than the stated one
    reach_s: float = np.inf  # the true time is no farther from the directions' time
    gross_probability: float = 0.0  # above 0 where `sigma_s` is not stated
    gross_sigma_s: float = 0.0

    def log_prior(self, later_s: float) -> float:
        """Logarithm of the prior at `later_s` after the directions' time, less its maximum; without the gross part."""
        return -0.5 * ((self.offset_s + later_s) / self.sigma_s) ** 2


@dataclass(frozen=True, kw_only=True)
class Mode(Value):
    """A connected region of the posterior of the position."""

    east_m: float
    north_m: float
    weight: float  # posterior probability
    radius95_m: float = np.inf  # circle about it that holds 95 % of the mode's own probability; infinite: not stated
    radius999_m: float = np.inf


@dataclass(frozen=True)
class ClockError:
    """Time by which the true time is later than the stated one, with its standard deviation."""

    offset_s: float
    sigma_s: float


@dataclass(frozen=True)
class UnstatedFact:
    """A fact that no file states, and the 99.9 % circle of the position if it were exact."""

    fact: str  # key of the file that states it
    radius999_m_if_exact: float


@dataclass(frozen=True)
class ShownError:
    """An error beyond the default of a fact that no file states, as the image shows it."""

    name: str  # ends with its unit
    fact: str  # key of the file that states it
    value: float
    sigma: float

    @property
    def text(self) -> str:
        """Text that names the error, with its value, sign and unit."""
        words, unit = self.name.rsplit("_", 1)
        value = f"{100 * self.value:+.2f} %" if unit == "1" else f"{self.value:+.4g} {unit}"
        return f"an error of {words.replace('_', ' ')} of {value}"


@dataclass(frozen=True, eq=False)
class Sectors:
    """Sectors of azimuth from north eastward, and where something is likely, such as that the skyline is hidden."""

    probability: Array  # (n,) of it in each sector

    @property
    def likely(self) -> Bools:
        """Whether it is more likely than not, for each sector (n,)."""
        return np.asarray(self.probability > 0.5)

    def contain(self, azimuth_rad: Array) -> Bools:
        """Whether it is likely in the sectors of directions (n,) at `azimuth_rad` [rad]."""
        n = len(self.probability)
        return self.likely[(azimuth_rad / (2 * np.pi) * n).astype(np.int64) % n]

    def __bool__(self) -> bool:
        return bool(self.likely.any())

    @property
    def ranges_rad(self) -> list[tuple[float, float]]:
        """Azimuths [rad] from and to of each range of likely sectors, eastward; across north `to` is the smaller."""
        if self.likely.all():
            return [(0.0, 2 * np.pi)]
        width = 2 * np.pi / len(self.likely)
        starts = np.flatnonzero(self.likely & ~np.roll(self.likely, 1))
        ends = np.flatnonzero(self.likely & ~np.roll(self.likely, -1)) + 1
        if len(ends) and ends[0] <= starts[0]:
            ends = np.roll(ends, -1)
        return [(float(a) * width, float(b) * width) for a, b in zip(starts, ends, strict=True)]

    @property
    def text(self) -> str:
        """Text of the likely ranges of azimuth in degrees."""
        return ", ".join(f"{a:.0f} to {b:.0f}" for a, b in np.degrees(self.ranges_rad)) + " degrees"


@dataclass(frozen=True, eq=False)
class Integrity:
    """Changes of a fix without one group of directions each, for several divisions of the compass into groups."""

    first_azimuth_rad: Array  # (m,) where the groups begin, of all divisions
    separation_m: Array  # (m, 2) of the fix without the group from the fix; nan where the group alone holds it
    part: Array  # (groups,) of the information about the position, in each group of the first division
    protection_level_m: float  # infinite where one group alone holds the fix

    def carriers(self) -> list[int]:
        """Indices of the fewest groups that hold half of the information about the position, the strongest first."""
        order = np.argsort(-self.part, kind="stable")
        count = int(np.searchsorted(np.cumsum(self.part[order]), CARRIED_PART * self.part.sum())) + 1
        return [int(group) for group in order[:count] if self.part[group] > 0.0]


class Explored(NamedTuple):
    """Positions that rows of evidence allow, with the posterior on equal squares: of a search, or of a fix.

    A search that was proven to its end has the places that fit best before its boxes. Positions of a fix are, as its
    `compared_at_m`, those before the turn and the scaling of a round crater by errors of the clock and of its width.
    """

    centres_m: Array  # (n, 2) east and north
    half_m: float  # of the side of a square
    log_weight: Array  # (n,) of the squares in the posterior, up to a constant; of a search the log-density [1/m2]
    dropped_probability: float  # bound of the part of the posterior that the search left out; 1: it has none
    search: str  # "proven" or "beam"


UNPROVEN = (
    "search: beam: the search ended before the proof that no other position fits; the stated one is the best that was "
    "found. --near EAST,NORTH,SIGMA narrows the search"
)


@dataclass(frozen=True, kw_only=True)
class Fix(Value):
    """Posterior of the camera's position."""

    position_enu_m: Array = vector()  # posterior mean of the main mode (east, north) and the camera's height there
    covariance_m2: Array = array(2, 2)  # (east, north) of the main mode; infinite of a method that states none
    radius95_m: float  # circle about the position that holds 95 % of the posterior
    radius999_m: float
    modes: tuple[Mode, ...]  # heaviest first; weights sum to 1
    # Where skyline and evidence are compared, on the ground and under the sky of the evidence; nan: at the position.
    # Errors of the clock and of a crater's width that the evidence shows move the position away from there; in a round
    # crater that of the clock spreads it over an arc, whose mean lies beside it.
    compared_at_m: Array = array(2, default=np.nan, may_be_nan=True)
    ambiguous: bool  # modes outside the main mode's 99.9 % circle hold more than 1 %
    dropped_probability: float | None = None  # bound on what the search left out of the posterior; None: none below 1
    search: str = "proven"  # no other position fits; "beam": not proven; "approximate": no posterior. Of a first look,
    # if there was one: the second begins with its points
    horizon_error_rad: float = 0.0  # common to all azimuths: how much higher the true horizon is than the map's
    clock: ClockError | None = None  # as the evidence shows it; None: not estimated
    blocked: Sectors | None = None  # where the skyline is not the map's: something on no map hides it, or it lies below
    # the map's; None: nowhere
    integrity: Integrity | None = None  # None: not assessed, of several positions or without a posterior
    raised_rad: Array | None = None  # (sectors,) rise of the skyline above the map's by shared errors, waves and posts
    unstated: tuple[UnstatedFact, ...] = ()  # the one that widens the circle most first
    shown: tuple[ShownError, ...] = ()  # errors beyond the defaults
    exact_map_radius999_m: float | None = None  # if the map had no waves; None: it has none
    lit: Sectors | None = None  # where the edge of the sky's light is not the skyline; None: nowhere
    support: Explored | None = None  # of the posterior, for a later fix by more rows of the image; None: there are none

    def __post_init__(self) -> None:
        super().__post_init__()
        if np.isnan(self.compared_at_m).any():
            object.__setattr__(self, "compared_at_m", self.position_enu_m[:2])

    @property
    def is_approximate(self) -> bool:
        """Whether the method has no posterior: its error is larger than the evidence allows."""
        return self.search == "approximate"

    @property
    def cautions(self) -> list[str]:
        """Warning for the user after a search that was not proven to its end; empty after any other."""
        return [UNPROVEN] if self.search == "beam" else []
