"""Sums of the evidence over elevation in each sector: a box of positions costs two look-ups each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.core.kernels import njit
from startrack.core.types import Array, Evidence, Ints
from startrack.localization.sector_likelihood import SECTOR_STEP, Sectors, row_limits
from startrack.terrain import Terrain, require_bounds

CERTAIN_SIGMAS = 6.0  # a ray farther than this from the horizon is visible or hidden for certain: to 1e-9


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
        margin = CERTAIN_SIGMAS * np.hypot(self.sigma_rad, map_sigma)
        first, last = np.empty((2, *low.shape), dtype=np.int64)
        _find_open(self.key, self.ends, low - margin, high + margin, first, last)
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


@njit(cache=True, nogil=True)
def _find_open(key, ends, low, high, first, last) -> None:  # type: ignore[no-untyped-def]
    """Fill first and last (n, sectors) with the rays of each sector from `low` to `high` (n, sectors) [rad]."""
    for n in range(len(low)):
        begin = 0
        for s in range(len(ends)):
            end = ends[s]
            for side in range(2):
                wanted = (high[n, s] if side else low[n, s]) + SECTOR_STEP * s
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
