"""The search for positions: likely places by a beam over ever smaller boxes, then branch and bound."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import ceil, log2

import numpy as np

from startrack.core.limits import check_time
from startrack.core.types import SECTORS, Array, Evidence, Explored, NotLocated
from startrack.localization.places import (
    FINEST_M,
    FINEST_PART,
    PLACES_APART,
    BoxModel,
    Place,
    choose_apart,
    split_boxes,
    square_grid,
)
from startrack.localization.search_profiles import SLACK_NATS
from startrack.terrain import Terrain

NATS = 16.0  # positions that are e^-16 as likely as the best are dropped
# How many boxes are kept at each level, and whether the horizons of small boxes are traced. Looked-up horizons rank
# most positions right. Beside near crests they are too wide: of 9 positions on Shackleton's floor and walls they miss
# 2, where traced ones rank the true box among the first 70 at every level; of 8 on a map with errors of 5 m a post,
# one is not among the first 200.
BEAMS = ((32, False), (80, True), (200, True), (500, True))
APART_M = 1.0  # between two places
FIRST_REACH_M, LAST_REACH_M, BOXES_ACROSS = 16.0, 256.0, 5  # of boxes about a place, and how many along a side
BOXES_SIGMAS = 4.0  # from a place to the ends of these boxes
BOXES_AT_ONCE = 2000  # so that memory stays flat
# The search ends once the levels to come would take so many budgets, if boxes go on to grow in number as they do now.
# That is foreseen below this half side, of the searched radius: on a rough map from 125 m, in 34 searches always right.
FORESEEN_PART, FORESEEN_BUDGETS = 1 / 30, 2.0
LOOK_UP_COST = 0.08  # of a bound, in horizons traced
LAST_MOST_BOXES = 16_000  # of a level: it is the last one


def log_sum(values: Array) -> float:
    """Logarithm of the sum of exponentials; -inf of none."""
    return float(np.logaddexp.reduce(values, initial=-np.inf))


def boxes_about(places: list[Place], terrain: Terrain) -> Explored:
    """Boxes about the likely ones of `places`, where no proof excludes all others."""
    likely = [one for one in places if one.log_likelihood > places[0].log_likelihood - NATS]
    sigma_m = max(float(np.sqrt(np.linalg.eigvalsh(one.covariance_m2)[-1])) for one in likely)
    reach_m = min(max(BOXES_SIGMAS * sigma_m, FIRST_REACH_M), LAST_REACH_M)
    off, less = square_grid(reach_m, BOXES_ACROSS), 0.5 * np.square(square_grid(BOXES_SIGMAS, BOXES_ACROSS)).sum(axis=1)
    centres = np.concatenate([one.position_m + off for one in likely])
    score = np.concatenate([one.log_likelihood - less for one in likely])
    allowed = np.asarray(terrain.allowed(centres))
    return Explored(centres[allowed], reach_m / (BOXES_ACROSS - 1), score[allowed], 1.0, "beam")


def search_boxes(
    rows: Evidence, terrain: Terrain, prune_nats: float, budget_horizons: float
) -> tuple[Explored, list[Place]]:
    """The boxes of a `terrain` that may matter by `rows`, and the best places known.

    Boxes are dropped where they are less likely than the best place by `prune_nats`. Where the proof would trace more
    horizons than the budget, wider beams look for better places, and those are what is left.
    Raises NotLocated (outside_search_area).
    """
    model = BoxModel.of(rows, terrain)
    places = model.fit_places(*model.last_boxes(*BEAMS[0]), most=1)
    proof = Proof(model.raised_as(places), prune_nats, budget_horizons)
    found = proof.run(places)
    if found is None or found.search != "proven":
        for beam in BEAMS[1:]:
            places = merge_places(places, model.fit_places(*model.last_boxes(*beam)))
        proof = Proof(model.raised_as(places), prune_nats, budget_horizons)
        found = proof.run(places)
    if found is None:
        raise NotLocated("no position in the search area is allowed", reason="outside_search_area")
    if found.search == "proven":
        if not places or np.abs(places[0].position_m - found.centres_m[0]).max() > PLACES_APART * found.half_m:
            places = merge_places(places, model.fit_places(found.centres_m, found.half_m, most=1))
        points, raised = np.reshape([one.position_m for one in places], (-1, 2)), model.raised_as(places)
        log_likelihood = [raised.score_place(one) for one in points]
        areas_m2 = [2 * np.pi * np.sqrt(np.linalg.det(one.covariance_m2)) for one in places]
        log_masses = np.add(log_likelihood, np.log(areas_m2))
        found = found._replace(  # the best place is the first reference of the sampling
            centres_m=np.vstack([points, found.centres_m]),
            log_weight=np.append(log_likelihood, found.log_weight),
            dropped_probability=proof.bound_dropped(found.log_weight, found.half_m, max(log_masses, default=-np.inf)),
        )
    return found, places


def merge_places(*parts: list[Place]) -> list[Place]:
    """The places of all parts that are apart, the likeliest first."""
    whole = sorted((one for part in parts for one in part), key=lambda one: -one.log_likelihood)
    if not whole:
        return []
    points, score = np.array([one.position_m for one in whole]), np.array([one.log_likelihood for one in whole])
    return [whole[i] for i in choose_apart(points, score, APART_M)]


@dataclass
class Proof:
    """A run of branch and bound: the work done, and how much probability was dropped."""

    model: BoxModel
    prune_nats: float  # boxes that are less likely than the best by more are dropped
    budget_horizons: float
    log_dropped: float = field(default=-np.inf, init=False)  # logarithm of a bound of the integral [m2]
    work: float = field(default=0.0, init=False)  # in horizons traced

    def run(self, places: list[Place]) -> Explored | None:
        """The boxes that may matter ("proven"); where the budget ends first, those about the best places ("beam").

        None where the budget ends and no place is known.

        Raises NotLocated (outside_search_area).
        """
        terrain = self.model.terrain
        best = max((self.model.score_place(one.position_m) for one in places), default=-np.inf)
        centres, half = np.array([terrain.searched[:2]]), terrain.searched[2]
        finest_m = min(FINEST_M, FINEST_PART * half)
        while True:
            count = len(centres)
            centres = self._bound(centres, half, best)
            is_last = 4 * len(centres) > LAST_MOST_BOXES
            if len(centres) and (half <= finest_m or is_last):
                average = self.model.averages(centres, half)
                order = np.argsort(-average, kind="stable")
                centres, average = centres[order], average[order]
                keep = average > average[0] - self.prune_nats
                if half <= finest_m or np.mean(keep) > 0.5:
                    self.log_dropped = self._with_dropped(average[~keep], half)
                    dropped = self.bound_dropped(average[keep], half)
                    return Explored(centres[keep], half, average[keep], dropped, "proven")
            quarters = split_boxes(centres, half, terrain)
            if not len(quarters) and not places:
                raise NotLocated(
                    "no camera can stand anywhere in the search area: is [search] max_slope_deg too small?",
                    reason="outside_search_area",
                )
            self.work += self._work_of(len(quarters))
            levels = np.arange(1, 1 + ceil(log2(max(half / 2 / finest_m, 1.0))))
            coming = self._work_of(float(np.sum(len(quarters) * (len(quarters) / count) ** levels)))
            is_hopeless = (
                half < FORESEEN_PART * terrain.searched[2] and coming > FORESEEN_BUDGETS * self.budget_horizons
            )
            if is_last or is_hopeless or not len(quarters) or self.work > self.budget_horizons:
                return boxes_about(places, terrain) if places else None
            centres, half = quarters, half / 2

    def _bound(self, centres: Array, half: float, best: float) -> Array:
        """Centres (n, 2) of the boxes that may matter.

        A large box is kept at a smaller likelihood: it holds more probability.
        """
        nats = self.prune_nats + max(0.0, 2.0 * float(np.log(half / FINEST_M)))
        upper = np.empty(len(centres))
        for start in range(0, len(centres), BOXES_AT_ONCE):
            check_time()
            some = slice(start, start + BOXES_AT_ONCE)
            upper[some] = self.model.bounds(centres[some], half)
        keep = upper > best - nats
        self.log_dropped = self._with_dropped(upper[~keep], half)
        return centres[keep]

    def bound_dropped(self, log_weight: Array, half_m: float, log_known: float = -np.inf) -> float:
        """Bound of the part of the posterior outside the boxes that are left, of `log_weight` (n,); 1: it has none.

        `log_known` is the logarithm of the integral of the likelihood [m2] about known places: where rows are strong
        it is more than the boxes hold by their averages.
        """
        log_mass = max(log_sum(log_weight) + float(np.log(4 * half_m**2)), log_known)
        return float(np.exp(min(self.log_dropped + SLACK_NATS - log_mass, 0.0)))

    def _work_of(self, boxes: float) -> float:
        """Cost of the bounds of so many boxes, in horizons traced."""
        return self.model.terrain.horizon_cost * LOOK_UP_COST * SECTORS * boxes

    def _with_dropped(self, log_likelihood: Array, half: float) -> float:
        """Logarithm of `log_dropped` [m2] with boxes added whose log-likelihoods have the bounds (n,)."""
        return float(np.logaddexp(self.log_dropped, log_sum(log_likelihood) + 2.0 * float(np.log(2 * half))))
