"""Distributions of parameters that points are drawn from, the first two of which are the position."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import log, pi
from typing import Protocol

import numpy as np

from startrack.core.types import Array


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
        """(n,) at points (n, d)."""
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
        """(n,) at points (n, d)."""
        inside = np.abs(points[:, None, 0] - self.centres[:, 0]) <= self.half_m
        inside &= np.abs(points[:, None, 1] - self.centres[:, 1]) <= self.half_m
        point, box = np.nonzero(inside)
        off = np.linalg.solve(self.root, (points[point, 2:] - self.centres[box, 2:]).T)
        log = -0.5 * np.square(off).sum(axis=0) - 0.5 * len(off) * np.log(2 * pi) - np.log(np.diag(self.root)).sum()
        each = self.share[box] / (4 * self.half_m**2) * np.exp(log)
        return np.log(np.bincount(point, weights=each, minlength=len(points)) + np.finfo(float).tiny)


def log_t_density(off: Array, degrees: float) -> Array:
    """(n,) of a t distribution of unit size at offsets (d, n)."""
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
