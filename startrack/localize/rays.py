"""The evidence as a tree: rays bundled by sector and elevation, so that wide boxes ask few questions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.localize.likelihood import Sectors, contribution
from startrack.terrain import Terrain
from startrack.types import Array, Ints

COARSEST_RAD = np.radians(22.5)
BUNDLE_LEVELS = 6  # 22.5 degrees of elevation down to 0.7
CERTAIN_SIGMAS = 6.0


@dataclass(frozen=True, kw_only=True)
class Rays:
    """Bundles (n) of rays of one sector that are neighbours in elevation; on the last level single rays."""

    azimuth_rad: Array  # middle of the bundle
    azimuth_half_rad: Array  # half its width
    lowest_rad: Array
    highest_rad: Array
    llr: Array  # sum
    negative: Array  # sum of the negative llr
    positive: Array
    sigma_rad: Array  # largest edge sigma
    sector: Ints
    first_child: Ints  # (n + 1,) into the next level; empty on the last

    @property
    def single(self) -> bool:
        """Whether these are the rays themselves."""
        return len(self.first_child) == 0

    def bounds(self, terrain: Terrain, centres_m: Array, half_m: Array, which: Ints) -> tuple[Array, Array]:
        """Lowest and highest contribution (m,) of the bundles `which` (m,) over the boxes (m, 2)."""
        azimuth = self.azimuth_rad[which]
        low, high = terrain.horizon_bounds_rad(centres_m, half_m, azimuth, self.azimuth_half_rad[which])
        sigma = np.hypot(self.sigma_rad[which], terrain.horizon_sigma_rad(centres_m, azimuth))
        if self.single:
            elevation, llr = self.lowest_rad[which], self.llr[which]
            ends = contribution(llr, elevation, low, sigma), contribution(llr, elevation, high, sigma)
            return np.minimum(*ends), np.maximum(*ends)
        seen = self.lowest_rad[which] > high + CERTAIN_SIGMAS * sigma
        hidden = self.highest_rad[which] < low - CERTAIN_SIGMAS * sigma
        lower = np.where(seen, self.llr[which], np.where(hidden, 0.0, self.negative[which]))
        upper = np.where(seen, self.llr[which], np.where(hidden, 0.0, self.positive[which]))
        return lower, upper


def ray_levels(sectors: Sectors) -> list[Rays]:
    """Levels from the coarsest bundles to the single rays; each bundle's children are contiguous in the next level."""
    evidence = sectors.evidence
    order = np.lexsort((evidence.elevation_rad, sectors.sector))
    sector, elevation = sectors.sector[order], evidence.elevation_rad[order]
    azimuth, llr = evidence.azimuth_rad[order], evidence.llr[order]
    sigma = evidence.edge_sigma_rad[order]
    none = np.zeros(0, dtype=np.int64)
    levels = [
        Rays(
            azimuth_rad=azimuth, azimuth_half_rad=np.zeros(len(order)), lowest_rad=elevation, highest_rad=elevation,
            llr=llr, negative=np.minimum(llr, 0.0), positive=np.maximum(llr, 0.0), sigma_rad=sigma, sector=sector,
            first_child=none,
        )  # fmt: skip
    ]
    child_starts = np.arange(len(order))
    half_width = np.pi / sectors.count
    for k in range(BUNDLE_LEVELS - 1, -1, -1):
        cell = np.floor((elevation + np.pi) / (COARSEST_RAD / 2**k)).astype(np.int64)
        new = np.ones(len(order), dtype=bool)
        new[1:] = (np.diff(sector) != 0) | (np.diff(cell) != 0)
        starts = np.flatnonzero(new)
        ends = np.append(starts[1:], len(order))
        levels.insert(
            0,
            Rays(
                azimuth_rad=(2 * sector[starts] + 1) * half_width,
                azimuth_half_rad=np.full(len(starts), half_width),
                lowest_rad=elevation[starts],
                highest_rad=elevation[ends - 1],
                llr=np.add.reduceat(llr, starts),
                negative=np.add.reduceat(np.minimum(llr, 0.0), starts),
                positive=np.add.reduceat(np.maximum(llr, 0.0), starts),
                sigma_rad=np.maximum.reduceat(sigma, starts),
                sector=sector[starts],
                first_child=np.append(np.searchsorted(child_starts, starts), len(child_starts)),
            ),
        )
        child_starts = starts
    return levels
