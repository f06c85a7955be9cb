"""Adaptive importance sampling of a posterior about its modes, with all rounds weighed together.

Each round draws from t distributions about the modes, a part of the points farther out in position; the weight of a
point is the posterior over the mixture of all rounds' distributions. Between rounds the distributions move to the
weighted points. Source: adaptive multiple importance sampling, Cornuet et al. 2012, Scand. J. Statist. 39, 798.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import log

import numpy as np

from startrack.core.types import Array
from startrack.localization.distributions import Distribution, TDistribution

DEGREES, FAR_DEGREES = 5.0, 3.0  # of freedom of the t distributions
FAR_PART, FAR, FAR_OTHERS = 0.4, 4.0, 1.4  # of the points; how much farther out, in position and in the others
ROUNDS = (200, 400, 800, 1000, 1200)  # points
MORE_POINTS = 0.3  # part by which each further dimension has more
LEAST_ROUNDS, ENOUGH = 3, 600.0  # after so many rounds so many effective points end them
TEMPERED = 7.0  # effective points a dimension to which weights are tempered before the distributions move
KEPT_PART = 0.03  # of the former covariance
LEAST_WEIGHT = 1e-5  # of a mode; a lighter one is dropped

LogDensity = Callable[[Array], Array]
Gaussian = tuple[Array, Array]  # mean (d,) and covariance (d, d)


@dataclass(frozen=True, eq=False)
class WeightedPoints:
    """Points of a posterior: parameters (n, d), the first two of which are the position, and logarithms of weights.

    The mean of the weights is the evidence: the integral of the density.
    """

    points: Array
    log_weight: Array
    log_drawn: Array  # (n,) logarithm of the density that the points were drawn with, less a constant

    @property
    def log_evidence(self) -> float:
        return float(np.logaddexp.reduce(self.log_weight))

    @property
    def share(self) -> Array:
        """(n,) parts of the whole."""
        return np.exp(self.log_weight - self.log_evidence)

    @property
    def effective(self) -> float:
        """How many independent points the weighted ones are worth."""
        return effective_points(self.log_weight)


def effective_points(log_weight: Array) -> float:
    weight = np.exp(log_weight - log_weight.max())
    return float(weight.sum() ** 2 / np.square(weight).sum())


def moments(points: Array, weight: Array) -> Gaussian:
    """Mean (d,) and covariance (d, d) of weighted points (n, d)."""
    mean = weight @ points / weight.sum()
    off = points - mean
    return mean, (off * weight[:, None]).T @ off / weight.sum()


def sample(
    log_density: LogDensity,
    modes: Sequence[Gaussian],
    rounds: Sequence[int] = ROUNDS,
    first: Sequence[Distribution] = (),
) -> WeightedPoints:
    """Weighted points of exp(log_density), which takes points (n, d), from about its `modes`.

    The first round draws from the distributions `first` besides.
    """
    points: list[Array] = []
    density: list[Array] = []
    parts: list[Distribution] = []
    modes = list(modes)
    more = 1.0 + MORE_POINTS * (len(modes[0][0]) - 2)
    for number, count in enumerate(rounds):
        new = [*_parts(modes, round(more * count)), *(first if number == 0 else ())]
        drawn = _draw(new, sum(len(one) for one in points))
        parts.extend(new)
        points.append(drawn)
        density.append(log_density(drawn))
        found = _weigh(np.concatenate(points), np.concatenate(density), parts)
        if not np.isfinite(found.log_weight).any():
            continue
        if number + 1 >= LEAST_ROUNDS and found.effective > ENOUGH:
            break
        modes = _move(found, modes)
    return found


def _parts(modes: Sequence[Gaussian], count: int) -> list[Distribution]:
    """The distributions of one round."""
    each, parts = max(count // len(modes), 40), list[Distribution]()
    for mean, covariance in modes:
        order = np.r_[2 : len(mean), 0, 1]  # position last: it is drawn beside the other parameters
        root = np.empty_like(covariance)
        root[order] = np.linalg.cholesky(covariance[np.ix_(order, order)])
        far = root * np.r_[np.full(len(mean) - 2, FAR_OTHERS), FAR, FAR]
        wide = round(FAR_PART * each)
        parts += [
            TDistribution(mean, _triangular(root), DEGREES, each - wide),
            TDistribution(mean, _triangular(far), FAR_DEGREES, wide),
        ]
    return parts


def _triangular(root: Array) -> Array:
    """The lower triangular root of the same covariance."""
    return np.asarray(np.linalg.cholesky(root @ root.T))


def _draw(parts: Sequence[Distribution], first: int) -> Array:
    """Points (n, d) of the distributions, from the sequence's number `first` on."""
    drawn = []
    for part in parts:
        drawn.append(part.draw(first))
        first += part.count
    return np.concatenate(drawn)


def _weigh(points: Array, density: Array, parts: Sequence[Distribution]) -> WeightedPoints:
    """Weights of points by the mixture of all distributions that any of them was drawn from."""
    mixture = np.asarray(np.logaddexp.reduce([log(part.count) + part.log_density(points) for part in parts], axis=0))
    return WeightedPoints(points, density - mixture, mixture)


def _move(found: WeightedPoints, modes: Sequence[Gaussian]) -> list[Gaussian]:
    """The modes moved to the weighted points nearest to each."""
    flat = found.log_weight - found.log_weight.max()
    most = 0.5 * np.count_nonzero(np.isfinite(flat))  # no tempering gives more to points of no density
    while effective_points(flat) < min(TEMPERED * found.points.shape[1] * len(modes) ** 0.5, most):
        flat = 0.6 * flat
    weight = np.exp(flat)
    weight /= weight.sum()
    roots = [np.linalg.cholesky(covariance) for _, covariance in modes]
    away = [
        np.square(np.linalg.solve(root, (found.points - mean).T)).sum(axis=0)
        for (mean, _), root in zip(modes, roots, strict=True)
    ]
    nearest, moved = np.argmin(away, axis=0), []
    for number, (_, covariance) in enumerate(modes):
        own = nearest == number
        if weight[own].sum() > LEAST_WEIGHT:
            mean, spread = moments(found.points[own], weight[own])
            moved.append((mean, spread + KEPT_PART * covariance))
    return moved
