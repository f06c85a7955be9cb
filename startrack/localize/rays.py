"""The evidence as a tree: rays bundled by sector and elevation, so that wide boxes ask few questions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.localize.likelihood import Sectors, contribution
from startrack.terrain import Terrain
from startrack.types import Array, Bools, Ints

COARSEST_RAD = np.radians(22.5)
BUNDLE_LEVELS = 7  # 22.5 degrees of elevation down to 0.35
CERTAIN_SIGMAS = 6.0
COARSE_FRACTION = 0.12  # a bundle taller than this part of the horizon's range over a box is taken apart


@dataclass(frozen=True, kw_only=True)
class Rays:
    """Bundles of rays of one sector that are neighbours in elevation, and the single rays (the leaves), in one list."""

    azimuth_rad: Array  # (n,) middle of the bundle
    azimuth_half_rad: Array  # half its width; 0 for a ray
    lowest_rad: Array  # elevations
    highest_rad: Array
    llr: Array  # sum
    negative: Array  # sum of the negative llr
    positive: Array
    sigma_rad: Array  # largest edge sigma
    sector: Ints
    first_child: Ints  # children are first_child..last_child - 1; none for a ray
    last_child: Ints
    roots: int  # the first `roots` bundles hold all rays

    @property
    def leaf(self) -> Bools:
        """Which are single rays (n,)."""
        return self.first_child == self.last_child

    def bounds(self, terrain: Terrain, centres_m: Array, half_m: Array, which: Ints) -> tuple[Array, Array, Bools]:
        """Lowest and highest contribution (m,) of `which` (m,) over the boxes, and which of them to take apart."""
        azimuth, wide = self.azimuth_rad[which], self.azimuth_half_rad[which]
        low, high = terrain.horizon_bounds_rad(centres_m, half_m, azimuth, wide)
        sigma = np.hypot(self.sigma_rad[which], terrain.horizon_sigma_rad(centres_m, azimuth))
        lowest, highest, llr = self.lowest_rad[which], self.highest_rad[which], self.llr[which]
        seen = lowest > high + CERTAIN_SIGMAS * sigma
        hidden = highest < low - CERTAIN_SIGMAS * sigma
        lower = np.where(seen, llr, np.where(hidden, 0.0, self.negative[which]))
        upper = np.where(seen, llr, np.where(hidden, 0.0, self.positive[which]))
        soft = np.flatnonzero((wide == 0) & (sigma > 0) & ~seen & ~hidden)
        if len(soft):
            ends = [contribution(llr[soft], lowest[soft], edge[soft], sigma[soft]) for edge in (low, high)]
            lower[soft], upper[soft] = np.minimum(*ends), np.maximum(*ends)
        return lower, upper, (wide > 0) & (highest - lowest > COARSE_FRACTION * (high - low))


def bundled(sectors: Sectors) -> Rays:
    """The tree over the evidence's rays: halves of elevation, 22.5 degrees at the roots, sector by sector."""
    evidence = sectors.evidence
    order = np.lexsort((evidence.elevation_rad, sectors.sector))
    sector, elevation = sectors.sector[order], evidence.elevation_rad[order]
    llr, sigma = evidence.llr[order], evidence.edge_sigma_rad[order]
    n = len(order)
    starts = [_starts(sector, elevation, COARSEST_RAD / 2**k) for k in range(BUNDLE_LEVELS)] + [np.arange(n)]
    offsets = np.cumsum([0] + [len(s) for s in starts])
    ends = [np.append(s[1:], n) for s in starts]
    first_child = [
        offsets[k + 1] + np.searchsorted(starts[k + 1], starts[k]) for k in range(BUNDLE_LEVELS)
    ]
    last_child = [offsets[k + 1] + np.searchsorted(starts[k + 1], ends[k]) for k in range(BUNDLE_LEVELS)]
    none = np.zeros(n, dtype=np.int64)
    half_width = np.pi / sectors.count
    middle = (2 * sector + 1) * half_width
    bundles = offsets[BUNDLE_LEVELS]
    all_starts = np.concatenate(starts)
    return Rays(
        azimuth_rad=np.append(middle[all_starts[:bundles]], evidence.azimuth_rad[order]),
        azimuth_half_rad=np.append(np.full(bundles, half_width), np.zeros(n)),
        lowest_rad=elevation[all_starts],
        highest_rad=elevation[np.concatenate(ends) - 1],
        llr=np.concatenate([np.add.reduceat(llr, s) for s in starts]),
        negative=np.concatenate([np.add.reduceat(np.minimum(llr, 0.0), s) for s in starts]),
        positive=np.concatenate([np.add.reduceat(np.maximum(llr, 0.0), s) for s in starts]),
        sigma_rad=np.concatenate([np.maximum.reduceat(sigma, s) for s in starts]),
        sector=sector[all_starts],
        first_child=np.concatenate([*first_child, none]).astype(np.int64),
        last_child=np.concatenate([*last_child, none]).astype(np.int64),
        roots=len(starts[0]),
    )


def _starts(sector: Ints, elevation_rad: Array, height_rad: float) -> Ints:
    """First ray of each bundle among rays sorted by sector and elevation."""
    cell = np.floor((elevation_rad + np.pi) / height_rad).astype(np.int64)
    new = np.ones(len(sector), dtype=bool)
    new[1:] = (np.diff(sector) != 0) | (np.diff(cell) != 0)
    return np.flatnonzero(new)
