"""Log-likelihoods of the rows of each sector of azimuth by the height of the skyline: stars and sky's light alike.

A height x is measured from the skyline that the map gives at a reference position, which the skyline follows within a
sector. A star above the skyline contributes its llr, one below it nothing; light of the sky contributes as in
`Evidence`. The sum over the rows of a sector is F(x); what counts is F less the logarithm R of the mean of exp F over
all heights of the window: the evidence for x against a skyline that is anywhere. Its moments give linear solutions.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import erf, sqrt
from typing import Any, NamedTuple

import numpy as np

from startrack.core.statistics import NORMAL_CDF
from startrack.core.types import SECTORS, Array, Evidence, Ints, sector_of
from startrack.kernels.library import kernel

LOW_RAD, HIGH_RAD = np.radians(-12.0), np.radians(20.0)  # window of heights: beyond it a skyline is no skyline
GUIDE = 256  # heights of the guide to the cells, to each side
EDGE_SIGMAS = 8.0  # beyond this the edge of a single row is not computed, and splines of rows are constant
KNOT_SIGMAS = 0.2  # of the edge: distance of the knots; a cubic errs by 0.03 nats in a sector of 2e4 nats
ROW_NATS = 6.0  # most that one star counts: one in 400 is variable, misnamed or not in the catalogue
SKY_STEP_PX = 0.1  # of the edge's width: cells of the sky's light, quadratic in each, right to 0.02 nats
SOFT_BINS = np.linspace(-3.5, 3.5, 15)  # of a normal error of the map, whose mean is taken bin by bin
SOFT_WEIGHTS = np.array([0.5 * (erf(b / sqrt(2.0)) - erf(a / sqrt(2.0))) for a, b in pairwise(SOFT_BINS)])
SOFT_WEIGHTS /= SOFT_WEIGHTS.sum()
SOFT_REACH_RAD = np.radians(0.3)  # beside EDGE_SIGMAS, about the map's skyline, where its error is averaged over
LEAST_MEAN = 1e-8  # of exp (F - R) over such an error: differences of the integral have no more digits
SOFT_STEP, MOST_SOFT_CELLS = 0.5, 120.0  # of the error: cells of the average; at most, to each side
LEAST_SOFT_CELLS = 32  # together: as many as an error has that the window does not cut off
CELLS = "first x left right bend"  # of Profiles, which the kernels make
REACH_RAD = np.radians(1.2)  # of heights about the reference's skyline
LEAST_SIGMA_RAD, LEAST_SHOWN_PART = 1e-7, 1e-9
FREEDOM = 3.0  # degrees of freedom of the residuals: obstacles and wrong rows do not lead the solution
REWEIGHTINGS = 6


class Profiles(NamedTuple):
    """F of each sector in cells of heights, quadratic in each, as the kernels read it.

    Cell k reaches from x[k] to x[k + 1]; the last one of a sector is a sentinel. F is the log-likelihood of a skyline
    by the rows in the window of heights, R the logarithm of its mean over the window, H the sum of the stars above the
    window, and N the greater of R + H and 0, by which all log-likelihoods of a sector are less: none overflows.
    """

    first: Ints  # (SECTORS + 1,) cell where each sector begins
    x: Array  # (m,) [rad]
    left: Array  # (m,) F at the begin of a cell
    right: Array  # (m,) and at its end
    bend: Array  # (m,) 4 (F in the middle - mean of both)
    integral: Array  # (m,) of exp(F - free) from the lowest height to x
    free: Array  # (SECTORS,) R
    guide: Ints  # (SECTORS, 2 GUIDE + 1) cells of heights closer to each other about 0, where a search begins
    scale: Array  # (SECTORS,) exp(R + H - N): of a skyline that is anywhere
    hidden: Array  # (SECTORS,) exp(-N): of a sector in which everything is hidden, the stars above the window too
    offset: Array  # (SECTORS,) N

    def scaled(self, nats: Array) -> Profiles:
        """Copy whose likelihoods in each sector are less by so many `nats` (SECTORS,) more."""
        less = np.exp(-nats)
        return self._replace(scale=self.scale * less, hidden=self.hidden * less, offset=self.offset + nats)


FORMS = {"first": "int64[sectors + 1]", "guide": "int32[sectors, guides]"}
FORMS |= dict.fromkeys(("x", "left", "right", "bend", "integral"), "float64[m]")
FORMS |= dict.fromkeys(("free", "scale", "hidden"), "float64[sectors]")


def declare(names: str, prefix: str = "", size: str = "m") -> list[str]:
    """Declarations of the arrays of Profiles with these `names`, for a kernel; `size`: name of the number of cells."""
    return [f"{prefix}{name}: {FORMS[name].replace('[m]', f'[{size}]')}" for name in names.split()]


def take(profiles: Profiles, names: str) -> list[Array]:
    """The arrays of `profiles` with these `names`, as `declare` declares them."""
    return [getattr(profiles, name) for name in names.split()]


Cells = tuple[Ints, Array, Array, Array, Array, Array, Array, Any]  # the first fields of Profiles


def integrate_cells(first: Ints, x: Array, left: Array, right: Array, bend: Array, width: float) -> Cells:
    """The cells with `integral`, `free` and the guide, for a window of that `width`; each cell by Simpson's rule."""
    sectors = len(first) - 1
    integral, free = np.zeros(len(x)), np.zeros(sectors)
    guide = np.empty((sectors, 2 * GUIDE + 1), np.int32)
    _integrate(first, x, left, right, bend, width, HIGH_RAD, integral, free, guide)
    return first, x, left, right, bend, integral, free, guide


