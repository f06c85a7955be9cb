"""The exact posterior of the position, by branch and bound over the whole search area."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.localize.likelihood import Sectors
from startrack.localize.rays import bundled
from startrack.localize.scout import likely_places, taken
from startrack.localize.search import Boxes, bounded, centre_scores, on_ground, whole_area
from startrack.localize.summary import summarize
from startrack.terrain import Terrain
from startrack.types import Array, Evidence, Fix, NotLocated

RAY_BY_RAY_M = 12.0  # boxes below this half side are asked ray by ray and judged at their centres
FEWEST_RAYS = 8


@dataclass(frozen=True)
class ExactPosterior:
    """log P(p | evidence) = sum over sectors of the capped sums of l_i V_i(p), uniform prior on the search area.

    The area is cut into boxes; each ray is certainly visible, certainly hidden or open over a box, which bounds the
    box's likelihood. Boxes that cannot matter are dropped (their total probability is bounded and stated), the others
    are quartered until they are small against the posterior's own spread. All modes are found; nothing is guessed.
    """

    sector_width_rad: float = float(np.radians(1.5))
    sector_epsilon: float = 1e-4
    prune_nats: float = 16.0  # boxes whose best place is e^-16 as likely as the best known one are dropped
    finest_m: float = 0.05
    boxes_per_sigma: float = 2.5  # boxes are quartered until this many fit into the posterior's smaller axis
    most_boxes: int = 40_000

    def __call__(self, evidence: Evidence, terrain: Terrain) -> Fix:
        """Posterior of the camera's position. Raises NotLocated (insufficient_geometry, outside_search_area)."""
        told = np.abs(evidence.llr) > 1e-3
        if told.sum() < FEWEST_RAYS:
            raise NotLocated(f"only {int(told.sum())} rays say anything about the skyline: expose longer")
        boxes, log_weight, dropped = self._explore(taken(evidence, told), terrain)
        return summarize(boxes.centres_m, 2 * boxes.half_m, log_weight, dropped, terrain)

    def _explore(self, evidence: Evidence, terrain: Terrain) -> tuple[Boxes, Array, float]:
        """Boxes that hold the posterior, log-likelihoods at their centres, and a bound on the probability dropped."""
        sectors = Sectors.of(evidence, self.sector_width_rad, self.sector_epsilon)
        rays = bundled(sectors)
        boxes = bounded(whole_area(sectors, rays, terrain.reach_m), sectors, rays, terrain)
        best = float(likely_places(evidence, sectors, terrain)[1].max(initial=-np.inf))
        dropped = -np.inf
        while True:
            small = boxes.half_m < RAY_BY_RAY_M
            if small:
                boxes = boxes.all_taken_apart(rays)
                score = centre_scores(boxes, sectors, rays, terrain)
                log_weight = np.where(terrain.allowed(boxes.centres_m), score, -np.inf)
                best = max(best, float(log_weight.max(initial=-np.inf)))
            whole = boxes.upper > best - self.prune_nats
            dropped = np.logaddexp(dropped, _log_mass(boxes.upper[~whole], boxes.half_m))
            boxes = boxes.take(whole)
            if small and self._fine_enough(boxes, log_weight[whole]):
                break
            boxes = boxes.split()
            boxes = bounded(boxes.take(on_ground(boxes, terrain)), sectors, rays, terrain)
            sure = boxes.lower[np.asarray(terrain.allowed(boxes.centres_m))]
            best = max(best, float(sure.max(initial=-np.inf)))
        log_weight = log_weight[whole]
        total = _log_mass(log_weight, boxes.half_m)
        return boxes, log_weight, float(np.exp(min(dropped - total, 0.0)))

    def _fine_enough(self, boxes: Boxes, log_weight: Array) -> bool:
        if not np.isfinite(log_weight).any():
            return False
        if boxes.half_m <= self.finest_m or 4 * len(boxes) > self.most_boxes or not len(boxes.ray):
            return True
        weight = np.exp(log_weight - log_weight.max())
        centred = boxes.centres_m - np.average(boxes.centres_m, axis=0, weights=weight)
        spread = np.einsum("n,ni,nj->ij", weight, centred, centred) / weight.sum()
        smaller = np.sqrt(max(float(np.linalg.eigvalsh(spread)[0]), 0.0))
        return 2 * boxes.half_m * self.boxes_per_sigma < smaller


def _log_mass(log_density: Array, half_m: float) -> float:
    top = float(np.max(log_density, initial=-np.inf))
    if not np.isfinite(top):
        return -np.inf
    return top + float(np.log(np.sum(np.exp(log_density - top)) * 4 * half_m * half_m))
