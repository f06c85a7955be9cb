"""Cross-validation: how well the stars that a fit did not see are predicted."""

from __future__ import annotations

import numpy as np

from startrack.calibration.observations import Observations
from startrack.calibration.solve import Solution
from startrack.types import Array, Ints

FOLDS = 10


def folds(points: Observations, angle_rad: Array) -> Ints:
    """Fold (n,) of each observation: every image and every ring is shared out evenly."""
    order = np.lexsort((angle_rad, points.image))
    fold = np.empty(len(points), dtype=np.int64)
    fold[order] = np.arange(len(points)) % FOLDS
    return fold


def held_out_residual_px(solution: Solution, fold: Ints) -> Array:
    """Residual (n, 2) [px] of each observation where lens and attitudes come from the other folds.

    One Gauss-Newton step away from the solution with all of them: at the minimum the fit is as good as linear.
    """
    terms, out = solution.terms, np.array(solution.residual_px)
    for k in range(FOLDS):
        away = np.flatnonzero(fold == k)
        if not len(away):
            continue
        part = type(terms)(terms.lens[away], terms.turn[away], terms.image[away], terms.images)
        kept = solution.normal.without(part.normal(solution.weight[away], solution.residual_px[away]))
        lens, turns = kept.solve()
        out[away] -= part.lens @ lens + np.einsum("nij,nj->ni", part.turn, turns[part.image])
    return out
