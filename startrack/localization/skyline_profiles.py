"""How well each height of the skyline explains the rows of each sector of azimuth: stars and the sky's light alike.

A height x is measured from the skyline that the map gives at a reference position, which the skyline follows within a
sector. A star above the skyline contributes its llr, one below it nothing; light of the sky contributes as in
`Evidence`. The sum over the rows of a sector is F(x); what counts is F less the logarithm R of the mean of exp F over
all heights of the window: the evidence for x against a skyline that is anywhere.
"""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
from math import erf, exp, sqrt
from typing import Any

import numpy as np

from startrack.core.kernels import njit
from startrack.core.types import SECTORS, Array, Evidence, Ints, sector_of
from startrack.localization.profile_cells import HIGH_RAD, LOW_RAD, Profiles, cell_at, integrate_cells, log_at, value_in
from startrack.localization.sky_profiles import EDGE_SIGMAS, SkyProfiles

ROW_NATS = 6.0  # most that one star counts: one in 400 is variable, misnamed or not in the catalogue
SKY_STEP_PX = 0.1  # of the edge's width: cells of the sky's light, quadratic in each, right to 0.02 nats
SOFT_BINS = np.linspace(-3.5, 3.5, 15)  # of a normal error of the map, whose mean is taken bin by bin
SOFT_REACH_RAD = np.radians(0.3)  # beside EDGE_SIGMAS, about the map's skyline, where its error is averaged over
LEAST_MEAN = 1e-8  # of exp (F - R) over such an error: differences of the integral have no more digits
SOFT_STEP, MOST_SOFT_CELLS = 0.5, 120.0  # of the error: cells of the average; at most, to each side
LEAST_SOFT_CELLS = 32  # together: as many as an error has that the window does not cut off


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
    return _with_stars_above(_average_over_error(profiles, sigma_rad, SOFT_BINS), above)


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


@njit(cache=True)
def _cubic(values, at):
    """Value between the knots of a uniform grid; constant beyond its ends."""
    knots = len(values)
    at = min(max(at, 0.0), knots - 1.0)
    j = min(max(int(at), 1), knots - 3)
    u = at - j
    return (
        -values[j - 1] * u * (u - 1) * (u - 2) / 6 + values[j] * (u + 1) * (u - 1) * (u - 2) / 2
        - values[j + 1] * (u + 1) * u * (u - 2) / 2 + values[j + 2] * (u + 1) * u * (u - 1) / 6
    )  # fmt: skip


@njit(cache=True)
def _fill_cells(above, llr, starts, lowest, highest):
    """Cells between the stars of a sector."""
    sectors = len(starts) - 1
    room = len(above) + 2 * sectors
    first = np.zeros(sectors + 1, dtype=np.int64)
    x, left = np.zeros(room), np.zeros(room)
    n = 0
    for s in range(sectors):
        total = 0.0
        for k in range(starts[s], starts[s + 1]):
            total += llr[k]
        x[n], left[n] = lowest, total
        for k in range(starts[s], starts[s + 1]):
            if above[k] > x[n]:
                n += 1
                x[n] = above[k]
            total -= llr[k]
            left[n] = total
        x[n + 1] = highest
        n += 2
        first[s + 1] = n
    left, level = left[:n].copy(), np.zeros(n)
    return integrate_cells(first, x[:n].copy(), left, left.copy(), level, highest - lowest)


@njit(cache=True)
def _add_sky(profiles, sky_low, sky_step, cell, sky_values):
    """The cells divided, in equal widths, where the sky's light shows the skyline, with the values of that light."""
    sectors, knots, room = len(sky_low), sky_values.shape[1], len(profiles.x)
    for s in range(sectors):
        if sky_step[s] > 0.0:
            room += int((knots - 1) * sky_step[s] / cell[s]) + 3
    first = np.zeros(sectors + 1, dtype=np.int64)
    x, left, right, bend = np.zeros(room), np.zeros(room), np.zeros(room), np.zeros(room)
    n = 0
    for s in range(sectors):
        begin, last = profiles.first[s], profiles.first[s + 1] - 1
        sky_at = max(sky_low[s], profiles.x[begin] + cell[s])
        sky_end = min(sky_low[s] + (knots - 1) * sky_step[s], profiles.x[last] - cell[s])
        for k in range(begin, last):
            low, width, at = profiles.x[k], profiles.x[k + 1] - profiles.x[k], profiles.x[k]
            while at < profiles.x[k + 1]:
                following = profiles.x[k + 1]
                if sky_step[s] > 0.0 and sky_at <= sky_end:
                    following = min(following, sky_at)
                x[n] = at
                u, v = (at - low) / width, (following - low) / width
                left[n], right[n] = value_in(profiles, k, u), value_in(profiles, k, v)
                middle = value_in(profiles, k, 0.5 * (u + v))
                if sky_step[s] > 0.0:
                    a, b = (at - sky_low[s]) / sky_step[s], (following - sky_low[s]) / sky_step[s]
                    left[n] += _cubic(sky_values[s], a)
                    right[n] += _cubic(sky_values[s], b)
                    middle += _cubic(sky_values[s], 0.5 * (a + b))
                bend[n] = 4.0 * (middle - 0.5 * (left[n] + right[n]))
                if sky_at <= following:
                    sky_at += cell[s]
                at = following
                n += 1
        x[n] = profiles.x[last]
        n += 1
        first[s + 1] = n
    width = profiles.x[profiles.first[1] - 1] - profiles.x[0]
    return integrate_cells(first, x[:n].copy(), left[:n].copy(), right[:n].copy(), bend[:n].copy(), width)