_integrate = kernel(
    "integrate_cells", *declare("first x left right bend"), "width: float64", "highest: float64",
    "integral: out float64[m]", "free: out float64[sectors]", "guide: out int32[sectors, guides]",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class SkyProfiles:
    """Log-likelihoods of the horizon's elevation at each of m azimuths, from rows of extended light.

    Rows of one azimuth stand or fall with the same horizon.
    """

    row: Ints  # (m,) one row of each azimuth
    low_rad: Array  # (m,) elevation of the first knot
    step_rad: Array  # (m,) between knots
    values: Array  # (m, knots)

    @classmethod
    def from_rows(cls, evidence: Evidence, rows: Ints) -> SkyProfiles:
        """Profiles by those `rows` (k,) of the evidence that hold extended light."""
        rows = rows[np.lexsort((evidence.elevation_rad[rows], evidence.azimuth_rad[rows]))]
        azimuth, elevation = evidence.azimuth_rad[rows], evidence.elevation_rad[rows]
        first = np.flatnonzero(np.diff(azimuth, prepend=-1.0) > 0)
        last = np.append(first[1:], len(rows)) - 1
        edge = evidence.edge_sigma_rad[rows[first]]
        around = EDGE_SIGMAS * edge
        low = elevation[first] - around
        span = elevation[last] - elevation[first] + 2 * around
        knots = max(int(np.ceil(np.max(span / (KNOT_SIGMAS * edge)))) + 1, 4)
        step = span / (knots - 1)
        values = np.empty((len(first), knots))
        _fill_profiles(
            elevation, evidence.llr[rows], evidence.extended_nats[rows], evidence.edge_sigma_rad[rows], first, last,
            low, step, NORMAL_CDF, values,
        )  # fmt: skip
        return cls(rows[first], low, step, values)


# Fills values (m, knots) with sums of l V + c V (1 - V) / 2 over the rows from first to last (m,).
_fill_profiles = kernel(
    "fill_profiles", "elevation: float64[n]", "llr: float64[n]", "extended: float64[n]", "sigma: float64[n]",
    "first: int64[m]", "last: int64[m]", "low: float64[m]", "step: float64[m]", f"cdf: float64[{len(NORMAL_CDF)}]",
    "values: out float64[m, knots]",
)  # fmt: skip


def profiles_of(
    rows: Evidence, above_rad: Array, map_sigma_rad: Array, window_rad: tuple[float, float] = (LOW_RAD, HIGH_RAD)
) -> Profiles:
    """Profiles of rows (n,) that stand `above_rad` (n,) [rad] above the skyline, averaged over map errors (SECTORS,).

    `window_rad`: lowest and highest height; another one than the usual only where there are no errors to average over.
    """
    extended = rows.extended_nats * rows.edge_sigma_rad > 0.0
    star = np.flatnonzero(~extended & (above_rad > window_rad[0]) & (above_rad < window_rad[1]))
    order = star[np.argsort(sector_of(rows.azimuth_rad[star]) * 100.0 + above_rad[star])]
    sector = sector_of(rows.azimuth_rad[order])
    llr = np.clip(rows.llr[order], -ROW_NATS, ROW_NATS)
    cells = _fill_cells(above_rad[order], llr, np.searchsorted(sector, np.arange(SECTORS + 1)), *window_rad)
    low, step, cell, sky = _sky_knots(rows, above_rad, np.flatnonzero(extended))
    count = np.maximum(np.bincount(sector, minlength=SECTORS), 1)
    own = np.bincount(sector, weights=np.square(rows.edge_sigma_rad[order]), minlength=SECTORS) / count
    # The edges of stars are averaged over before the light is added, which does not share them; else with the map's.
    beside_light = np.where(step > 0.0, np.sqrt(own), 0.0)
    is_high = ~extended & (above_rad >= window_rad[1])
    above = np.zeros(SECTORS)
    np.add.at(above, sector_of(rows.azimuth_rad[is_high]), np.clip(rows.llr[is_high], -ROW_NATS, ROW_NATS))
    found = _average_cells(_with_stars_above(cells, above), beside_light, above)
    if step.any():
        found = _with_stars_above(_add_sky(found, low, step, cell, sky), above)
    return _average_cells(found, np.sqrt(np.square(map_sigma_rad) + np.where(step > 0.0, 0.0, own)), above)


def _average_cells(profiles: Profiles, sigma_rad: Array, above: Array) -> Profiles:
    """The profiles averaged over a normal error (SECTORS,) of the skyline; `above` as in `_with_stars_above`."""
    if not sigma_rad.any():
        return profiles
    return _with_stars_above(_average_over_error(profiles, sigma_rad), above)


def _with_stars_above(cells: Any, above: Any) -> Profiles:
    """Profiles of the first fields as the kernels fill them, and the sums (SECTORS,) of stars above the window."""
    first, x, left, right, bend, integral, free, guide = cells[:8]
    offset = np.maximum(free + above, 0.0)
    return Profiles(
        first, x, left, right, bend, integral, free, guide, np.exp(free + above - offset), np.exp(-offset), offset
    )


def _sky_knots(rows: Evidence, above_rad: Array, which: Ints) -> tuple[Array, Array, Array, Array]:
    """First knot, step, cells' step (SECTORS,) and values (SECTORS, knots) of the sky's light; step 0: none."""
    low, step, cell = np.zeros((3, SECTORS))
    if not len(which):
        return low, step, cell, np.zeros((SECTORS, 4))
    level = Evidence(
        azimuth_rad=rows.azimuth_rad[which], elevation_rad=above_rad[which], llr=rows.llr[which],
        edge_sigma_rad=rows.edge_sigma_rad[which], extended_nats=rows.extended_nats[which],
    )  # fmt: skip
    sky = SkyProfiles.from_rows(level, np.arange(len(which)))
    at = sector_of(level.azimuth_rad[sky.row])
    values = np.zeros((SECTORS, sky.values.shape[1]))
    low[at], step[at], values[at] = sky.low_rad, sky.step_rad, sky.values
    cell[at] = SKY_STEP_PX * level.edge_sigma_rad[sky.row]
    return low, step, cell, values


def _fill_cells(above: Array, llr: Array, starts: Ints, lowest: float, highest: float) -> Cells:
    """Cells between the stars of a sector, at heights `above` (n,) in order; each sector's first star: `starts`."""
    sectors = len(starts) - 1
    first, (x, left) = np.empty(sectors + 1, np.int64), np.empty((2, len(above) + 2 * sectors))
    n = _cells_of_stars(above, llr, starts, lowest, highest, first, x, left)
    left = left[:n].copy()
    return integrate_cells(first, x[:n].copy(), left, left.copy(), np.zeros(n), highest - lowest)


def _add_sky(profiles: Profiles, sky_low: Array, sky_step: Array, cell: Array, sky_values: Array) -> Cells:
    """The cells divided, in equal widths, where the sky's light shows the skyline, with the values of that light."""
    lit = sky_step > 0.0
    more = ((sky_values.shape[1] - 1) * sky_step[lit] / cell[lit]).astype(np.int64) + 3
    first, made = np.empty(len(lit) + 1, np.int64), np.empty((4, len(profiles.x) + int(more.sum())))
    n = _cells_of_sky(*take(profiles, CELLS), sky_low, sky_step, cell, sky_values, first, *made)
    width = profiles.x[profiles.first[1] - 1] - profiles.x[0]
    x, left, right, bend = (one[:n].copy() for one in made)
    return integrate_cells(first, x, left, right, bend, float(width))


def _average_over_error(profiles: Profiles, sigma: Array) -> Cells:
    """The cells with exp F averaged over a normal error of the map's skyline (SECTORS,); far off it stays as it is."""
    reach = SOFT_REACH_RAD + EDGE_SIGMAS * sigma
    low, high = np.maximum(-reach, LOW_RAD), np.minimum(reach, HIGH_RAD)
    step = np.maximum(SOFT_STEP * sigma, reach / MOST_SOFT_CELLS)
    counts = np.maximum(((high - low) / step).astype(np.int64), LEAST_SOFT_CELLS)
    room = len(profiles.x) + int(counts.sum()) + 4 * len(sigma)
    first, made = np.empty(len(sigma) + 1, np.int64), np.empty((4, room))
    n = _cells_of_error(
        *take(profiles, f"{CELLS} integral free guide"), sigma, low, high, counts, HIGH_RAD, SOFT_BINS, SOFT_WEIGHTS,
        LEAST_MEAN, np.empty(len(SOFT_BINS), np.int64), first, *made,
    )  # fmt: skip
    x, left, right, bend = (one[:n].copy() for one in made)
    return integrate_cells(first, x, left, right, bend, HIGH_RAD - LOW_RAD)


_MADE = ("made_first: out int64[sectors + 1]", *(f"made_{name}: out float64[room]" for name in CELLS.split()[1:]))
_cells_of_stars = kernel(
    "fill_cells", "above: float64[stars]", "llr: float64[stars]", "starts: int64[sectors + 1]", "lowest: float64",
    "highest: float64", *_MADE[:3], result="int64",
)  # fmt: skip
_cells_of_sky = kernel(
    "add_sky", *declare(CELLS), "low: float64[sectors]", "step: float64[sectors]", "cell: float64[sectors]",
    "values: float64[sectors, knots >= 4]", *_MADE, result="int64",
)  # fmt: skip
_cells_of_error = kernel(
    "average_over_error", *declare(f"{CELLS} integral free guide"), "sigma: float64[sectors]", "low: float64[sectors]",
    "high: float64[sectors]", "counts: int64[sectors]", "highest: float64", "ends: float64[between + 1]",
    "weights: float64[between]", "least_mean: float64", "scratch: out int64[between + 1]", *_MADE, result="int64",
)  # fmt: skip


class SectorMoments(NamedTuple):
    """Heights above the reference's skyline; a sector that shows nothing has the window's own variance."""

    mean_rad: Array  # (SECTORS,)
    variance_rad2: Array  # (SECTORS,)

    @property
    def information(self) -> Array:
        """Part (SECTORS,) of the window's variance that the rows take away; next to 0 where they show nothing."""
        return np.clip(1.0 - 3.0 * self.variance_rad2 / REACH_RAD**2, LEAST_SHOWN_PART, 1.0)

    def mix(self, other: SectorMoments, part: Array) -> SectorMoments:
        """Moments of the distribution that is the `other` one with a probability `part` (SECTORS,)."""
        mean = (1.0 - part) * self.mean_rad + part * other.mean_rad
        own, others = (np.square(one.mean_rad - mean) + one.variance_rad2 for one in (self, other))
        return SectorMoments(mean, (1.0 - part) * own + part * others)


def measure_moments(profiles: Profiles) -> SectorMoments:
    """Moments of all sectors, every height within REACH_RAD equally likely before."""
    mean, variance = np.empty(len(profiles.free)), np.empty(len(profiles.free))
    _fill_moments(*take(profiles, f"{CELLS} guide"), HIGH_RAD, REACH_RAD, mean, variance)
    return SectorMoments(mean, np.maximum(variance, LEAST_SIGMA_RAD**2))


_fill_moments = kernel(
    "fill_moments", *declare(f"{CELLS} guide"), "highest: float64", "reach: float64", "mean: out float64[sectors]",
    "variance: out float64[sectors]",
)  # fmt: skip


def heavy_log_likelihood(moments: SectorMoments, rise_rad: Array) -> float:
    """Log-likelihood of the heights where the skyline rises by `rise_rad` (SECTORS,), with far tails."""
    residual = np.square(moments.mean_rad - rise_rad) / moments.variance_rad2
    return -0.5 * (FREEDOM + 1.0) * float(np.log1p(residual / FREEDOM).sum())


def solve_linear(moments: SectorMoments, design: Array, mean: Array, prior: Array) -> tuple[Array, Array, Array]:
    """Parameters (d,) that explain the heights, their covariance (d, d), and weights (SECTORS,) of the sectors.

    The sectors are weighted as for residuals with far tails.

    Args:
        moments: the heights.
        design: (SECTORS, d) rise of the skyline by one unit of each parameter.
        mean: (d,) of the parameters before.
        prior: (d, d) inverse of their covariance before.
    """
    weight, left = np.ones(len(design)), moments.mean_rad - design @ mean
    for _ in range(REWEIGHTINGS):
        weighted = design * (weight / moments.variance_rad2)[:, None]
        covariance = np.linalg.inv(weighted.T @ design + prior)
        step = covariance @ (weighted.T @ left)
        residual = np.square(left - design @ step) / moments.variance_rad2
        weight = (FREEDOM + 1.0) / (FREEDOM + residual)
    return mean + step, np.asarray(covariance), np.asarray(weight)
