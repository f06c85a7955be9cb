"""Linear models whose unknowns have a normal prior about 0 of unknown width: the data choose the width.

Source: MacKay 1992, Neural Computation 4, 415 (the evidence of a regularization).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from startrack.core.types import Array

FILE_PROBABILITY = 0.95  # of the first prior: that a file is right; the others are equally probable


@dataclass(frozen=True)
class PriorChoice:
    """The posterior with the prior that makes the data most probable."""

    prior: int  # its index
    step: Array  # (k,) mean
    covariance: Array  # (k, k)


def solve_with_best_prior(normal: Array, right: Array, roots: Sequence[Array]) -> PriorChoice:
    """The posterior of unknowns from normal equations (k, k), (k,), with the most probable of several priors.

    The first is that of a right file. Each is given by a root (k, j) of its covariance, root @ root.T; a direction
    without variance stays 0.
    """
    best, most = PriorChoice(0, np.zeros(len(right)), np.zeros_like(normal)), -np.inf
    for number, root in enumerate(roots):
        log_weight, step, covariance = solve_with_prior(normal, right, root)
        if number > 0:
            log_weight += float(np.log((1.0 - FILE_PROBABILITY) / FILE_PROBABILITY / (len(roots) - 1)))
        if log_weight > most:
            most, best = log_weight, PriorChoice(number, step, covariance)
    return best


def solve_with_prior(normal: Array, right: Array, root: Array) -> tuple[float, Array, Array]:
    """Log of the data's probability (but for a constant of all priors), mean (k,) and covariance (k, k) with a prior.

    The arguments are those of `solve_with_best_prior`, the prior's `root` (k, j) one of its roots.
    """
    inner, pull = np.eye(root.shape[1]) + root.T @ normal @ root, root.T @ right
    step = np.linalg.solve(inner, pull)
    log_probability = 0.5 * float(pull @ step) - 0.5 * float(np.linalg.slogdet(inner)[1])
    return log_probability, root @ step, root @ np.linalg.solve(inner, root.T)


def root_of(covariance: Array) -> Array:
    """A root (k, k) of a covariance (k, k), which may be singular and of any units."""
    unit = np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
    values, axes = np.linalg.eigh(covariance / unit / unit[:, None])
    return np.asarray(unit[:, None] * axes * np.sqrt(np.maximum(values, 0.0)))
