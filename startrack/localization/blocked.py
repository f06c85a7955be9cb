"""Azimuths in which something on no map hides stars: found beside a fix, to be left out of the evidence and stated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.localization.likelihood import SECTOR_RAD
from startrack.localization.ridge import MOST_RISE_RAD, find_ridge
from startrack.terrain import Terrain
from startrack.types import Array, Bools, Evidence, Fix, Ints

LEVELS_RAD = np.radians([0.15, 0.4, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0, 8.0, 11.0, 15.0])  # above the map's skyline
HIGH_RAD = np.radians([15.0, 25.0, 35.0, 45.0, 55.0, 90.0])  # the position does not depend on stars so high
MAP_SIGMAS = 3.0  # of the map's horizon, below which stars are not counted
SECTOR_COST_NATS = 0.3  # by which each sector of a patch must gain, in the mean
MIN_GAIN_NATS = 24.0  # of a patch; a million patches are tried, and true rows of any reach 24 in one of 10^10
MIN_LLR, MOST_NATS = 3.0, 8.0  # of a row: faint stars together err beside a bright one; one star is no patch
TAKEN_NATS = 1e6  # in place of the gains of sectors found already
MARGIN, FLANK_PART = 1, 0.15  # sectors left out on either side, and part of the patch: a ridge's flanks are too low
SKY_MARGIN = 6  # sectors beside a patch whose light of the sky is not used: it shows flanks that stars do not
COUNT = round(2 * np.pi / SECTOR_RAD)
SAMPLES = 3 * COUNT  # of the map's skyline; the highest of three neighbours counts


@dataclass(frozen=True, eq=False)
class Blocked:
    """Parts of the view that something on no map blocks, in sectors (COUNT,) of azimuth from north eastward."""

    whole: Bools  # all of the sector
    high: Bools  # what stands high above the skyline
    high_from_rad: Array  # elevation where that begins
    risen: bool  # whether part of it shows the skyline higher than the map, rather than stars missing above it

    def hides(self, azimuth_rad: Array, elevation_rad: Array) -> Bools:
        """Whether directions (n,), `azimuth_rad` and `elevation_rad`, are in the blocked parts."""
        sector = _sector_of(azimuth_rad)
        return np.asarray(self.whole[sector] | (self.high[sector] & (elevation_rad > self.high_from_rad[sector])))

    def beside(self, azimuth_rad: Array) -> Bools:
        """Whether the skyline at azimuths `azimuth_rad` (n,) is in a patch or close to one."""
        near = self.whole
        for side in (-1, 1):
            for step in range(1, SKY_MARGIN + 1):
                near = near | np.roll(self.whole, side * step)
        return np.asarray(near[_sector_of(azimuth_rad)])

    def __bool__(self) -> bool:
        return bool(self.whole.any() or self.high.any())

    def same_as(self, other: Blocked | None) -> bool:
        """Whether the sectors are those of `other`."""
        return other is not None and bool((self.whole == other.whole).all() and (self.high == other.high).all())

    @property
    def width_rad(self) -> float:
        """Total width in which the skyline is blocked."""
        return float(2 * np.pi * np.mean(self.whole))

    @property
    def ranges_rad(self) -> list[tuple[float, float]]:
        """From and to of each range in which the skyline is blocked, eastward; across north `to` is the smaller."""
        if self.whole.all():
            return [(0.0, 2 * np.pi)]
        starts = np.flatnonzero(self.whole & ~np.roll(self.whole, 1))
        ends = np.flatnonzero(self.whole & ~np.roll(self.whole, -1)) + 1
        if len(ends) and ends[0] <= starts[0]:
            ends = np.roll(ends, -1)
        return [(float(a) * SECTOR_RAD, float(b) * SECTOR_RAD) for a, b in zip(starts, ends, strict=True)]

    @property
    def text(self) -> str:
        """The ranges in words."""
        if not self.whole.any():
            return "none of the skyline, but sky above it"
        return ", ".join(f"{a:.0f} to {b:.0f}" for a, b in np.degrees(self.ranges_rad)) + " degrees"


def find_blocked(evidence: Evidence, fix: Fix, terrain: Terrain) -> Blocked | None:
    """The parts of the view that something on no map blocks.

    There rows of the `evidence` above the map's skyline are hidden together, or the skyline rises over a range of
    azimuths. `fix` is a position on the `terrain` found with them. None where nothing is blocked.
    """
    position, azimuths = fix.position_enu_m[None, :2], np.linspace(0.0, 2 * np.pi, SAMPLES, endpoint=False)
    traced = np.asarray(terrain.horizon_rad(position, azimuths)).ravel() + fix.horizon_error_rad
    highest = np.maximum(np.maximum(np.roll(traced, 1), np.roll(traced, -1)), traced)
    sigma = np.broadcast_to(np.asarray(terrain.horizon_sigma_rad(position, azimuths)).ravel(), SAMPLES)
    whole, high = _find_missing(evidence, highest, sigma)
    about = np.abs(evidence.elevation_rad - traced[_sample_of(evidence.azimuth_rad)]) < MOST_RISE_RAD
    rows = evidence.take(about & ~whole[_sector_of(evidence.azimuth_rad)])
    skyline, error = (np.interp(rows.azimuth_rad, azimuths, one, period=2 * np.pi) for one in (traced, sigma))
    ridge = find_ridge(rows, rows.elevation_rad - skyline, error, COUNT)
    high_from = highest.reshape(COUNT, -1).max(axis=1) + HIGH_RAD[0]
    found = Blocked(whole | ridge, high, high_from, risen=bool(ridge.any()))
    return found if found else None


def _find_missing(evidence: Evidence, skyline_rad: Array, sigma_rad: Array) -> tuple[Bools, Bools]:
    """Sectors (COUNT,) with patches of missing stars, low and high above the skyline (SAMPLES,) of that sigma."""
    which = np.flatnonzero(np.abs(evidence.llr) > MIN_LLR)
    azimuth = evidence.azimuth_rad[which]
    sample = _sample_of(azimuth)
    above = evidence.elevation_rad[which] - skyline_rad[sample]
    counted = above > LEVELS_RAD[0] + MAP_SIGMAS * sigma_rad[sample]
    above, sector = above[counted], _sector_of(azimuth[counted])
    hidden = np.minimum(-evidence.llr[which[counted]], MOST_NATS)
    low, high = (_find_patches(_sum_cells(levels, sector, above, hidden)) for levels in (LEVELS_RAD, HIGH_RAD))
    return low, high


def _sum_cells(levels: Array, sector: Ints, above: Array, hidden: Array) -> Array:
    """Sums (COUNT, levels - 1) of `hidden` (n,) in cells of sectors and levels above the skyline."""
    cells = len(levels) - 1
    level = np.searchsorted(levels, above) - 1
    inside = (level >= 0) & (level < cells)
    cell = sector[inside] * cells + level[inside]
    return np.asarray(np.bincount(cell, weights=hidden[inside], minlength=COUNT * cells).reshape(COUNT, cells))


def _sample_of(azimuth_rad: Array) -> Ints:
    return np.asarray(np.rint(azimuth_rad * (SAMPLES / (2 * np.pi))).astype(np.int64) % SAMPLES)


def _sector_of(azimuth_rad: Array) -> Ints:
    return np.asarray((azimuth_rad / (2 * np.pi) * COUNT).astype(np.int64) % COUNT)


def _find_patches(gain: Array) -> Bools:
    """Sectors (n,) with a patch of great gain, a rectangle in the gains (n, levels) of being hidden."""
    found = np.zeros(len(gain), dtype=bool)
    sums = np.concatenate([np.zeros((len(gain), 1)), np.cumsum(gain, axis=1)], axis=1)
    low, high = np.triu_indices(sums.shape[1], 1)
    score = sums[:, high] - sums[:, low] - SECTOR_COST_NATS
    while True:
        start, end, total = _best_run(score)
        if total < MIN_GAIN_NATS:
            break
        margin = MARGIN + round(FLANK_PART * (end - start))
        found[np.arange(start - margin, end + margin) % len(gain)] = True
        score[np.arange(start, end) % len(gain)] = -TAKEN_NATS
    return found


def _best_run(score: Array) -> tuple[int, int, float]:
    """First and end index around the circle of the rows (n, k) whose sum in one column is the largest; that sum."""
    n = len(score)
    sums = np.concatenate([np.zeros((1, score.shape[1])), np.cumsum(np.concatenate([score, score]), axis=0)])
    gain = sums - np.minimum.accumulate(sums, axis=0)
    end, column = np.unravel_index(int(np.argmax(gain)), gain.shape)
    start = int(np.argmin(sums[: end + 1, column]))
    return max(start, int(end) - n), int(end), float(gain[end, column])
