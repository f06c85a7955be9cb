"""The search for positions: a first guess by a beam over ever smaller boxes, then branch and bound."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import ceil, log2

import numpy as np

from startrack.core.time_limit import check_time
from startrack.core.types import Array, Explored, NotLocated
from startrack.localization.likelihood import PositionLikelihood
from startrack.terrain import Terrain

NATS = 16.0  # positions that are e^-16 as likely as the best are dropped
SMALL_BOX_M = 20.0  # half side up to which boxes are tested for allowed ground point by point
QUARTERS = np.array([[-0.5, -0.5], [0.5, -0.5], [-0.5, 0.5], [0.5, 0.5]])  # of half a side
TRACED_BELOW_M = 400.0  # half side; the horizons of smaller boxes may be traced instead of looked up
FINEST_M, FINEST_PART = 12.0, 0.01  # half side of boxes that may be the last ones: at most, and in the half square
LAST_HALF_M = {False: SMALL_BOX_M, True: FINEST_M}  # of the last boxes, looked up or traced: smaller ones rank alike
# How many boxes are kept at each level, and whether the horizons of small boxes are traced. Looked-up horizons rank
# most positions right. Beside near crests they are too wide: of 9 positions on Shackleton's floor and walls they miss
# 2, where traced ones rank the true box among the first 70 at every level; of 8 on a map with errors of 5 m a post,
# one is not among the first 200.
BEAMS = ((32, False), (80, True), (200, True), (500, True))
SCORED, CLOSER = 8, 4  # of the last boxes, row by row; of these, at each smaller size
EXPLAINED_NATS = -0.57  # mean over the sectors with rows; true positions: -0.10 to -0.52, the best false one: -0.62
LAST_STEP_M, CLIMB_NATS = 1.0, 1.0  # of a climb; what it must gain to go on in steps of the same size
APART_M = 60.0  # between the positions of a guess
FIRST_REACH_M, LAST_REACH_M, BOXES_ACROSS = 16.0, 256.0, 5  # of boxes about a position, and how many along a side
RIM_NATS = 3.0  # less probability than the whole has the rim of these boxes
BOXES_AT_ONCE = 2000  # so that memory stays flat
# The search ends once the levels to come would take so many budgets, if boxes go on to grow in number as they do now.
# That is foreseen below this half side, of the searched radius: on a rough map from 125 m, in 34 searches always right.
FORESEEN_PART, FORESEEN_BUDGETS = 1 / 30, 2.0
LOOK_UP_COST = 0.08  # of a bound, in horizons traced
LAST_MOST_BOXES = 16_000  # of a level: it is the last one; from a sixteenth of it on a better position is sought


def log_sum(values: Array) -> float:
    """Logarithm of the sum of exponentials; -inf of none."""
    return float(np.logaddexp.reduce(values, initial=-np.inf))


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


@dataclass(frozen=True)
class Guess:
    """Positions that explain the evidence well, the best first, and their exact log-likelihoods."""

    points_m: Array  # (n, 2); n may be 0
    log_likelihood: Array  # (n,) lower bounds of the maximum

    @property
    def best(self) -> float:
        """Of the best position; -inf without one."""
        return float(self.log_likelihood.max(initial=-np.inf))


def explains_sectors(guess: Guess, likelihood: PositionLikelihood) -> bool:
    """Whether the best position of a `guess` explains all sectors as well as a true one does."""
    return guess.best > EXPLAINED_NATS * likelihood.sectors.occupied


def beam_search(likelihood: PositionLikelihood, beam: tuple[int, bool]) -> Guess:
    """A few good positions: of ever smaller boxes those with the best average likelihood are quartered.

    The guess decides nothing: without a good one the proof takes longer.
    """
    return refine_boxes(likelihood, *last_boxes(likelihood, *beam))


def last_boxes(likelihood: PositionLikelihood, width: int, traced: bool) -> tuple[Array, float]:
    """Centres (n, 2) of the last boxes, the best average first, and half their side [m]."""
    terrain, (east_m, north_m, half) = likelihood.terrain, likelihood.terrain.searched
    centres = np.array([[east_m, north_m]])
    while half > LAST_HALF_M[traced] and len(centres):
        check_time()
        centres, half = split_boxes(centres, half, terrain), half / 2
        score = likelihood.average.score(terrain, centres, half, traced=traced and half < TRACED_BELOW_M)
        centres = centres[np.argsort(-score, kind="stable")[:width]]
    return centres, half


def refine_boxes(likelihood: PositionLikelihood, centres_m: Array, half_m: float) -> Guess:
    """The best positions about the first of boxes with the centres (n, 2), the best average first.

    Ever smaller boxes of the best average, and climbs in ever smaller steps: where the rows are strong only an average
    shows from afar where the top is, and near it only the positions themselves.
    """
    terrain, near, half = likelihood.terrain, centres_m[:CLOSER], half_m
    while half > LAST_STEP_M and len(near):
        check_time()
        near, half = split_boxes(near, half, terrain), half / 2
        near = near[np.argsort(-likelihood.average.score(terrain, near, half), kind="stable")[:CLOSER]]
    found, score = np.zeros((0, 2)), np.zeros(0)
    new, step_m, gained = np.vstack([centres_m[:SCORED], near]), half_m, np.inf
    while len(new) and (step_m > LAST_STEP_M or gained > CLIMB_NATS):
        check_time()
        new = new[np.asarray(terrain.allowed(new))]
        before = float(score.max(initial=-np.inf))
        found, score = np.vstack([found, new]), np.append(score, likelihood.exact_scores(new))
        if not len(found):
            break
        gained = float(score.max()) - before
        if gained <= CLIMB_NATS:
            step_m /= 2
        around = found[np.argmax(score)] + square_grid(step_m, 3)
        new = around[np.abs(around[:, None] - found).max(axis=2).min(axis=1) > 0.1 * LAST_STEP_M]
    chosen = choose_apart(found, score, APART_M)
    return Guess(found[chosen], score[chosen])


def choose_apart(points: Array, score: Array, apart: float, nats: float = np.inf, most: int | None = None) -> list[int]:
    """The best of points (n, d) with a score (n,) that are farther `apart` from each other along an axis.

    Those that are worse than the best by more than `nats` do not count; `most` of them are chosen.
    """
    chosen: list[int] = []
    for i in np.argsort(-score, kind="stable"):
        if score[i] < score.max() - nats or len(chosen) == most:
            break
        if all(np.abs(points[i] - points[k]).max() > apart for k in chosen):
            chosen.append(int(i))
    return chosen


def local_posterior(likelihood: PositionLikelihood, guess: Guess, log_open: float) -> Explored:
    """Boxes about the likely positions of a guess, where no proof excludes all others.

    `log_open` is the logarithm of a bound of the mass [m2] that the search left open elsewhere.
    """
    terrain, reach_m = likelihood.terrain, FIRST_REACH_M
    modes = guess.points_m[guess.log_likelihood > guess.best - NATS]
    while True:
        check_time()
        centres = (modes[:, None] + square_grid(reach_m, BOXES_ACROSS)).reshape(-1, 2)
        score = np.where(terrain.allowed(centres), likelihood.exact_scores(centres), -np.inf)
        off = np.abs(centres[:, None] - modes).max(axis=2).min(axis=1)
        at_rim = log_sum(score[off > 0.9 * reach_m]) - log_sum(score)
        if at_rim < -RIM_NATS or reach_m >= LAST_REACH_M:
            break
        reach_m *= 2
    centres, score = np.vstack([guess.points_m, centres]), np.append(guess.log_likelihood, score)
    likely = np.isfinite(score)
    return Explored(centres[likely], reach_m / (BOXES_ACROSS - 1), score[likely], log_open, "beam")


@dataclass
class Search:
    """One run: the work done, how much probability was dropped, and the best log-likelihood known."""

    likelihood: PositionLikelihood
    guess: Guess
    prune_nats: float  # boxes that are less likely than the best by more are dropped
    budget_horizons: float
    log_dropped: float = -np.inf  # logarithm of a bound of the mass [m2]
    work: float = field(default=0.0, init=False)  # in horizons traced
    best: float = -np.inf  # log-likelihood known

    def run(self) -> Explored:
        """The boxes that may matter ("proven"); where the budget ends first, those about the best positions ("beam").

        Raises NotLocated (outside_search_area).
        """
        self.best, terrain = self.guess.best, self.likelihood.terrain
        centres, half = np.array([terrain.searched[:2]]), terrain.searched[2]
        finest_m = min(FINEST_M, FINEST_PART * half)
        while True:
            count = len(centres)
            centres, upper = self._bound(centres, half)
            if not len(centres):  # the best position known is in none: between the points where boxes were tested
                return self._about_best(upper, half)
            is_last = 4 * len(centres) > LAST_MOST_BOXES
            if 16 * len(centres) > LAST_MOST_BOXES and self._climb(centres, half):
                continue
            if half <= finest_m or is_last:
                average = self.likelihood.average.score(terrain, centres, half)
                likely = np.mean(average > average.max() - self.prune_nats)
                resolved = average.max() > self.guess.best - self.prune_nats and likely > 0.5
                if half <= finest_m or resolved:
                    return self._ranked(centres, average, half)
                return self._about_best(upper, half)
            quarters = split_boxes(centres, half, terrain)
            if not len(quarters):
                raise NotLocated(
                    "no camera can stand anywhere in the search area: is [search] max_slope_deg too small?",
                    reason="outside_search_area",
                )
            self.work += self._work_of(len(quarters))
            levels = np.arange(1, 1 + ceil(log2(max(half / 2 / finest_m, 1.0))))
            coming = self._work_of(float(np.sum(len(quarters) * (len(quarters) / count) ** levels)))
            hopeless = half < FORESEEN_PART * terrain.searched[2] and coming > FORESEEN_BUDGETS * self.budget_horizons
            if self.work > self.budget_horizons or hopeless:
                self._climb(centres, half)
                return self._about_best(upper, half)
            centres, half = quarters, half / 2

    def _bound(self, centres: Array, half: float) -> tuple[Array, Array]:
        """Centres (n, 2) of the boxes that may matter, and upper bounds (n,) of their log-likelihood.

        A large box is kept at a smaller likelihood: it holds more probability.
        """
        lk, kept = self.likelihood, []
        nats = self.prune_nats + max(0.0, 2.0 * float(np.log(half / FINEST_M)))
        for start in range(0, len(centres), BOXES_AT_ONCE):
            check_time()
            some = centres[start : start + BOXES_AT_ONCE]
            first, last = lk.sums.open_rays(lk.terrain, some, half)
            visible, least, most = lk.sums.sums(first, last)
            sure = lk.sectors.score(visible + least)[np.asarray(lk.terrain.allowed(some))]
            self.best = max(self.best, float(sure.max(initial=-np.inf)))
            upper = lk.sectors.score(visible + most)
            keep = upper > self.best - nats
            self._drop(upper[~keep], half)
            kept.append((some[keep], upper[keep]))
        return np.concatenate([part[0] for part in kept]), np.concatenate([part[1] for part in kept])

    def _climb(self, centres: Array, half: float) -> bool:
        """Whether a better position than the best known is near the boxes (n, 2) with the best average."""
        if explains_sectors(self.guess, self.likelihood):
            return False
        average = self.likelihood.average.score(self.likelihood.terrain, centres, half)
        found = refine_boxes(self.likelihood, centres[np.argsort(-average, kind="stable")], half)
        is_better = found.best > self.guess.best + CLIMB_NATS
        if is_better:
            self.guess, self.best = found, max(self.best, found.best)
        return is_better

    def _work_of(self, boxes: float) -> float:
        """Cost of the bounds of so many boxes, in horizons traced."""
        return self.likelihood.terrain.horizon_cost * LOOK_UP_COST * self.likelihood.sectors.count * boxes

    def _drop(self, log_likelihood: Array, half: float) -> None:
        lost = log_sum(log_likelihood) + 2.0 * float(np.log(2 * half))
        self.log_dropped = float(np.logaddexp(self.log_dropped, lost))

    def _ranked(self, centres: Array, average: Array, half: float) -> Explored:
        """The boxes with their average log-likelihood (n,), and the guess with its own; unlikely boxes are dropped."""
        keep = average > average.max() - self.prune_nats
        self._drop(average[~keep], half)
        centres = np.vstack([self.guess.points_m, centres[keep]])
        log_likelihood = np.append(self.guess.log_likelihood, average[keep])
        return Explored(centres, half, log_likelihood, self.log_dropped, "proven")

    def _about_best(self, upper: Array, half: float) -> Explored:
        """The neighbourhoods of the best positions known, where boxes with bounds (n,) are left open.

        Raises NotLocated (outside_search_area) where none is known.
        """
        self._drop(upper, half)
        if not len(self.guess.points_m):
            raise NotLocated("no position in the search area is allowed", reason="outside_search_area")
        return local_posterior(self.likelihood, self.guess, self.log_dropped)
