"""The evidence as one profile per sector or part of one: running sums over elevation, so that a box costs a look-up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.localization.sector_likelihood import SECTOR_STEP, Sectors, sorted_by_sector
from startrack.terrain import Terrain
from startrack.types import Array, Bools, Evidence, Ints

CERTAIN_SIGMAS = 6.0
ROUNDING = 1e-9  # of the keys


@dataclass(frozen=True)
class Profile:
    """Rays sorted by part of a sector and elevation, with running sums."""

    evidence: Evidence  # sorted
    sector: Ints  # (n,) of the sorted rays
    parts: int  # of each sector, looked up one by one
    key: Array  # (n,) part and elevation in one ascending number
    total: Array  # (n + 1,) running sum of the llr
    negative: Array  # (n + 1,) of the negative ones
    positive: Array
    ends: Ints  # (sectors x parts,) one past the last ray of each part
    sigma_rad: Array  # (sectors x parts,) largest edge sigma

    @classmethod
    def of(cls, sectors: Sectors, parts: int = 1) -> Profile:
        e = sectors.evidence
        within = e.azimuth_rad / (2 * np.pi) * sectors.count - sectors.sector
        part = sectors.sector * parts + np.clip(within * parts, 0, parts - 1).astype(np.int64)
        order = sorted_by_sector(e, part)
        part, llr = part[order], e.llr[order]
        evidence = Evidence(
            azimuth_rad=e.azimuth_rad[order],
            elevation_rad=e.elevation_rad[order],
            llr=llr,
            edge_sigma_rad=e.edge_sigma_rad[order],
        )
        sigma = np.zeros(sectors.count * parts)
        if evidence.edge_sigma_rad.any():
            np.maximum.at(sigma, part, evidence.edge_sigma_rad)
        return cls(
            evidence=evidence,
            sector=part // parts,
            parts=parts,
            key=SECTOR_STEP * part + evidence.elevation_rad,
            total=_running(llr),
            negative=_running(np.minimum(llr, 0.0)),
            positive=_running(np.maximum(llr, 0.0)),
            ends=np.searchsorted(part, np.arange(len(sigma)), side="right"),
            sigma_rad=sigma,
        )

    def open_rays(
        self, terrain: Terrain, centres_m: Array, half_m: float, leeway_rad: float = 0.0
    ) -> tuple[Ints, Ints]:
        """First and one past the last ray (n, sectors x parts) that the horizon may meet somewhere in the boxes (n, 2).

        Rays of a part below these are hidden, those above visible, from every place in the box, and were they higher
        or lower by the leeway.
        """
        count = len(self.ends)
        middle = (2 * np.arange(count) + 1) * np.pi / count
        boxes = centres_m[:, None, :]
        low, high = terrain.horizon_bounds_rad(boxes, np.array(half_m), middle, np.pi / count)
        map_sigma = terrain.max_horizon_sigma_rad(boxes, half_m, middle, np.pi / count)
        margin = leeway_rad + CERTAIN_SIGMAS * np.hypot(self.sigma_rad, map_sigma)
        step = SECTOR_STEP * np.arange(count)
        first = np.searchsorted(self.key, (low - margin + step).ravel(), side="left")
        last = np.searchsorted(self.key, (high + margin + step).ravel(), side="right")
        return first.reshape(low.shape), last.reshape(low.shape)

    def handed_down(self, whole: Profile, first: Ints, last: Ints) -> tuple[Ints, Ints]:
        """Open rays (n, sectors x parts) by those that `whole`, the same rays with one part a sector, left open."""
        ends = []
        for number, leeway in ((first, -ROUNDING), (last, ROUNDING)):  # rather one ray more left open
            sector = np.arange(len(whole.ends))
            key = np.append(whole.key, np.inf)[number] - SECTOR_STEP * sector
            lowest = np.where(number < whole.ends, key, 0.5 * SECTOR_STEP)  # of the rays from this one on
            wanted = np.repeat(lowest + leeway, self.parts, axis=1) + SECTOR_STEP * np.arange(len(self.ends))
            ends.append(np.searchsorted(self.key, wanted.ravel(), side="left").reshape(wanted.shape))
        return ends[0], ends[1]

    def closer(
        self, terrain: Terrain, centres_m: Array, half_m: float, first: Ints, last: Ints, asked: Bools
    ) -> tuple[Ints, Ints]:
        """Of boxes whose open rays are known (n, sectors x parts), fewer: the asked parts (sectors x parts,) anew."""
        box, part = np.nonzero((first < last) & asked)
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
        """Contributions (n, sectors): of the certainly visible rays, and the least and the most of the open ones."""
        return (
            self._by_sector(self.total[self.ends] - self.total[last]),
            self._by_sector(self.negative[last] - self.negative[first]),
            self._by_sector(self.positive[last] - self.positive[first]),
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


def _running(values: Array) -> Array:
    return np.concatenate([[0.0], np.cumsum(values)])
