"""First positions that explain the evidence well: a beam search over ever smaller boxes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.core.types import Array
from startrack.localization.explored import Explored, log_sum, split_boxes, square_grid
from startrack.localization.likelihood import PositionLikelihood

TRACED_BELOW_M = 400.0  # half side; the horizons of smaller boxes may be traced instead of looked up
LAST_HALF_M = {False: 20.0, True: 12.0}  # half side of the last boxes, looked up or traced; smaller ones rank no better
# How many boxes are kept at each level, and whether the horizons of small boxes are traced. Looked-up horizons rank
# most positions right. Beside near crests they are too wide: of 9 positions on Shackleton's floor and walls they miss
# 2, where traced ones rank the true box among the first 70 at every level.
BEAMS = ((32, False), (80, True), (200, True))
SCORED, CLOSER = 8, 4  # of the last boxes, row by row; of these, at each smaller size
LAST_STEP_M, CLIMB_NATS = 1.0, 1.0  # of a climb; what it must gain to go on in steps of the same size
APART_M, MODE_NATS = 60.0, 12.0  # between the positions of a guess; less likely ones than the best by more are none
FIRST_REACH_M, LAST_REACH_M, ACROSS = 16.0, 256.0, 5  # of boxes about a position, and how many along a side
RIM_NATS = 3.0  # less probability than the whole has the rim of these boxes


@dataclass(frozen=True)
class Guess:
    """Positions that explain the evidence well, the best first, and their exact log-likelihoods."""

    points_m: Array  # (n, 2); n may be 0
    log_likelihood: Array  # (n,) lower bounds of the maximum

    @property
    def best(self) -> float:
        """Of the best position; -inf without one."""
        return float(self.log_likelihood.max(initial=-np.inf))


def beam_search(likelihood: PositionLikelihood, beam: tuple[int, bool]) -> Guess:
    """A few good positions: of ever smaller boxes those with the best average likelihood are quartered.

    The guess decides nothing: without a good one the proof takes longer.
    """
    return refine_boxes(likelihood, *_last_boxes(likelihood, *beam))


def _last_boxes(likelihood: PositionLikelihood, width: int, traced: bool) -> tuple[Array, float]:
    """Centres (n, 2) of the last boxes, the best average first, and half their side [m]."""
    terrain, (east_m, north_m, half) = likelihood.terrain, likelihood.terrain.searched
    centres = np.array([[east_m, north_m]])
    while half > LAST_HALF_M[traced] and len(centres):
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
        near, half = split_boxes(near, half, terrain), half / 2
        near = near[np.argsort(-likelihood.average.score(terrain, near, half), kind="stable")[:CLOSER]]
    found, score = np.zeros((0, 2)), np.zeros(0)
    new, step_m, gained = np.vstack([centres_m[:SCORED], near]), half_m, np.inf
    while len(new) and (step_m > LAST_STEP_M or gained > CLIMB_NATS):
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
    chosen: list[int] = []
    for i in np.argsort(-score, kind="stable"):
        if all(np.abs(found[i] - found[k]).max() > APART_M for k in chosen):
            chosen.append(int(i))
    return Guess(found[chosen], score[chosen])


def local_posterior(likelihood: PositionLikelihood, guess: Guess, log_open: float) -> Explored:
    """Boxes about the likely positions of a guess, where no proof excludes all others.

    `log_open` is the logarithm of a bound of the mass [m2] that the search left open elsewhere.
    """
    terrain, reach_m = likelihood.terrain, FIRST_REACH_M
    modes = guess.points_m[guess.log_likelihood > guess.best - MODE_NATS]
    while True:
        centres = (modes[:, None] + square_grid(reach_m, ACROSS)).reshape(-1, 2)
        score = np.where(terrain.allowed(centres), likelihood.exact_scores(centres), -np.inf)
        off = np.abs(centres[:, None] - modes).max(axis=2).min(axis=1)
        at_rim = log_sum(score[off > 0.9 * reach_m]) - log_sum(score)
        if at_rim < -RIM_NATS or reach_m >= LAST_REACH_M:
            break
        reach_m *= 2
    centres, score = np.vstack([guess.points_m, centres]), np.append(guess.log_likelihood, score)
    likely = np.isfinite(score)
    return Explored(centres[likely], reach_m / (ACROSS - 1), score[likely], log_open, "beam")
