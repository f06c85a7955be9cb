"""The likelihood of a position in the search: sums of rows over elevation, sector by sector."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from startrack.core.types import SECTORS, Array, Evidence
from startrack.localization.box_sums import BoxAverage, PrefixSums
from startrack.localization.sector_likelihood import Sectors, add_contributions
from startrack.terrain import Terrain, require_horizons

SECTOR_RAD = 2 * np.pi / SECTORS
SECTOR_EPSILON = 1e-4  # probability that a sector is wholly wrong
POINT_M = 0.01  # half side of a box that stands for a point


@dataclass(frozen=True, eq=False)
class PositionLikelihood:
    """log P(evidence | position) = sum over sectors of their capped sums of contributions; see `Sectors`."""

    evidence: Evidence
    terrain: Terrain
    sectors: Sectors

    @classmethod
    def from_evidence(
        cls, evidence: Evidence, terrain: Terrain, width_rad: float = SECTOR_RAD, epsilon: float = SECTOR_EPSILON
    ) -> PositionLikelihood:
        """Of rows (n,) on a terrain, in sectors of that width [rad], each wholly wrong with probability epsilon."""
        return cls(evidence, terrain, Sectors.from_evidence(evidence, width_rad, epsilon))

    def with_rows(self, evidence: Evidence) -> PositionLikelihood:
        """The same likelihood of other rows."""
        return PositionLikelihood(evidence, self.terrain, Sectors(evidence, self.sectors.count, self.sectors.epsilon))

    @cached_property
    def sums(self) -> PrefixSums:
        """Sums of the rows over elevation."""
        return PrefixSums.from_sectors(self.sectors)

    @cached_property
    def average(self) -> BoxAverage:
        """Average likelihoods of boxes."""
        return BoxAverage.from_evidence(self.evidence, 2 * np.pi / self.sectors.count, self.sectors.epsilon)

    def exact_scores(self, points_m: Array) -> Array:
        """Log-likelihoods (n,) of positions (n, 2), whether or not a camera can stand there.

        Raises BadInput (bad_terrain) for a terrain that gives no finite horizon where one can.
        """
        e, first, last = self.sums.evidence, *self.sums.open_rays(self.terrain, points_m, POINT_M)
        point, row = self.sums.pairs(first, last)
        at, azimuth = points_m[point], e.azimuth_rad[row]
        horizon, sums = self.terrain.horizon_rad(at, azimuth), self.sums.sums(first, last)[0]
        require_horizons(self.terrain, at, horizon)
        sigma = np.hypot(e.edge_sigma_rad[row], self.terrain.horizon_sigma_rad(at, azimuth))
        add_contributions(
            point, self.sums.sector[row], e.llr[row], e.extended_nats[row], e.elevation_rad[row] - horizon, sigma, sums
        )
        return self.sectors.score(sums)
