"""The exact posterior of the position, by branch and bound over the whole search area."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.localize import compiled
from startrack.localize.common import marginalised_over_common
from startrack.localize.crater import CraterFit, marginalised
from startrack.localize.dive import best_by_diving
from startrack.localize.likelihood import Sectors
from startrack.localize.profile import Profile
from startrack.localize.scout import likely_places, taken
from startrack.localize.search import Boxes, RayBoxes, by_sector, centre_scores, ray_by_ray, split
from startrack.localize.seen import cylinder_of
from startrack.localize.summary import summarize
from startrack.terrain import Cylinder, Terrain
from startrack.types import Array, Bools, Evidence, Fix, Ints, NotLocated

FEWEST_RAYS = 8
MOST_COARSE_BOXES = 12_000  # boxes of 20 m and more that all might matter: the stars do not say where
MOST_PAIRS = 6_000_000  # (box, ray) pairs, some 0.5 GB
BOXES_AT_ONCE = 2000
CONTRADICTED_NATS = -3.0  # mean over the sectors at the best place; -0.5 is usual, and -9.2 the worst
RAY_BY_RAY_M = 20.0  # boxes of this half side and less are asked ray by ray, larger ones sector by sector


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
    negligible_nats: float = 18.0  # and so are those that hold at most e^-18 of the probability
    finest_m: float = 0.05
    boxes_per_sigma: float = 1.8  # boxes are quartered until this many fit into the posterior's smaller axis
    most_boxes: int = 40_000
    compiled: bool = False  # with numba, for a cylinder with hard edges: the same answer, 10 to 50 times sooner

    def __call__(self, evidence: Evidence, terrain: Terrain) -> Fix:
        """Posterior of the camera's position. Raises NotLocated (insufficient_geometry, outside_search_area)."""
        told = (np.abs(evidence.llr) > 1e-3) & terrain.tells(evidence.azimuth_rad, evidence.elevation_rad)
        if told.sum() < FEWEST_RAYS:
            raise NotLocated(f"only {int(told.sum())} rays say anything about the skyline: expose longer")
        evidence = taken(evidence, told)
        if isinstance(terrain, Cylinder) and (terrain.depth_sigma_m > 0 or terrain.diameter_sigma_m > 0):
            (centres, half, log_weight, log_dropped), _ = marginalised(self._explored, evidence, terrain)
        elif terrain.common_sigma_rad > 0:
            place = _Search(self, evidence, terrain).place_m
            centres, half, log_weight, log_dropped = marginalised_over_common(
                lambda rays: self._explored(rays, terrain), evidence, terrain, place
            )
        else:
            centres, half, log_weight, log_dropped = self._explored(evidence, terrain)
        dropped = float(np.exp(min(log_dropped - _log_mass(log_weight, half), 0.0)))
        return summarize(centres, 2 * half, log_weight, dropped, terrain)

    def crater(self, evidence: Evidence, cylinder: Cylinder) -> CraterFit:
        """Depth and diameter of a cylinder with uncertain ones, estimated together with the position."""
        return marginalised(self._explored, evidence, cylinder)[1]

    def _explored(self, evidence: Evidence, terrain: Terrain) -> tuple[Array, float, Array, float]:
        """Centres (n, 2) of equal boxes, half side, log-likelihoods (n,) there, log of a bound on the mass dropped."""
        if self.compiled and compiled.applies(evidence, terrain):
            return compiled.explored(self, evidence, cylinder_of(terrain))
        search = _Search(self, evidence, terrain)
        boxes = search.refine(search.exclude())
        return boxes.centres_m, boxes.half_m, search.scores(boxes), search.log_dropped


