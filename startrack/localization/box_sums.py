"""Sums of rows over elevation: bounds and averages of the likelihood over boxes."""

from __future__ import annotations

from dataclasses import dataclass
from math import log

import numpy as np

from startrack.core.kernels import njit
from startrack.core.types import Array, Evidence, Ints
from startrack.localization.sector_likelihood import CERTAIN_SIGMAS, SECTOR_STEP, Sectors, row_limits
from startrack.terrain import Terrain, require_bounds

NARROWEST_RAD = 1e-6  # of a range of horizons
TRACED_EVERY = 3  # sectors: a traced horizon costs a hundred times a look-up
ROWS_PER_SECTOR = 30  # sparse evidence is averaged over wider sectors, which hold so many rows on average


@dataclass(frozen=True)
class PrefixSums:
    """Rays sorted by sector and elevation, with running sums of what they contribute."""

    evidence: Evidence  # sorted
    sector: Ints  # (n,) of the sorted rays
    key: Array  # (n,) sector and elevation in one ascending number
    total: Array  # (n + 1,) running sum of the llr
    least: Array  # (n + 1,) of the least contribution of each row, over all visible fractions
    most: Array  # (n + 1,) of the greatest
    ends: Ints  # (sectors,) one past the last ray of each
    sigma_rad: Array  # (sectors,) largest edge sigma

    @classmethod
    def from_sectors(cls, sectors: Sectors) -> PrefixSums:
        """Of the rows in their sectors."""
        evidence, sector = sectors.evidence.take(sectors.order), sectors.sector[sectors.order]
        least, most = row_limits(evidence)
        sigma = np.zeros(sectors.count)
        np.maximum.at(sigma, sector, evidence.edge_sigma_rad)
        return cls(
            evidence=evidence,
            sector=sector,
            key=SECTOR_STEP * sector + evidence.elevation_rad,
            total=_running_sum(evidence.llr),
            least=_running_sum(least),
            most=_running_sum(most),
            ends=np.searchsorted(sector, np.arange(sectors.count), side="right"),
            sigma_rad=sigma,
        )

    def open_rays(self, terrain: Terrain, centres_m: Array, half_m: float) -> tuple[Ints, Ints]:
        """First and one past the last ray (n, sectors) that the horizon may meet somewhere in the boxes (n, 2).

        Rays of a sector below these are hidden from every position in the box, and rays above are visible.
        """
        count = len(self.ends)
        middle = (2 * np.arange(count) + 1) * np.pi / count
        boxes = centres_m[:, None, :]
        low, high = terrain.horizon_bounds_rad(boxes, np.array(half_m), middle, np.pi / count)
        require_bounds(terrain, low, high)
        map_sigma = terrain.max_horizon_sigma_rad(boxes, half_m, middle, np.pi / count)
        first, last = np.empty((2, *low.shape), dtype=np.int64)
        sigma = np.array(np.broadcast_to(map_sigma, low.shape), dtype=np.float64)
        _find_open(
            self.key,
            self.ends,
            np.ascontiguousarray(low),
            np.ascontiguousarray(high),
            sigma,
            self.sigma_rad,
            first,
            last,
        )
        return first, last

    def sums(self, first: Ints, last: Ints) -> tuple[Array, Array, Array]:
        """Contributions (n, sectors): of the certainly visible rays, and least and greatest of the open ones."""
        return (
            self.total[self.ends] - self.total[last],
            self.least[last] - self.least[first],
            self.most[last] - self.most[first],
        )

    def pairs(self, first: Ints, last: Ints) -> tuple[Ints, Ints]:
        """Every open (box, ray) pair (m,), (m,)."""
        count = (last - first).ravel()
        box = np.repeat(np.arange(first.shape[0]), (last - first).sum(axis=1))
        step = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        return box, np.repeat(first.ravel(), count) + step


@njit(cache=True)
def _find_open(key, ends, low, high, map_sigma, sigma, first, last) -> None:  # type: ignore[no-untyped-def]
    """Fill first and last (n, sectors) with the rays of each sector that may be between `low` and `high` [rad].

    Beyond these (n, sectors) by sigmas of the map (n, sectors) and of the rays' edges (sectors,).
    """
    for n in range(len(low)):
        begin = 0
        for s in range(len(ends)):
            end = ends[s]
            margin = CERTAIN_SIGMAS * np.sqrt(sigma[s] * sigma[s] + map_sigma[n, s] * map_sigma[n, s])
            for side in range(2):
                wanted = (high[n, s] + margin if side else low[n, s] - margin) + SECTOR_STEP * s
                a, b = begin, end
                while a < b:
                    middle = (a + b) >> 1
                    if key[middle] < wanted or (side and key[middle] == wanted):
                        a = middle + 1
                    else:
                        b = middle
                if side:
                    last[n, s] = a
                else:
                    first[n, s] = a
            begin = end


