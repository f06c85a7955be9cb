"""The evidence as one profile per sector: running sums over elevation, so that a box costs a look-up per sector."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.localize.likelihood import Sectors
from startrack.terrain import Terrain
from startrack.types import Array, Evidence, Ints

CERTAIN_SIGMAS = 6.0
SECTOR_STEP = 10.0  # between the keys of neighbouring sectors: more than any two elevations differ


@dataclass(frozen=True)
class Profile:
    """Rays sorted by sector and elevation, with running sums."""

    evidence: Evidence  # sorted
    sector: Ints  # (n,) of the sorted rays
    key: Array  # (n,) sector and elevation in one ascending number
    total: Array  # (n + 1,) running sum of the llr
    negative: Array  # (n + 1,) of the negative ones
    positive: Array
    ends: Ints  # (sectors,) one past the last ray of each sector
    sigma_rad: Array  # (sectors,) largest edge sigma

    @classmethod
    def of(cls, sectors: Sectors) -> Profile:
        e = sectors.evidence
        order = np.lexsort((e.elevation_rad, sectors.sector))
        sector, llr = sectors.sector[order], e.llr[order]
        evidence = Evidence(
            azimuth_rad=e.azimuth_rad[order],
            elevation_rad=e.elevation_rad[order],
            llr=llr,
            edge_sigma_rad=e.edge_sigma_rad[order],
        )
        sigma = np.zeros(sectors.count)
        np.maximum.at(sigma, sector, evidence.edge_sigma_rad)
        return cls(
            evidence=evidence,
            sector=sector,
            key=SECTOR_STEP * sector + evidence.elevation_rad,
            total=_running(llr),
            negative=_running(np.minimum(llr, 0.0)),
            positive=_running(np.maximum(llr, 0.0)),
            ends=np.searchsorted(sector, np.arange(sectors.count), side="right"),
            sigma_rad=sigma,
        )

    def open_rays(self, terrain: Terrain, centres_m: Array, half_m: float) -> tuple[Ints, Ints]:
        """First and one past the last ray (n, sectors) that the horizon may meet somewhere in the boxes (n, 2).

        Rays of a sector below these are hidden, those above visible, from every place in the box.
        """
        count = len(self.ends)
        middle = (2 * np.arange(count) + 1) * np.pi / count
        boxes = centres_m[:, None, :]
        low, high = terrain.horizon_bounds_rad(boxes, np.array(half_m), middle, np.pi / count)
        margin = CERTAIN_SIGMAS * np.hypot(self.sigma_rad, terrain.horizon_sigma_rad(boxes, middle))
        step = SECTOR_STEP * np.arange(count)
        first = np.searchsorted(self.key, (low - margin + step).ravel(), side="left")
        last = np.searchsorted(self.key, (high + margin + step).ravel(), side="right")
        return first.reshape(low.shape), last.reshape(low.shape)

    def sums(self, first: Ints, last: Ints) -> tuple[Array, Array, Array]:
        """Contributions (n, sectors): of the certainly visible rays, and the least and the most of the open ones."""
        visible = self.total[self.ends] - self.total[last]
        return (
            visible,
            self.negative[last] - self.negative[first],
            self.positive[last] - self.positive[first],
        )

    def pairs(self, first: Ints, last: Ints) -> tuple[Ints, Ints]:
        """Every open (box, ray) pair (m,), (m,)."""
        count = (last - first).ravel()
        box = np.repeat(np.arange(first.shape[0]), (last - first).sum(axis=1))
        step = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        return box, np.repeat(first.ravel(), count) + step


def _running(values: Array) -> Array:
    return np.concatenate([[0.0], np.cumsum(values)])
