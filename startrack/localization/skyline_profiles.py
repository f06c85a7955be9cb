"""How well each height of the skyline explains the rows of each sector of azimuth: stars and the sky's light alike.

A height x is measured from the skyline that the map gives at a reference position, which the skyline follows within a
sector. A star above the skyline contributes its llr, one below it nothing; light of the sky contributes as in
`Evidence`. The sum over the rows of a sector is F(x); what counts is F less the logarithm R of the mean of exp F over
all heights of the window: the evidence for x against a skyline that is anywhere.
"""

from __future__ import annotations

from itertools import pairwise
from math import erf, sqrt
from typing import Any

import numpy as np

from startrack.core.types import SECTORS, Array, Evidence, Ints, sector_of
from startrack.kernels.library import kernel
from startrack.localization.profile_cells import HIGH_RAD, LOW_RAD, Cells, Profiles, declare, integrate_cells, take
from startrack.localization.sky_profiles import EDGE_SIGMAS, SkyProfiles

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


def profiles_of(
    rows: Evidence, above_rad: Array, map_sigma_rad: Array, window_rad: tuple[float, float] = (LOW_RAD, HIGH_RAD)
) -> Profiles:
    """Profiles of rows (n,) that stand `above_rad` (n,) the skyline; map errors (SECTORS,) are averaged over.

    `window_rad`: lowest and highest height.
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
    beside_light = np.where(step > 0.0, np.sqrt(own), 0.0)  # the edges of stars, which the light does not share
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
