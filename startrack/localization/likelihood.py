"""The log-likelihood of positions on a terrain: one value that the search, the nuisances and the checks share."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from startrack.localization.box_average import BoxAverage
from startrack.localization.boxes import NO_DISKS, Boxes, Rows, root_box
from startrack.localization.local_search import LocalLikelihood
from startrack.localization.prefix_sums import PrefixSums
from startrack.localization.score_kernel import score_boxes, score_disks
from startrack.localization.sector_likelihood import Sectors, row_limits
from startrack.terrain import Terrain, require_horizons
from startrack.types import Array, Evidence, Ints

SECTOR_RAD, SECTOR_EPSILON = float(np.radians(1.5)), 1e-4  # width of a sector; probability that one is wholly wrong
PARTS = 4  # of a sector, in which the horizon is bounded more tightly over small boxes
POINT_M = 0.5  # half side of a box that stands for a point


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

    @cached_property
    def sums(self) -> PrefixSums:
        """Prefix sums of whole sectors."""
        return PrefixSums.from_sectors(self.sectors)

    @cached_property
    def part_sums(self) -> PrefixSums:
        """Prefix sums of parts of sectors."""
        return PrefixSums.from_sectors(self.sectors, PARTS)

    @cached_property
    def average(self) -> BoxAverage:
        """Average likelihoods of boxes."""
        return BoxAverage.from_evidence(self.evidence, 2 * np.pi / self.sectors.count, self.sectors.epsilon)

    def strong(self, llr: float, many: int) -> PositionLikelihood:
        """The same from rows of at least that |llr| alone, where these are `many`."""
        which = np.abs(self.evidence.llr) >= llr
        if np.count_nonzero(which) < many:
            return self
        width = 2 * np.pi / self.sectors.count
        return PositionLikelihood.from_evidence(self.evidence.take(which), self.terrain, width, self.sectors.epsilon)

    @cached_property
    def in_closed_form(self) -> bool:
        """Whether the ground from which each row is visible is a disk with a sharp edge."""
        return len(self.rows.disks_m) > 0

    @cached_property
    def rows(self) -> Rows:
        """The rows for the kernels, in the order of their sectors, or of the parts of these."""
        e, sectors, disks = self.evidence, self.sectors, None
        if self.terrain.hard_edges and not e.edge_sigma_rad.any():
            disks = self.terrain.visible_disks(e.azimuth_rad, e.elevation_rad)
        if disks is None:
            e, sector, disks = self.part_sums.evidence, self.part_sums.sector, (NO_DISKS, 0.0)
            ceiling = sectors.ceiling
        elif sectors.epsilon > 0.0:
            e, disks = e.take(sectors.order), (disks[0][sectors.order], disks[1])
            sector, ceiling = sectors.sector[sectors.order], sectors.ceiling
        else:  # the contributions of all rows are summed: one sector does
            sector, ceiling = np.zeros(len(e), dtype=np.int64), np.zeros(1)
        return Rows(
            e.azimuth_rad, e.elevation_rad, e.llr, e.extended_nats, e.edge_sigma_rad, *row_limits(e), sector, ceiling,
            sectors.log_floor, *disks,
        )  # fmt: skip

    @cached_property
    def strength(self) -> Array:
        """|llr| (n,) of the rows, by which they are bounded in turns."""
        return np.abs(self.rows.llr)

    @cached_property
    def root(self) -> Boxes:
        """The searched square as one box, all rows open."""
        return root_box(self.rows, self.terrain.searched)

    def exact_scores(self, points_m: Array) -> Array:
        """Log-likelihoods (n,) of positions (n, 2), horizons from the terrain itself."""
        if not len(points_m):
            return np.zeros(0)
        if self.in_closed_form:
            r, found = self.rows, np.empty(len(points_m))
            points = np.ascontiguousarray(points_m, dtype=np.float64)
            score_disks(r.disks_m, r.radius_m, r.llr, r.sector, -r.ceiling[None], r.log_floor, points, found)
            return found
        first, last = self.part_sums.split(self.sums, *self.sums.open_rays(self.terrain, points_m, POINT_M))
        return self.centre_scores(self.boxes_by_rows(points_m, POINT_M, first, last))

    def boxes_by_rows(self, centres_m: Array, half_m: float, first: Ints, last: Ints) -> Boxes:
        """Boxes (n, 2) with the open rows (n, parts) of the sectors' parts, bounded by these rows' own limits."""
        sums, score = self.part_sums, self.sectors.score
        visible, least, most = sums.sums(first, last)
        row = sums.pairs(first, last)[1]
        begin = np.concatenate([[0], np.cumsum((last - first).sum(axis=1))])
        return Boxes(
            centres_m, half_m, begin, row, self.rows.least[row], self.rows.most[row], visible - self.sectors.ceiling,
            score(visible), score(visible + least), score(visible + most), np.full(len(centres_m), -np.inf),
        )  # fmt: skip

    def centre_scores(self, boxes: Boxes, ground: Terrain | None = None) -> Array:
        """Log-likelihoods (n,) at the centres of boxes, whether or not a camera can stand there."""
        box = np.repeat(np.arange(len(boxes.centres_m)), np.diff(boxes.first))
        centres, azimuth = boxes.centres_m[box], self.rows.azimuth_rad[boxes.row]
        at = ground or self.terrain
        score, horizon = np.empty(len(boxes.centres_m)), at.horizon_rad(centres, azimuth)
        require_horizons(at, centres, horizon)
        score_boxes(self.rows, boxes, horizon, at.horizon_sigma_rad(centres, azimuth), score)
        return score

    def climb(
        self, start_m: Array, steps: tuple[tuple[float, float, int], ...], last_step_m: float
    ) -> tuple[Array, LocalLikelihood]:
        """The start (2,) and a better position after each of the steps, (n + 1, 2), and the last neighbourhood.

        `steps`: half side of the neighbourhood [m], first step [m], points across where horizons are traced.
        """
        way = [start_m]
        for nearby_m, first_step_m, across in steps:
            local = self.near(way[-1], nearby_m, across=across)
            way.append(local.climb(way[-1], first_step_m, last_step_m)[0])
        return np.array(way), local

    def near(self, centre_m: Array, half_m: float, leeway_rad: float = 0.0, across: int = 3) -> LocalLikelihood:
        """The same within `half_m` of a position (2,), for elevations that change by no more than the leeway [rad]."""
        return LocalLikelihood.near(self.sectors, self.sums, self.terrain, centre_m, half_m, leeway_rad, across)