@njit(cache=True)
def _average_over_error(profiles, sigma, bins):
    """The cells with exp F averaged over a normal error of the map's skyline (SECTORS,); far off it stays as it is."""
    weights, whole, cells = np.empty(len(bins) - 1), 0.0, np.zeros(len(bins), dtype=np.int64)
    for q in range(len(weights)):
        weights[q] = 0.5 * (erf(bins[q + 1] / sqrt(2.0)) - erf(bins[q] / sqrt(2.0)))
        whole += weights[q]
    for q in range(len(weights)):
        weights[q] /= whole
    sectors, room = len(sigma), len(profiles.x)
    low, high, counts = np.zeros(sectors), np.zeros(sectors), np.zeros(sectors, dtype=np.int64)
    for s in range(sectors):
        reach = SOFT_REACH_RAD + EDGE_SIGMAS * sigma[s]
        low[s], high[s] = max(-reach, LOW_RAD), min(reach, HIGH_RAD)
        step = max(SOFT_STEP * sigma[s], reach / MOST_SOFT_CELLS)
        counts[s] = max(int((high[s] - low[s]) / step), LEAST_SOFT_CELLS)
        room += counts[s] + 4
    first = np.zeros(sectors + 1, dtype=np.int64)
    x, left, right, bend = np.zeros(room), np.zeros(room), np.zeros(room), np.zeros(room)
    n = 0
    for s in range(sectors):
        if sigma[s] <= 0.0:
            for k in range(profiles.first[s], profiles.first[s + 1]):
                x[n], left[n], right[n], bend[n] = profiles.x[k], profiles.left[k], profiles.right[k], profiles.bend[k]
                n += 1
            first[s + 1] = n
            continue
        k, last = profiles.first[s], profiles.first[s + 1] - 1
        while k < last and profiles.x[k] < low[s]:
            x[n], left[n], right[n], bend[n] = profiles.x[k], profiles.left[k], profiles.right[k], profiles.bend[k]
            n += 1
            k += 1
        step = (high[s] - low[s]) / counts[s]
        cells[:] = profiles.first[s]
        before = _mean_over(profiles, s, low[s], sigma[s], bins, weights, cells)
        for i in range(counts[s]):
            at = low[s] + i * step
            middle = _mean_over(profiles, s, at + 0.5 * step, sigma[s], bins, weights, cells)
            after = _mean_over(profiles, s, at + step, sigma[s], bins, weights, cells)
            rise = abs(after - before)
            x[n], left[n], right[n], bend[n] = at, before, after, 4.0 * (middle - 0.5 * (before + after))
            if min(before, after) <= middle <= max(before, after):  # the parabola has no peak either
                bend[n] = min(max(bend[n], -rise), rise)
            before = after
            n += 1
        k = last - 1
        if high[s] < HIGH_RAD:
            k = cell_at(profiles.x, profiles.guide, s, high[s])
            x[n], left[n], right[n] = high[s], log_at(profiles, s, high[s]) + profiles.free[s], profiles.right[k]
            n += 1
        for j in range(k + 1, last + 1):
            x[n], left[n], right[n], bend[n] = profiles.x[j], profiles.left[j], profiles.right[j], profiles.bend[j]
            n += 1
        first[s + 1] = n
    return integrate_cells(first, x[:n].copy(), left[:n].copy(), right[:n].copy(), bend[:n].copy(), HIGH_RAD - LOW_RAD)


@njit(cache=True, inner=True)
def _mean_over(profiles, s, height, sigma, bins, weights, cells):
    """Logarithm of the mean of exp F over a normal error about a height.

    `cells` (bins,) hold the ends of the bins about a lower height, from which on they are searched.
    """
    x, integral, free, last = profiles.x, profiles.integral, profiles.free[s], profiles.first[s + 1] - 1
    total, before = 0.0, 0.0
    for q in range(len(bins)):
        at, k = height + bins[q] * sigma, cells[q]
        while k < last - 1 and x[k + 1] <= at:
            k += 1
        cells[q] = k
        after = integral[k] + (min(at, HIGH_RAD) - x[k]) / (x[k + 1] - x[k]) * (integral[k + 1] - integral[k])
        after += max(at - HIGH_RAD, 0.0) * exp(-free)
        if q > 0:
            total += weights[q - 1] * (after - before) / ((bins[q] - bins[q - 1]) * sigma)
        before = after
    return np.log(max(total, LEAST_MEAN)) + free
