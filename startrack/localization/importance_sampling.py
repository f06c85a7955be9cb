"""Adaptive importance sampling of a posterior about its modes, with all rounds weighed together.

Each round draws from t distributions about the modes, a part of the points farther out in position; the weight of a
point is the posterior over the mixture of all rounds' distributions. Between rounds the distributions move to the
weighted points. Source: adaptive multiple importance sampling, Cornuet et al. 2012, Scand. J. Statist. 39, 798.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import log, pi
from typing import Protocol

import numpy as np

from startrack.core.limits import check_time
from startrack.core.statistics import shares
from startrack.core.types import Array

DEGREES, FAR_DEGREES = 5.0, 3.0  # of freedom of the t distributions
FAR_PART, FAR, FAR_OTHERS = 0.4, 4.0, 1.4  # of the points; how much farther out, in position and in the others
ROUNDS = (120, 120, 160, 200, 240, 320, 400, 520, 640, 880)  # points
MORE_POINTS = 0.3  # part by which each further dimension has more
ENOUGH, FEW = 750.0, 60.0  # effective points that end the rounds, and those of a less likely hypothesis
TEMPERED = 7.0  # effective points a dimension to which weights are tempered before the distributions move
KEPT_PART = 0.03  # of the former covariance
LEAST_WEIGHT = 1e-5  # of a mode; a lighter one is dropped

LogDensity = Callable[[Array], Array]
Gaussian = tuple[Array, Array]  # mean (d,) and covariance (d, d)


class Distribution(Protocol):
    """A distribution of which `count` points are drawn."""

    @property
    def count(self) -> int: ...

    def draw(self, first: int) -> Array:
        """Points (count, d), from the sequence's number `first` on."""

    def log_density(self, points: Array) -> Array:
        """(n,) at points (n, d)."""


@dataclass(frozen=True, eq=False)
class TDistribution:
    """A t distribution of `degrees` of freedom."""

    mean: Array
    root: Array  # (d, d) of its covariance, lower triangular
    degrees: float
    count: int

    def draw(self, first: int) -> Array:
        """Points (count, d), from the sequence's number `first` on."""
        from scipy.special import gammaincinv

        unit, uniform = normal_sequence(len(self.mean), first, self.count)
        size = np.sqrt(self.degrees / (2.0 * gammaincinv(0.5 * self.degrees, uniform)))
        return np.asarray(self.mean + (unit * size[:, None]) @ self.root.T)

    def log_density(self, points: Array) -> Array:
        """Logarithm (n,) of the density at points (n, d)."""
        return log_t_density(np.asarray(np.linalg.solve(self.root, (points - self.mean).T)), self.degrees) - float(
            np.log(np.diag(self.root)).sum()
        )


@dataclass(frozen=True, eq=False)
class BoxDistribution:
    """Equal square boxes of positions, uniform in each, with normal other parameters about its own."""

    centres: Array  # (m, d)
    half_m: float
    share: Array  # (m,) of the probability
    root: Array  # (d - 2, d - 2) of the other parameters' covariance, lower triangular
    count: int

    def draw(self, first: int) -> Array:
        """Points (count, d), from the sequence's number `first` on."""
        from scipy.special import ndtr

        d = self.centres.shape[1]
        unit, uniform = normal_sequence(d, first, self.count)
        box = np.minimum(np.searchsorted(np.cumsum(self.share), uniform), len(self.share) - 1)
        found = self.centres[box]
        found[:, :2] += self.half_m * (2.0 * ndtr(unit[:, :2]) - 1.0)
        found[:, 2:] += unit[:, 2:] @ self.root.T
        return found

    def log_density(self, points: Array) -> Array:
        """Logarithm (n,) of the density at points (n, d)."""
        inside = np.abs(points[:, None, 0] - self.centres[:, 0]) <= self.half_m
        inside &= np.abs(points[:, None, 1] - self.centres[:, 1]) <= self.half_m
        point, box = np.nonzero(inside)
        off = np.linalg.solve(self.root, (points[point, 2:] - self.centres[box, 2:]).T)
        log = -0.5 * np.square(off).sum(axis=0) - 0.5 * len(off) * np.log(2 * pi) - np.log(np.diag(self.root)).sum()
        each = self.share[box] / (4 * self.half_m**2) * np.exp(log)
        return np.log(np.bincount(point, weights=each, minlength=len(points)) + np.finfo(float).tiny)


def log_t_density(off: Array, degrees: float) -> Array:
    """Logarithm (n,) of the density of a t distribution of unit size at offsets (d, n)."""
    from scipy.special import gammaln

    d = len(off)
    norm = gammaln(0.5 * (degrees + d)) - gammaln(0.5 * degrees) - 0.5 * d * log(degrees * pi)
    return np.asarray(norm - 0.5 * (degrees + d) * np.log1p(np.square(off).sum(axis=0) / degrees))


