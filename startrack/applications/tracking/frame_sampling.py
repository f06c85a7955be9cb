"""Points of the posterior by one exposure, or by several of a camera at rest, and their moments."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from startrack.applications.tracking.frame_model import UNKNOWN_M, FrameModel
from startrack.core.types import Array
from startrack.localization.importance_sampling import Gaussian, WeightedPoints, moments, sample

LEAST_CORRECTED = 0.1  # of a variance: the correction of moments makes it no smaller


def sample_together(models: Sequence[FrameModel], position_m: Array, covariance_m2: Array) -> WeightedPoints:
    """Points of the posterior by exposures of one position, with one reference, from near a position (2,)."""
    first = _first_gaussian(models, position_m, covariance_m2)
    for model in models:
        model.settle(first[0])

    def log_density(points: Array) -> Array:
        value, inside = np.full(len(points), -np.inf), models[0].is_allowed(points)
        if inside.any():
            within = points[inside]
            value[inside] = np.sum([model.log_likelihood(within) for model in models], axis=0)
            value[inside] -= 0.5 * np.square(within[:, 2:]).sum(axis=1)
        return value

    return sample(log_density, [first])


def _first_gaussian(models: Sequence[FrameModel], position_m: Array, covariance_m2: Array) -> Gaussian:
    """Mean and covariance of parameters: a position as it is given, and the errors that a linear model gives for it."""
    parts = [model.information() for model in models]
    information = np.sum([part[0] for part in parts], axis=0)
    information += np.diag(np.r_[np.full(2, UNKNOWN_M**-2), np.ones(len(information) - 2)])
    covariance = np.linalg.inv(information)
    best = covariance @ np.sum([part[1] for part in parts], axis=0)
    drift = np.linalg.solve(covariance[:2, :2], covariance[:2, 2:]).T  # of the errors with the position
    alone = covariance[2:, 2:] - drift @ covariance[:2, 2:]
    wide = covariance[:2, :2] + covariance_m2
    away = position_m - models[0].model.reference_m
    mean = np.r_[position_m, best[2:] + drift @ (away - best[:2])]
    return mean, np.block([[wide, wide @ drift.T], [drift @ wide, alone + drift @ wide @ drift.T]])


def balanced_moments(found: WeightedPoints) -> Gaussian:
    """Mean (d,) and covariance (d, d) of the points, corrected by what the same points give of a known Gaussian.

    What the evidence says nothing about keeps the covariance of its prior, which weighted points have to some percent.
    """
    mean, covariance = moments(found.points, found.share)
    root = np.linalg.cholesky(covariance)
    size2 = np.square(np.linalg.solve(root, (found.points - mean).T)).sum(axis=0)
    known = WeightedPoints(found.points, -0.5 * size2 - found.log_drawn, found.log_drawn)
    shown_mean, shown = moments(found.points, known.share)
    corrected = 2.0 * covariance - shown
    if np.linalg.eigvalsh(np.linalg.solve(root, np.linalg.solve(root, corrected).T))[0] < LEAST_CORRECTED:
        return mean, covariance
    return 2.0 * mean - shown_mean, corrected
