"""The exact posterior of the position, by branch and bound over the whole search area."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.localize.likelihood import Sectors
from startrack.localize.search import Boxes, bounded, centre_scores, on_ground, start_boxes
from startrack.localize.summary import summarize
from startrack.terrain import Terrain
from startrack.types import Array, Evidence, Fix, NotLocated

START_ACROSS = 1
FEWEST_RAYS = 8


@dataclass(frozen=True)
class ExactPosterior:
    """log P(p | evidence) = sum over sectors of the capped sums of l_i V_i(p), uniform prior on the search area.

    The area is cut into boxes; each ray is certainly visible, certainly hidden or open over a box, which bounds the
    box's likelihood. Boxes that cannot matter are dropped (their total probability is bounded and stated), the others
    are quartered until they are small against the posterior's own spread. All modes are found; nothing is guessed.
    """

    sector_width_rad: float = float(np.radians(3.0))
    sector_epsilon: float = 1e-4
    prune_nats: float = 16.0  # boxes whose best place is e^-16 as likely as the best known one are dropped
    finest_m: float = 0.05
    boxes_per_sigma: float = 4.0  # boxes are quartered until this many fit into the posterior's smaller axis
    most_boxes: int = 60_000

    def __call__(self, evidence: Evidence, terrain: Terrain) -> Fix:
        """Posterior of the camera's position. Raises NotLocated (insufficient_geometry, outside_search_area)."""
        told = np.abs(evidence.llr) > 1e-3
        if told.sum() < FEWEST_RAYS:
            raise NotLocated(f"only {int(told.sum())} rays say anything about the skyline: expose longer")
        boxes, log_weight, dropped = self._explore(_selected(evidence, told), terrain)
        return summarize(boxes.centres_m, 2 * boxes.half_m, log_weight, dropped, terrain)

    def _explore(self, evidence: Evidence, terrain: Terrain) -> tuple[Boxes, Array, float]:
        sectors = Sectors.of(evidence, self.sector_width_rad, self.sector_epsilon)
        boxes = bounded(start_boxes(sectors, terrain, terrain.reach_m, START_ACROSS), sectors, terrain)
        best, dropped = -np.inf, -np.inf
        while True:
            score = centre_scores(boxes, sectors, terrain)
            allowed = np.asarray(terrain.allowed(boxes.centres_m))
            if allowed.any():
                best = max(best, float(score[allowed].max()))
            best = max(best, float(boxes.lower.max()) if allowed.all() else -np.inf)
            keep = boxes.upper > best - self.prune_nats
            if not keep.all():
                dropped = np.logaddexp(dropped, _log_mass(boxes.upper[~keep], boxes.half_m))
                boxes, score, allowed = boxes.take(keep), score[keep], allowed[keep]
            log_weight = np.where(allowed, score, -np.inf)
            if self._fine_enough(boxes, log_weight):
                break
            boxes = boxes.split()
            boxes = bounded(boxes.take(on_ground(boxes, terrain)), sectors, terrain)
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


def _selected(evidence: Evidence, which: Array) -> Evidence:
    return Evidence(
        azimuth_rad=evidence.azimuth_rad[which],
        elevation_rad=evidence.elevation_rad[which],
        llr=evidence.llr[which],
        edge_sigma_rad=evidence.edge_sigma_rad[which],
    )


def _log_mass(log_density: Array, half_m: float) -> float:
    top = float(np.max(log_density, initial=-np.inf))
    if not np.isfinite(top):
        return -np.inf
    return top + float(np.log(np.sum(np.exp(log_density - top)) * 4 * half_m * half_m))
