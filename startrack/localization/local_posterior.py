"""The posterior near the positions of the first guess, where the proof that no other fits was not completed."""

from __future__ import annotations

import numpy as np

from startrack.localization.explored import Explored
from startrack.localization.initial_guess import Guess
from startrack.localization.likelihood import PositionLikelihood
from startrack.types import Array

MODE_NATS = 12.0  # positions that are less likely than the best by more are no modes
FIRST_HALF_M, LAST_HALF_M = 48.0, 400.0  # of the square about a position
FIRST_CELLS, MAX_CELLS = 16, 64  # boxes from the middle of a square to its side
EDGE_MASS = 1e-4  # of a square's probability may lie in its outermost boxes
REACH_SIGMAS = 5.0  # from the middle of a square to its side, along the longer axis of the mode
BOXES_PER_SIGMA = 1.0  # of the shorter axis
MIN_BOXES_PER_SIGMA = 1.5  # boxes within a standard deviation of the shorter axis, else smaller boxes are scored
MAX_ROUNDS = 10
NODE_STEP_M, MIN_NODES, MAX_NODES = 12.0, 5, 13  # distance of traced horizons; points along a side


def local_posterior(
    likelihood: PositionLikelihood, guess: Guess, log_open: float, first_half_m: float = FIRST_HALF_M
) -> Explored:
    """The posterior on squares about the guess's positions, as large as their modes need.

    `log_open` is the logarithm of a bound of the mass [m2] that the search left open elsewhere; `first_half_m` half the
    side of the first squares.
    """
    modes = guess.points_m[guess.log_likelihood > guess.best - MODE_NATS]
    squares = [_square(likelihood, position, min(first_half_m, FIRST_HALF_M)) for position in modes]
    half = max(min(square[2] for square in squares), max(square[1] for square in squares) / (4 * MAX_CELLS))
    parts = [_score(likelihood, middle, size, half, NODE_STEP_M) for middle, size, _ in squares]
    centres = np.concatenate([part[0] for part in parts])
    score = np.concatenate([part[1] for part in parts])
    # Squares of neighbouring modes overlap: each box counts once.
    _, first = np.unique(np.round(centres / (2 * half)).astype(np.int64), axis=0, return_index=True)
    return Explored(centres[first], half, score[first], log_open, "beam")


def _square(likelihood: PositionLikelihood, position_m: Array, first_half_m: float) -> tuple[Array, float, float]:
    """Middle (2,) and half side of a square that holds the mode, and half side of boxes that resolve it [m]."""
    middle, size, grown, finest = position_m, first_half_m, False, likelihood.terrain.finest_m
    for _ in range(MAX_ROUNDS):
        half = size / (2 * FIRST_CELLS)
        centres, score = _score(likelihood, middle, size, half, size)
        if not np.isfinite(score).any():
            return middle, size, half
        weight = np.exp(score - score.max())
        weight /= weight.sum()
        rim = np.abs(centres - middle).max(axis=1) > size - 2.5 * half
        if weight[rim].sum() >= EDGE_MASS and size < LAST_HALF_M:
            size, grown = 2 * size, True
            continue
        mean = weight @ centres
        variances = np.linalg.eigvalsh(((centres - mean) * weight[:, None]).T @ (centres - mean))
        narrow, wide = np.sqrt(np.maximum(variances, half**2 / 3))
        closer = REACH_SIGMAS * max(wide, half) + half
        if grown or narrow > 2 * half * MIN_BOXES_PER_SIGMA or half <= finest or closer > 0.8 * size:
            break
        middle, size = mean, closer  # too coarse: look closer
    size = min(REACH_SIGMAS * wide + float(np.abs(mean - middle).max()), 1.5 * size)
    return mean, size, max(0.5 * narrow / BOXES_PER_SIGMA, finest)


def _score(
    likelihood: PositionLikelihood, middle_m: Array, size: float, half: float, node_step_m: float
) -> tuple[Array, Array]:
    """Centres (n, 2) of a square's boxes where a camera can stand, on one grid for all squares, and scores (n,)."""
    across = int(np.clip(np.ceil(2 * size / node_step_m) + 1, MIN_NODES, MAX_NODES))
    count = max(int(np.ceil(size / (2 * half))), 1)
    line = 2 * half * np.arange(-count, count + 1)
    on_grid = 2 * half * np.round(middle_m / (2 * half))
    centres = on_grid + np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    centres = centres[np.asarray(likelihood.terrain.allowed(centres))]
    return centres, likelihood.near(middle_m, size + 2 * half, across=across).scores(centres)