def _running_sum(values: Array) -> Array:
    return np.concatenate([[0.0], np.cumsum(values)])


@dataclass(frozen=True)
class BoxAverage:
    """Log-likelihood of boxes if each sector's horizon is equally likely anywhere between its bounds, independently.

    It is neither a bound nor exact, but as good for large boxes as for small ones: it ranks boxes of one size. A
    sector's likelihood is a step function of the elevation of its horizon, so its mean is a difference of a running
    integral.
    """

    key: Array  # (m,) elevations at which the likelihood of a sector steps, ascending within each sector
    integral: Array  # (m,) of the likelihood over the elevation, up to there
    starts: Ints  # (sectors + 1,) first key of each sector
    epsilon: float

    @classmethod
    def from_evidence(cls, evidence: Evidence, width_rad: float, epsilon: float) -> BoxAverage:
        """From rows of evidence in sectors of at least the given width [rad]."""
        width = max(width_rad, 2 * np.pi * ROWS_PER_SECTOR / max(len(evidence), 1))
        sectors = Sectors.from_evidence(evidence, min(width, np.pi / 2), epsilon)
        return cls.from_sectors(sectors, PrefixSums.from_sectors(sectors))

    @classmethod
    def from_sectors(cls, sectors: Sectors, sums: PrefixSums) -> BoxAverage:
        """From the sectors and their prefix sums (of one part a sector)."""
        visible = sums.total[sums.ends[sums.sector]] - sums.total[:-1]  # with a horizon just below the ray
        below = np.exp(np.minimum(visible - sectors.ceiling[sums.sector], 0.0))
        hidden = np.exp(-sectors.ceiling)  # the whole sector
        middle = SECTOR_STEP * np.arange(sectors.count)
        key = np.concatenate([sums.key, middle - 0.5 * SECTOR_STEP, middle + 0.5 * SECTOR_STEP])
        value = np.concatenate([below, np.zeros(sectors.count), hidden])  # from the key before up to this one
        order = np.argsort(key)
        steps = value[order[1:]] * np.diff(key[order])
        rows = np.bincount(sums.sector, minlength=sectors.count) + 2
        elevation = key[order] - np.repeat(middle, rows)
        starts = np.concatenate([[0], np.cumsum(rows)])
        return cls(elevation, np.concatenate([[0.0], np.cumsum(steps)]), starts, sectors.epsilon)

    def score(self, terrain: Terrain, centres_m: Array, half_m: float, traced: bool = False) -> Array:
        """Log-likelihood (n,) of the boxes |dx|, |dy| <= half_m about the centres (n, 2) [m].

        With bounds of the horizon, or, with `traced`, its estimated spread about the horizon of each centre in every
        third sector.
        """
        count = len(self.starts) - 1
        sector = np.arange(0, count, TRACED_EVERY if traced else 1)
        azimuth, within = (2 * sector + 1) * np.pi / count, np.pi / count
        boxes = centres_m[:, None, :]
        if traced:
            middle, width = terrain.horizon_spread_rad(boxes, half_m, azimuth)
            low, high = middle - width, middle + width
        else:
            low, high = terrain.horizon_bounds_rad(boxes, np.array(half_m), azimuth, within)
            require_bounds(terrain, low, high)
        if not terrain.hard_edges:
            wider = terrain.max_horizon_sigma_rad(boxes, half_m, azimuth, within)
            low, high = low - wider, high + wider
        found = np.empty(len(centres_m))
        _average(self.key, self.integral, self.starts, self.epsilon, sector, low, high, found)
        return found


@njit(cache=True)
def _average(key, integral, starts, epsilon, sector, low, high, found):  # type: ignore[no-untyped-def]
    """Fill found (n,) with the log-likelihoods of boxes with horizon bounds low, high (n, m) in sectors (m,)."""
    least = max(epsilon, 1e-300)
    for n in range(len(found)):
        total = 0.0
        for k in range(len(sector)):
            s, a, b = sector[k], low[n, k] - NARROWEST_RAD, high[n, k] + NARROWEST_RAD
            mean = (_integral(key, integral, starts, s, b) - _integral(key, integral, starts, s, a)) / (b - a)
            total += log((1.0 - epsilon) * min(max(mean, 0.0), 1.0) + least)
        found[n] = total


@njit(cache=True, inner=True)
def _integral(key, integral, starts, s, elevation):  # type: ignore[no-untyped-def]
    """The sector's integral at an elevation, linear between the keys."""
    first, last = starts[s], starts[s + 1] - 1
    while last - first > 1:
        middle = (first + last) >> 1
        if key[middle] <= elevation:
            first = middle
        else:
            last = middle
    return integral[first] + (elevation - key[first]) * (integral[last] - integral[first]) / (key[last] - key[first])