@lru_cache(maxsize=256)
def normal_sequence(dimensions: int, first: int, count: int) -> tuple[Array, Array]:
    """Normal numbers (count, dimensions) and uniform ones (count,), evenly spread, always the same.

    Source: the additive recurrence of Roberts 2018 with the roots of x^(d + 1) = x + 1.
    """
    from scipy.special import ndtri

    root = 2.0
    for _ in range(40):
        root = (1.0 + root) ** (1.0 / (dimensions + 2))
    step = root ** -np.arange(1.0, dimensions + 2)
    uniform = np.clip((0.5 + np.arange(first + 1, first + count + 1)[:, None] * step) % 1.0, 1e-9, 1 - 1e-9)
    return ndtri(uniform[:, :-1]), np.clip(uniform[:, -1], 1e-6, 1.0)


@dataclass(frozen=True, eq=False)
class WeightedPoints:
    """Points of a posterior: parameters (n, d), the first two of which are the position, and logarithms of weights.

    The sum of the weights is the evidence: the integral of the density.
    """

    points: Array
    log_weight: Array
    log_drawn: Array  # (n,) logarithm of the density that the points were drawn with, times their number

    @property
    def log_evidence(self) -> float:
        """Logarithm of the integral of the density."""
        return float(np.logaddexp.reduce(self.log_weight))

    @property
    def share(self) -> Array:
        """Shares (n,) of the points in the whole."""
        return shares(self.log_weight)

    def likeliest(self, among: Array) -> Array:
        """Point (d,) of the greatest density of those that `among` (n,) marks."""
        return np.asarray(self.points[np.argmax(np.where(among, self.log_weight + self.log_drawn, -np.inf))])

    @property
    def effective(self) -> float:
        """Number of independent points that the weighted ones are worth."""
        return effective_points(self.log_weight)


def effective_points(log_weight: Array) -> float:
    """Number of independent points that points with these logarithms (n,) of weights are worth."""
    weight = np.exp(log_weight - log_weight.max())
    return float(weight.sum() ** 2 / np.square(weight).sum())


def temper_weights(log_weight: Array, effective: float) -> Array:
    """Shares (n,) of points by weights that are drawn together until so many effective points count."""
    flat = log_weight - log_weight.max()
    most = 0.5 * np.count_nonzero(np.isfinite(flat))  # nothing gives more to points of no density
    while effective_points(flat) < min(effective, most):
        flat = 0.6 * flat
    weight = np.exp(flat)
    return np.asarray(weight / weight.sum())


def moments(points: Array, weight: Array) -> Gaussian:
    """Mean (d,) and covariance (d, d) of `points` (n, d) with `weight` (n,)."""
    mean = weight @ points / weight.sum()
    off = points - mean
    return mean, (off * weight[:, None]).T @ off / weight.sum()


def sample(
    log_density: LogDensity,
    modes: Sequence[Gaussian],
    rounds: Sequence[int] = ROUNDS,
    first: Sequence[Distribution] = (),
    enough: float = ENOUGH,
) -> WeightedPoints:
    """Weighted points of exp(log_density), which takes points (n, d), from about its `modes`.

    The first round draws from the distributions `first` besides; `enough` effective points end the rounds.
    """
    d = len(modes[0][0])
    points, density, drawn_by = np.zeros((0, d)), np.zeros(0), np.zeros(0)
    parts: list[Distribution] = []
    modes = list(modes)
    more = 1.0 + MORE_POINTS * (d - 2)
    for number, count in enumerate(rounds):
        check_time()
        new = [*_parts(modes, round(more * count)), *(first if number == 0 else ())]
        drawn = _draw(new, len(points))
        drawn_by = np.logaddexp(drawn_by, _log_mixture(new, points)) if number else drawn_by
        parts.extend(new)
        points, density = np.concatenate([points, drawn]), np.concatenate([density, log_density(drawn)])
        drawn_by = np.concatenate([drawn_by, _log_mixture(parts, drawn)])
        found = WeightedPoints(points, density - drawn_by, drawn_by)
        if not np.isfinite(found.log_weight).any():
            continue
        if found.effective > enough:
            break
        modes = _move(found, modes)
    return found


def _parts(modes: Sequence[Gaussian], count: int) -> list[Distribution]:
    """Distributions of one round: about each mode a near and a far one, of `count` points together."""
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
    """Lower triangular root (d, d) of the covariance of a `root` (d, d)."""
    return np.asarray(np.linalg.cholesky(root @ root.T))


def _draw(parts: Sequence[Distribution], first: int) -> Array:
    """Points (n, d) of the distributions, from the sequence's number `first` on."""
    drawn = []
    for part in parts:
        drawn.append(part.draw(first))
        first += part.count
    return np.concatenate(drawn)


def _log_mixture(parts: Sequence[Distribution], points: Array) -> Array:
    """Logarithm (n,) of the density at `points` (n, d) of all points that the distributions draw."""
    return np.asarray(np.logaddexp.reduce([log(part.count) + part.log_density(points) for part in parts], axis=0))


def _move(found: WeightedPoints, modes: Sequence[Gaussian]) -> list[Gaussian]:
    """The modes moved to the weighted points nearest to each."""
    weight = temper_weights(found.log_weight, TEMPERED * found.points.shape[1] * len(modes) ** 0.5)
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