class _Search:
    """One run: what is known of the best place, and how much probability was given up."""

    def __init__(self, method: ExactPosterior, evidence: Evidence, terrain: Terrain) -> None:
        self.method, self.terrain = method, terrain
        self.place_m = np.zeros(2)  # a good one to begin with
        self.sectors = Sectors.of(evidence, method.sector_width_rad, method.sector_epsilon)
        self.profile = Profile.of(self.sectors)
        if isinstance(terrain, Cylinder):
            self.best = float(likely_places(evidence, self.sectors, terrain)[1].max(initial=-np.inf))
        else:  # real ground: horizons are costly, and the peak is narrower than any grid's step
            self.place_m, self.best = best_by_diving(self.sectors, self.profile, terrain)
        self.log_dropped = -np.inf

    def exclude(self) -> RayBoxes:
        """From the whole area down to small boxes, by look-ups. Raises NotLocated where too much stays open."""
        centres, half = np.zeros((1, 2)), float(self.terrain.reach_m)
        while True:
            boxes, first, last = self._bounded(centres, half)
            if len(boxes) > MOST_COARSE_BOXES:
                raise self._lost(len(boxes) * 4 * half**2)
            if half < RAY_BY_RAY_M:
                if (last - first).sum() > MOST_PAIRS:
                    raise self._lost(len(boxes) * 4 * half**2)
                return ray_by_ray(boxes, first, last, self.sectors, self.profile, self.terrain)
            centres, half = boxes.quarters(self.terrain)[0], half / 2

    def _bounded(self, centres: Array, half: float) -> tuple[Boxes, Ints, Ints]:
        """The promising ones of the boxes with their open rays, some at a time so that memory stays flat."""
        kept = []
        for start in range(0, len(centres), BOXES_AT_ONCE):
            some = centres[start : start + BOXES_AT_ONCE]
            boxes, first, last = by_sector(some, half, self.sectors, self.profile, self.terrain)
            keep = self._promising(boxes)
            kept.append((boxes.take(keep), first[keep], last[keep]))
        parts = [(box.centres_m, box.lower, box.upper, first, last) for box, first, last in kept]
        centres, lower, upper, first, last = (np.concatenate(column) for column in zip(*parts, strict=True))
        return Boxes(centres, half, lower, upper), first, last

    def _lost(self, open_m2: float) -> NotLocated:
        """Why so much of the area stays open: nothing fits, or everything does."""
        if self.best < CONTRADICTED_NATS * self.sectors.count:
            return NotLocated(
                "no place explains the stars: wrong terrain, time or camera file?", reason="inconsistent_evidence"
            )
        return NotLocated(
            f"the rays leave {open_m2 / 1e6:.1f} km2 of the search area open: "
            "is the skyline in the picture, and the exposure long enough?"
        )

    def refine(self, boxes: RayBoxes) -> RayBoxes:
        """Quartered until small against the posterior's spread."""
        while True:
            score = self.scores(boxes)
            self.best = max(self.best, float(score.max(initial=-np.inf)))
            keep = self._promising(boxes)
            boxes = boxes.take(keep)
            if self._fine_enough(boxes, score[keep]):
                return boxes
            boxes = split(boxes, self.sectors, self.profile, self.terrain)

    def scores(self, boxes: RayBoxes) -> Array:
        """Log-likelihood (n,) at the centres, minus infinity where the camera cannot be."""
        score = centre_scores(boxes, self.sectors, self.profile, self.terrain)
        return np.where(self.terrain.allowed(boxes.centres_m), score, -np.inf)

    def _promising(self, boxes: Boxes) -> Bools:
        """Which boxes (n,) might matter; the others' probability is added to what was given up."""
        sure = boxes.lower[np.asarray(self.terrain.allowed(boxes.centres_m))]
        self.best = max(self.best, float(sure.max(initial=-np.inf)))
        negligible = _log_mass(sure, boxes.half_m) - self.method.negligible_nats - np.log(4 * boxes.half_m**2)
        keep = boxes.upper > max(self.best - self.method.prune_nats, negligible)
        self.log_dropped = np.logaddexp(self.log_dropped, _log_mass(boxes.upper[~keep], boxes.half_m))
        return keep

    def _fine_enough(self, boxes: RayBoxes, log_weight: Array) -> bool:
        if not np.isfinite(log_weight).any():
            return False
        if boxes.half_m <= self.method.finest_m or 4 * len(boxes) > self.method.most_boxes or not len(boxes.ray):
            return True
        weight = np.exp(log_weight - log_weight.max())
        centred = boxes.centres_m - np.average(boxes.centres_m, axis=0, weights=weight)
        spread = np.einsum("n,ni,nj->ij", weight, centred, centred) / weight.sum()
        smaller = np.sqrt(max(float(np.linalg.eigvalsh(spread)[0]), 0.0))
        return 2 * boxes.half_m * self.method.boxes_per_sigma < smaller


def _log_mass(log_density: Array, half_m: float) -> float:
    top = float(np.max(log_density, initial=-np.inf))
    if not np.isfinite(top):
        return -np.inf
    return top + float(np.log(np.sum(np.exp(log_density - top)) * 4 * half_m * half_m))
