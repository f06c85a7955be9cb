"""Prefix sums of the evidence over elevation, per sector or part of one: a box of positions costs two look-ups each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.kernels import njit
from startrack.localization.sector_likelihood import (
    CERTAIN_SIGMAS,
    SECTOR_STEP,
    Sectors,
    elevation_order,
    row_limits,
)
from startrack.terrain import Terrain, require_bounds
from startrack.types import Array, Bools, Evidence, Ints

ROUNDING = 1e-9  # of the keys


@dataclass(frozen=True)
class PrefixSums:
    """Rays sorted by part of a sector and elevation, with running sums of what they contribute."""

    evidence: Evidence  # sorted
    sector: Ints  # (n,) of the sorted rays
    parts: int  # of each sector, looked up one by one
    key: Array  # (n,) part and elevation in one ascending number
    total: Array  # (n + 1,) running sum of the llr
    least: Array  # (n + 1,) of the least contribution of each row, over all visible fractions
    most: Array  # (n + 1,) of the greatest
    ends: Ints  # (sectors x parts,) one past the last ray of each part
    sigma_rad: Array  # (sectors x parts,) largest edge sigma

    @classmethod
    def from_sectors(cls, sectors: Sectors, parts: int = 1) -> PrefixSums:
        e = sectors.evidence
        within = e.azimuth_rad / (2 * np.pi) * sectors.count - sectors.sector
        part = sectors.sector * parts + np.clip(within * parts, 0, parts - 1).astype(np.int64)
        order = sectors.order if parts == 1 else elevation_order(e, part)
        part, llr = part[order], e.llr[order]
        evidence = e.take(order)
        least, most = row_limits(evidence)
        sigma = np.zeros(sectors.count * parts)
        if evidence.edge_sigma_rad.any():
            np.maximum.at(sigma, part, evidence.edge_sigma_rad)
        return cls(
            evidence=evidence,
            sector=part // parts,
            parts=parts,
            key=SECTOR_STEP * part + evidence.elevation_rad,
            total=_running_sum(llr),
            least=_running_sum(least),
            most=_running_sum(most),
            ends=np.searchsorted(part, np.arange(len(sigma)), side="right"),
            sigma_rad=sigma,
        )

    def open_rays(
        self, terrain: Terrain, centres_m: Array, half_m: float, leeway_rad: float = 0.0
    ) -> tuple[Ints, Ints]:
        """First and one past the last ray (n, sectors x parts) that the horizon may meet somewhere in the boxes (n, 2).

        Rays of a part below these are hidden from every position in the box, and rays above are visible, even if all
        elevations change by the leeway [rad].
        """
        count = len(self.ends)
        middle = (2 * np.arange(count) + 1) * np.pi / count
        boxes = centres_m[:, None, :]
        low, high = terrain.horizon_bounds_rad(boxes, np.array(half_m), middle, np.pi / count)
        require_bounds(terrain, low, high)
        map_sigma = terrain.max_horizon_sigma_rad(boxes, half_m, middle, np.pi / count)
        margin = leeway_rad + CERTAIN_SIGMAS * np.hypot(self.sigma_rad, map_sigma)
        first, last = np.empty((2, *low.shape), dtype=np.int64)
        _find_open(self.key, self.ends, low - margin, high + margin, first, last)
        return first, last

    def split(self, whole: PrefixSums, first: Ints, last: Ints) -> tuple[Ints, Ints]:
        """Open rays (n, sectors x parts) of these parts, from those of `whole`: the same rays, one part a sector."""
        ends = []
        for number, leeway in ((first, -ROUNDING), (last, ROUNDING)):  # rather one ray more left open
            sector = np.arange(len(whole.ends))
            key = np.append(whole.key, np.inf)[number] - SECTOR_STEP * sector
            lowest = np.where(number < whole.ends, key, 0.5 * SECTOR_STEP)  # of the rays from this one on
            wanted = np.repeat(lowest + leeway, self.parts, axis=1) + SECTOR_STEP * np.arange(len(self.ends))
            ends.append(np.searchsorted(self.key, wanted.ravel(), side="left").reshape(wanted.shape))
        return ends[0], ends[1]

    def refine_bounds(
        self, terrain: Terrain, centres_m: Array, half_m: float, first: Ints, last: Ints, which: Bools
    ) -> tuple[Ints, Ints]:
        """First and one past the last open ray (n, sectors x parts) of boxes, the parts `which` bounded anew."""
        box, part = np.nonzero((first < last) & which)
        count = len(self.ends)
        middle, centres = (2 * part + 1) * np.pi / count, centres_m[box]
        low, high = terrain.horizon_bounds_rad(centres, np.array(half_m), middle, np.pi / count)
        map_sigma = terrain.max_horizon_sigma_rad(centres, half_m, middle, np.pi / count)
        margin = CERTAIN_SIGMAS * np.hypot(self.sigma_rad[part], map_sigma)
        at_least = np.searchsorted(self.key, low - margin + SECTOR_STEP * part, side="left")
        at_most = np.searchsorted(self.key, high + margin + SECTOR_STEP * part, side="right")
        first, last = first.copy(), last.copy()
        first[box, part] = np.clip(at_least, first[box, part], last[box, part])
        last[box, part] = np.clip(at_most, first[box, part], last[box, part])
        return first, last

    def sums(self, first: Ints, last: Ints) -> tuple[Array, Array, Array]:
        """Contributions (n, sectors): of the certainly visible rays, and least and greatest of the open ones."""
        return (
            self._by_sector(self.total[self.ends] - self.total[last]),
            self._by_sector(self.least[last] - self.least[first]),
            self._by_sector(self.most[last] - self.most[first]),
        )

    def _by_sector(self, of_parts: Array) -> Array:
        return (
            of_parts
            if self.parts == 1
            else of_parts.reshape(len(of_parts), of_parts.shape[1] // self.parts, self.parts).sum(axis=-1)
        )

    def pairs(self, first: Ints, last: Ints) -> tuple[Ints, Ints]:
        """Every open (box, ray) pair (m,), (m,)."""
        count = (last - first).ravel()
        box = np.repeat(np.arange(first.shape[0]), (last - first).sum(axis=1))
        step = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        return box, np.repeat(first.ravel(), count) + step


@njit(cache=True, nogil=True)
def _find_open(key, ends, low, high, first, last) -> None:  # type: ignore[no-untyped-def]
    """Fill first and last (n, parts) with the rays of each part from `low` to `high` (n, parts) [rad]."""
    for n in range(len(low)):
        begin = 0
        for part in range(len(ends)):
            end = ends[part]
            for side in range(2):
                wanted = (high[n, part] if side else low[n, part]) + SECTOR_STEP * part
                a, b = begin, end
                while a < b:
                    middle = (a + b) >> 1
                    if key[middle] < wanted or (side and key[middle] == wanted):
                        a = middle + 1
                    else:
                        b = middle
                if side:
                    last[n, part] = a
                else:
                    first[n, part] = a
            begin = end


def _running_sum(values: Array) -> Array:
    return np.concatenate([[0.0], np.cumsum(values)])
