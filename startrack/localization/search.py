"""The search for positions: likely places by a beam over ever smaller boxes, then branch and bound.

Boxes of positions are ranked by the search's likelihood, and places are fitted by the published one, of SkylineModel.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import ceil, log2
from typing import NamedTuple

import numpy as np

from startrack.core.limits import check_time
from startrack.core.types import MIDDLES_RAD, SECTORS, Array, Evidence, Explored, NotLocated, sector_of
from startrack.localization.likelihood.shared_errors import SharedErrors
from startrack.localization.likelihood.skyline_model import SkylineModel
from startrack.localization.likelihood.skyline_profiles import EDGE_SIGMAS
from startrack.localization.search_profiles import SLACK_NATS, SearchProfiles, sum_contributions
from startrack.terrain import Terrain, require_bounds

WITHIN_RAD = np.pi / SECTORS  # from the middle of a sector to its ends
MAP_SIGMAS = 6.0  # of errors of the map by which bounds are wider
NARROWEST_RAD = 1e-6  # of a range of skylines
TRACED_EVERY = 3  # sectors: a traced horizon costs a hundred times a look-up
SMALL_BOX_M = 20.0  # half side up to which boxes are tested for allowed ground point by point
QUARTERS = np.array([[-0.5, -0.5], [0.5, -0.5], [-0.5, 0.5], [0.5, 0.5]])  # of half a side
TRACED_BELOW_M = 400.0  # half side; the horizons of smaller boxes may be traced instead of looked up
FINEST_M, FINEST_PART = 12.0, 0.01  # half side of boxes that may be the last ones: at most, and in the half square
LAST_HALF_M = {False: SMALL_BOX_M, True: FINEST_M}  # of the last boxes, looked up or traced: smaller ones rank alike
FITTED, PLACES_APART = 4, 4.0  # boxes at which the model is fitted, and their distance in halves of boxes
FIT_M = 40.0  # half side of a neighbourhood, at least
FOLLOWED, FIT_NATS = 6, 0.5  # how often a fit follows its solution, and for what gain
POINT_M = 0.01  # half side of a box that stands for a point
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


class Place(NamedTuple):
    """A position that explains the rows, by the linear model of its neighbourhood."""

    position_m: Array  # (2,)
    covariance_m2: Array  # (2, 2)
    log_likelihood: float  # of SkylineModel, its shared errors integrated: not that of the search
    raised_rad: Array  # (SECTORS,) by how much errors that all azimuths share raise the skyline
    later_s: float  # how much later than that of the rows the true time is


def split_boxes(centres_m: Array, half_m: float, terrain: Terrain) -> Array:
    """Centres (m, 2) of the quarters of boxes that touch the searched disk and may hold ground for a camera.

    Small ones are tested on a grid that is closer than slopes change: at most single metres of a box's ground are
    missed.
    """
    centres = (centres_m[:, None] + half_m * QUARTERS).reshape(-1, 2)
    east_m, north_m, reach_m = terrain.searched
    beyond = np.maximum(np.abs(centres - [east_m, north_m]) - 0.5 * half_m, 0.0)
    centres = centres[np.hypot(beyond[:, 0], beyond[:, 1]) <= reach_m]
    if half_m > 2 * SMALL_BOX_M:
        return centres
    points = centres[:, None] + square_grid(0.5 * half_m, 5)
    return centres[np.any(terrain.allowed(points), axis=1)]


def square_grid(half_m: float, across: int) -> Array:
    """Points (across^2, 2) of an even grid about the origin, up to `half_m` from it along each axis."""
    line = np.linspace(-half_m, half_m, across)
    return np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)


def choose_apart(points: Array, score: Array, apart: float, nats: float = np.inf, most: int | None = None) -> list[int]:
    """Indices of the best points (n, d) by a score (n,) that are farther than `apart` from each other on an axis.

    Those that are worse than the best by more than `nats` do not count; `most` of them are chosen.
    """
    chosen: list[int] = []
    for i in np.argsort(-score, kind="stable"):
        if score[i] < score.max() - nats or len(chosen) == most:
            break
        if all(np.abs(points[i] - points[k]).max() > apart for k in chosen):
            chosen.append(int(i))
    return chosen


@dataclass(frozen=True, eq=False)
class BoxModel:
    """Model of the search's likelihood of `rows` on a `terrain`; `fit_places` alone has that of SkylineModel."""

    rows: Evidence
    terrain: Terrain
    profiles: SearchProfiles
    errors: SharedErrors  # that all azimuths share
    raised_rad: Array | float = 0.0  # (SECTORS,) by how much these raise the skyline

    @classmethod
    def of(cls, rows: Evidence, terrain: Terrain) -> BoxModel:
        """Model of `rows` on a `terrain` with the shared errors at zero."""
        return cls(rows, terrain, SearchProfiles.of(rows), SharedErrors.of(terrain, rows.clock))

    def raised_as(self, places: list[Place]) -> BoxModel:
        """Copy of this model with the errors that the first and best of `places` shows; itself without places."""
        return replace(self, raised_rad=places[0].raised_rad) if places else self

    def bounds(self, centres_m: Array, half_m: float) -> Array:
        """Upper bounds (n,) of the search's log-likelihood over boxes (n, 2)."""
        boxes = centres_m[:, None, :]
        low, high = self.terrain.horizon_bounds_rad(boxes, np.array(half_m), MIDDLES_RAD, WITHIN_RAD)
        require_bounds(self.terrain, low, high)
        wider = MAP_SIGMAS * self.terrain.errors.most_sigma_rad(boxes, half_m, MIDDLES_RAD, WITHIN_RAD)
        return self.profiles.bound(low + self.raised_rad - wider, high + self.raised_rad + wider)

    def search_score_at(self, point_m: Array) -> float:
        """Log-likelihood of the search at a position (2,), each row beside the horizon at its own azimuth."""
        rows, sector = self.rows, sector_of(self.rows.azimuth_rad)
        raised = np.broadcast_to(self.raised_rad, SECTORS)[sector]
        low, high = self.terrain.horizon_bounds_rad(point_m[None, None], np.array(POINT_M), MIDDLES_RAD, WITHIN_RAD)
        horizon = 0.5 * (low + high)[0, sector] + raised
        near = np.abs(rows.elevation_rad - horizon) <= 0.5 * (high - low)[0, sector] + EDGE_SIGMAS * rows.edge_sigma_rad
        horizon[near] = np.ravel(self.terrain.horizon_rad(point_m[None], rows.azimuth_rad[near])) + raised[near]
        return self.profiles.score(sum_contributions(rows, rows.elevation_rad - horizon))

    def averages(self, centres_m: Array, half_m: float, is_traced: bool = False) -> Array:
        """Mean log-likelihoods (n,) of the search over boxes (n, 2).

        By bounds of the horizon, or, if it `is_traced`, by its estimated spread about that of each centre in every
        third sector.
        """
        azimuth, boxes = MIDDLES_RAD[:: TRACED_EVERY if is_traced else 1], centres_m[:, None, :]
        if is_traced:
            middle, width = self.terrain.horizon_spread_rad(boxes, half_m, azimuth)
            low, high = middle - width, middle + width
        else:
            low, high = self.terrain.horizon_bounds_rad(boxes, np.array(half_m), azimuth, WITHIN_RAD)
            require_bounds(self.terrain, low, high)
        if self.terrain.errors.height_sigma_m > 0.0:
            sigma = self.terrain.errors.most_sigma_rad(boxes, half_m, azimuth, WITHIN_RAD)
            low, high = low - sigma, high + sigma
        raised = np.broadcast_to(self.raised_rad, SECTORS)[:: SECTORS // len(azimuth)]
        return self.profiles.average(low + raised - NARROWEST_RAD, high + raised + NARROWEST_RAD)

    def last_boxes(self, width: int, is_traced: bool) -> tuple[Array, float]:
        """Centres (n, 2) of the last boxes, the best average first, and half their side [m].

        Of ever smaller boxes those with the best average are quartered.
        """
        terrain, (east_m, north_m, half) = self.terrain, self.terrain.searched
        centres = np.array([[east_m, north_m]])
        while half > LAST_HALF_M[is_traced] and len(centres):
            check_time()
            centres, half = split_boxes(centres, half, terrain), half / 2
            score = self.averages(centres, half, is_traced and half < TRACED_BELOW_M)
            centres = centres[np.argsort(-score, kind="stable")[:width]]
        return centres, half

    def fit_places(self, centres_m: Array, half_m: float, most: int = FITTED) -> list[Place]:
        """The places near the first of boxes (n, 2) that are apart, the likeliest first; none where none is allowed."""
        order = -np.arange(len(centres_m), dtype=np.float64)
        chosen = choose_apart(centres_m, order, PLACES_APART * half_m, most=most)
        found = [self._fit(centres_m[i], half_m) for i in chosen]
        return sorted((one for one in found if one is not None), key=lambda one: -one.log_likelihood)

    def _fit(self, centre_m: Array, half_m: float) -> Place | None:
        """The likeliest place that linear solutions lead to from a box; None where no ground of it is allowed."""
        points = centre_m + square_grid(half_m, 5)
        points = points[np.asarray(self.terrain.allowed(points))]
        if not len(points):
            return None
        at_m, best = points[np.argmin(np.linalg.norm(points - centre_m, axis=1))], None
        for _ in range(FOLLOWED):
            check_time()
            model = SkylineModel.of(self.terrain, self.rows, at_m, 0.0, self.errors, self.rows.image_errors)
            found = _place_of(model)
            gained = np.inf if best is None else found.log_likelihood - best.log_likelihood
            if gained > 0.0:
                best = found
            if gained < FIT_NATS or (found.position_m == at_m).all():
                break
            at_m = found.position_m
        return best


def _place_of(model: SkylineModel) -> Place:
    """Place at the likelier of a model's reference and the linear solution about it, if that is allowed."""
    linear, covariance, weight = model.solve_linear()
    tried = model.with_likely_errors(model.around.reference_m[None], weight)
    if bool(model.terrain.allowed(linear[None, :2])[0]):
        tried = np.vstack([tried, linear])
    value = model.log_likelihood(tried) - 0.5 * np.square(tried[:, 2:]).sum(axis=1)
    best = tried[np.argmax(value)]
    log_spread = 0.5 * float(np.linalg.slogdet(covariance[2:, 2:])[1])  # of the errors: alike for places that compete
    errors = model.basis.mean + model.basis.shown @ best[2:]
    later_s = float(errors[-1]) if model.errors.clock is not None else 0.0
    raised, fit = errors @ model.error_slopes_rad, float(value.max()) + log_spread + model.seen.log_offset
    return Place(best[:2], covariance[:2, :2], fit, raised, later_s)


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
        points = np.reshape([one.position_m for one in places], (-1, 2))
        log_likelihood = [proof.model.search_score_at(one) for one in points]  # as the boxes'
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
        best = max((self.model.search_score_at(one.position_m) for one in places), default=-np.inf)
        centres, half = np.array([terrain.searched[:2]]), terrain.searched[2]
        finest_m = min(FINEST_M, FINEST_PART * half)
        while True:
            count = len(centres)
            centres = self._prune(centres, half, best)
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
                if is_last:
                    return boxes_about(places, terrain) if places else None
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
            if is_hopeless or not len(quarters) or self.work > self.budget_horizons:
                return boxes_about(places, terrain) if places else None
            centres, half = quarters, half / 2

    def _prune(self, centres: Array, half: float, best: float) -> Array:
        """Centres (n, 2) of the boxes that may matter; the others are added to what is dropped.

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
