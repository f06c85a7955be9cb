"""Samples of a posterior in a few dimensions, with weights, from a Gaussian that is fitted to it in rounds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from startrack.types import Array

COUNT_LOG2 = 10  # of samples, a Sobol sequence
WIDER = 1.4  # the proposal's standard deviations, in the posterior's
MIN_SAMPLES, ENOUGH = 100.0, 0.3  # effective samples of a round, and part of all samples in the last
MAX_ROUNDS = 12


@dataclass(frozen=True, eq=False)
class Samples:
    """Of a posterior: points (n, d) with weights (n,) that sum to 1."""

    points: Array
    weight: Array

    @property
    def mean(self) -> Array:
        """(d,)."""
        return np.asarray(self.weight @ self.points)

    @property
    def covariance(self) -> Array:
        """(d, d)."""
        return self.covariance_with(self.points)

    def covariance_with(self, values: Array) -> Array:
        """(d, m) between the parameters and other values (n, m) at the points."""
        away = (self.points - self.mean) * self.weight[:, None]
        return np.asarray(away.T @ (values - self.weight @ values))

    @property
    def effective(self) -> float:
        """As many equally weighted samples would do as well."""
        return float(1.0 / np.square(self.weight).sum())


def sample_posterior(log_density: Callable[[Array], Array], mean: Array, covariance: Array) -> Samples:
    """Samples of the distribution with that logarithm of its density at points (n, d), from a rough Gaussian.

    Adaptive importance sampling: each round proposes from a Gaussian with the moments of the last. As long as few
    samples have all the weight, the weights are raised to a power that leaves enough (Cappe et al. 2008, Statistics and
    Computing 18, 447).
    """
    unit = _normal_sequence(len(mean))
    for _ in range(MAX_ROUNDS):
        points = mean + WIDER * unit @ np.linalg.cholesky(covariance).T
        log_weight = log_density(points) + 0.5 * np.square(unit).sum(axis=1)
        power = _power(log_weight)
        samples = Samples(points, _normalised(power * log_weight))
        if power == 1.0 and samples.effective > ENOUGH * len(unit):
            break
        mean, covariance = samples.mean, samples.covariance
    return samples


def _power(log_weight: Array) -> float:
    """The largest power up to 1 with which the weights leave enough effective samples."""
    low, high = 0.0, 1.0
    if 1.0 / np.square(_normalised(log_weight)).sum() >= MIN_SAMPLES:
        return 1.0
    for _ in range(20):
        middle = 0.5 * (low + high)
        enough = 1.0 / np.square(_normalised(middle * log_weight)).sum() >= MIN_SAMPLES
        low, high = (middle, high) if enough else (low, middle)
    return max(low, 1e-6)


def _normalised(log_weight: Array) -> Array:
    weight = np.exp(log_weight - log_weight.max())
    return np.asarray(weight / weight.sum())


@lru_cache
def _normal_sequence(dimensions: int) -> Array:
    from scipy.special import ndtri
    from scipy.stats import qmc

    return np.asarray(ndtri(qmc.Sobol(dimensions, seed=1).random_base2(COUNT_LOG2)))
