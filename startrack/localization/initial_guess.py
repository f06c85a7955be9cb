"""First positions that explain the evidence well: a beam search over ever smaller boxes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from startrack.localization.boxes import split_boxes
from startrack.localization.likelihood import PositionLikelihood
from startrack.localization.local_search import LocalLikelihood
from startrack.terrain import Terrain
from startrack.types import Array, Bools, Ints

FIRST_ACROSS = 8  # boxes along each side of the searched square at the beginning
SMALL_BOX_M = 20.0  # half side up to which boxes are tested for allowed ground point by point
TRACED_BELOW_M = 400.0  # half side; the horizons of smaller boxes may be traced instead of looked up
LAST_HALF_M = {False: 20.0, True: 12.0}  # half side of the last boxes, looked up or traced; smaller ones rank no better
EXPLAINED_NATS = -0.8  # mean over the sectors with rows; true positions: -0.2 to -0.65, the best false one seen: -1.2
SCORED = 16  # of the last boxes, row by row
CANDIDATES, APART_M = 3, 60.0  # positions that are climbed from, and how far they are apart
LAST_STEP_M = 0.5
CLIMBS = ((45.0, 16.0, 2), (15.0, 4.0, 3))  # neighbourhood [m], first step [m], points across where horizons are traced
GRID_M = np.linspace(-14.0, 14.0, 15)
STRONG_LLR, MANY_ROWS = 1.0, 2000  # of many rows only the strong ones rank candidates


@dataclass(frozen=True)
class Beam:
    """How many boxes are kept at each level, and whether the horizons of small boxes are traced."""

    width: int
    traced: bool


# Looked-up horizons rank most positions right. Beside near crests they are too wide: of 9 positions on Shackleton's
# floor and walls they miss 2, where traced ones rank the true box among the first 70 at every level.
BEAMS = (Beam(32, traced=False), Beam(80, traced=True), Beam(200, traced=True))


@dataclass(frozen=True)
class Guess:
    """Positions that explain the evidence well, the best first, and their exact log-likelihoods."""

    points_m: Array  # (n, 2); n may be 0
    log_likelihood: Array  # (n,) lower bounds of the maximum

    @property
    def best(self) -> float:
        return float(self.log_likelihood.max(initial=-np.inf))


NO_GUESS = Guess(np.zeros((0, 2)), np.zeros(0))


def beam_search(likelihood: PositionLikelihood, beams: tuple[Beam, ...] = BEAMS) -> Guess:
    """A few good positions; of the `beams` the wider ones follow where narrow ones find none that explains all sectors.

    The guess decides nothing: without a good one the proof takes longer.
    """
    found = NO_GUESS
    for found in widening_guesses(likelihood, beams):
        if is_likely_true(found.best, likelihood):
            break
    return found


def widening_guesses(likelihood: PositionLikelihood, beams: tuple[Beam, ...] = BEAMS) -> Iterator[Guess]:
    """The best guess so far after each of the `beams`: of ever smaller boxes those with the best average likelihood
    are quartered.
    """
    found = NO_GUESS
    for beam in beams:
        found = climb_to_best(likelihood, _last_boxes(likelihood, beam), found)
        yield found


def climb_to_best(likelihood: PositionLikelihood, centres_m: Array, known: Guess) -> Guess:
    """The best positions near the first of the centres (n, 2) [m], or those `known` if they are better."""
    guess = _climb(likelihood, centres_m[:SCORED])
    return guess if guess.best > known.best else known


def holds_allowed_ground(terrain: Terrain, centres_m: Array, half_m: float) -> Bools:
    """Boxes (n,) that may hold a position where a camera can stand: all but small ones, which are tested on a grid.

    The grid is closer than slopes change: at most single metres of a small box's ground are missed.
    """
    if half_m > SMALL_BOX_M:
        return np.ones(len(centres_m), dtype=bool)
    steps = np.linspace(-half_m, half_m, 5)
    x, y = np.meshgrid(steps, steps)
    points = centres_m[:, None, :] + np.stack([x.ravel(), y.ravel()], axis=1)
    return np.asarray(np.any(terrain.allowed(points), axis=1))


def _last_boxes(likelihood: PositionLikelihood, beam: Beam) -> Array:
    """Centres (n, 2) of the last boxes, the best average first."""
    terrain, average = likelihood.terrain, likelihood.average
    east_m, north_m, reach = terrain.searched
    half = reach / FIRST_ACROSS
    line = half * (2 * np.arange(FIRST_ACROSS) + 1) - reach
    offsets = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    beyond = np.maximum(np.abs(offsets) - half, 0.0)
    centres = np.array([east_m, north_m]) + offsets[np.hypot(beyond[:, 0], beyond[:, 1]) <= reach]
    while True:
        centres = centres[holds_allowed_ground(terrain, centres, half)]
        score = average.score(terrain, centres, half, traced=beam.traced and half < TRACED_BELOW_M)
        centres = centres[np.argsort(-score, kind="stable")[: beam.width]]
        if half <= LAST_HALF_M[beam.traced] or not len(centres):
            return centres
        centres, half = split_boxes(centres, half, terrain.searched)[0], half / 2


def _climb(likelihood: PositionLikelihood, centres_m: Array) -> Guess:
    """The best positions near those of the centres (n, 2) that score best."""
    strong = likelihood.strong(STRONG_LLR, MANY_ROWS)
    points: list[Array] = []
    for box in _distinct(centres_m, np.argsort(-strong.exact_scores(centres_m), kind="stable")):
        way, local = strong.climb(centres_m[box], CLIMBS, LAST_STEP_M)
        points.extend(_allowed_near(way, local, likelihood.terrain))
    found = np.array(points).reshape(-1, 2)
    score = likelihood.exact_scores(found)
    best = np.array(_distinct(found, np.argsort(-score, kind="stable")), dtype=np.int64)
    return Guess(found[best], score[best])


def _allowed_near(points_m: Array, local: LocalLikelihood, terrain: Terrain) -> Array:
    """Those of the positions (n, 2) where a camera can stand; where none is, the best one nearby, if any."""
    allowed = np.asarray(terrain.allowed(points_m))
    if allowed.any():
        return points_m[allowed]
    around = points_m[-1] + np.stack(np.meshgrid(GRID_M, GRID_M), axis=-1).reshape(-1, 2)
    around = around[np.asarray(terrain.allowed(around))]
    return around[np.argsort(-local.scores(around))[:1]]


def _distinct(points_m: Array, order: Ints) -> list[int]:
    """The first few of the points (n, 2) in that order, without those close to an earlier one."""
    chosen: list[int] = []
    for i in order:
        if len(chosen) < CANDIDATES and all(np.abs(points_m[i] - points_m[k]).max() > APART_M for k in chosen):
            chosen.append(int(i))
    return chosen


def is_likely_true(log_likelihood: float, likelihood: PositionLikelihood) -> bool:
    """Whether a position explains the evidence so well that no better one is looked for before the proof."""
    return log_likelihood > EXPLAINED_NATS * likelihood.sectors.occupied
