"""From horizon elevations to the log-likelihood of a position: soft edges, and a floor for each direction."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import erfc, expm1, log1p, sqrt

import numpy as np

from startrack.core.kernels import njit, normal_cdf
from startrack.core.types import Array, Evidence, Ints

SECTOR_STEP = 10.0  # between the keys of neighbouring sectors: more than any two elevations differ [rad]
EDGE_SIGMAS = 8.0  # beyond this the edge of a single row is not computed, and splines of rows are constant
CERTAIN_SIGMAS = 6.0  # to the ends of a normal distribution: a ray beyond is visible or hidden, to 1e-9
CEILING_STEP = 0.01  # of the edge's width: last step to the best level skyline


@dataclass(frozen=True)
class Sectors:
    """The evidence sorted into narrow sectors of azimuth, each of which may be wholly wrong (a boulder, a map error).

    With the rows' contributions g_i, a sector contributes log((1 - eps) exp(min(sum g_i - M, 0)) + eps): at worst
    log eps, however many of its stars contradict a position. M is the best that any level skyline reaches there, the
    largest sum of l_i above one elevation. (The sum of all positive l_i would not do: thousands of faint stars make it
    so high that every sector counts as wrong.) With eps = 0 the contributions are summed without floor and ceiling.
    """

    evidence: Evidence
    count: int
    epsilon: float

    @classmethod
    def from_evidence(cls, evidence: Evidence, width_rad: float, epsilon: float) -> Sectors:
        """Sectors of the `evidence`, about `width_rad` wide; `epsilon` is the probability that one is wholly wrong."""
        return cls(evidence, max(1, round(2 * np.pi / width_rad)), epsilon)

    @cached_property
    def sector(self) -> Ints:
        """(n,) of each row."""
        return (self.evidence.azimuth_rad / (2 * np.pi) * self.count).astype(np.int64) % self.count

    @cached_property
    def occupied(self) -> int:
        """Number of sectors that hold rows; at least 1."""
        return max(int(np.count_nonzero(np.bincount(self.sector))), 1)

    @cached_property
    def order(self) -> Ints:
        """Order (n,) of the rows by sector, and from low to high within one."""
        return np.argsort(SECTOR_STEP * self.sector + self.evidence.elevation_rad)

    @cached_property
    def ceiling(self) -> Array:
        """(sectors,) M: largest sum of contributions above one elevation; at least 0 (nothing visible)."""
        ends = np.searchsorted(self.sector[self.order], np.arange(self.count + 1))
        if self.evidence.extended_nats.any():
            rows, found = self.evidence.take(self.order), np.zeros(self.count)
            soft_ceilings(rows.elevation_rad, rows.llr, rows.extended_nats, rows.edge_sigma_rad, ends, found)
            return found
        below = np.concatenate([[0.0], np.cumsum(self.evidence.llr[self.order])])
        # Above the lowest ray, above the next, ..., above none: all these sums end at the sector's last ray.
        least = np.minimum.reduceat(below, ends[:-1])
        return np.asarray(below[ends[1:]] - np.minimum(least, below[ends[1:]]))

    def score(self, sums: Array) -> Array:
        """Log-likelihood (n,) of positions from the sums of contributions (n, sectors)."""
        return np.asarray(np.sum(self.by_sector(sums), axis=-1))

    def by_sector(self, sums: Array) -> Array:
        """Contribution of each sector (n, sectors) to the log-likelihood, from the `sums` as `score` takes them."""
        below = sums - self.ceiling
        if self.epsilon == 0.0:
            return np.asarray(below)
        # Within a narrow sector a real skyline hardly beats the best level one; bounds must not claim that it does.
        return np.asarray(np.log((1.0 - self.epsilon) * np.exp(np.minimum(below, 0.0)) + self.epsilon))


def row_limits(evidence: Evidence) -> tuple[Array, Array]:
    """Least and greatest contribution (n,), (n,) of each row over all visible fractions from 0 to 1."""
    llr, extended = evidence.llr, evidence.extended_nats
    least, most = np.minimum(llr, 0.0), np.maximum(llr, 0.0)
    inner = np.abs(llr) < 0.5 * extended  # the parabola has its top inside
    if inner.any():
        top = np.square(llr[inner] + 0.5 * extended[inner]) / (2 * extended[inner])
        most[inner] = np.maximum(most[inner], top)
    return least, most


@njit(cache=True)
def row_contribution(llr, extended, margin, sigma):  # type: ignore[no-untyped-def]
    """Contribution of a row `margin` [rad] above the horizon, whose edge has the width sigma [rad]; 0: hard.

    A point source contributes log(V e^l + 1 - V), extended light l V + c V (1 - V) / 2, V = Phi(margin / sigma). The
    mixture is computed from the less likely side, which keeps all digits.
    """
    value = llr if margin > 0.0 else 0.0
    if abs(margin) <= EDGE_SIGMAS * sigma and sigma > 0.0:
        if extended > 0.0:
            visible = normal_cdf(margin / sigma)
            value = llr * visible + 0.5 * extended * visible * (1.0 - visible)
        else:
            fraction = 0.5 * erfc((-margin if llr > 0.0 else margin) / (sigma * sqrt(2.0)))
            value = min(llr, 0.0) + log1p(fraction * expm1(abs(llr)))
    return value


@njit(cache=True)
def add_contributions(point, sector, llr, extended, margin, sigma, sums):  # type: ignore[no-untyped-def]
    """Add to sums (n, sectors) the contributions of pairs (m,) of a point and a row."""
    for k in range(len(llr)):
        sums[point[k], sector[k]] += row_contribution(llr[k], extended[k], margin[k], sigma[k])


@njit(cache=True)
def soft_ceilings(elevation, llr, extended, sigma, ends, found):  # type: ignore[no-untyped-def]
    """Fill found (sectors,) with the largest sum of contributions of a sector's rows above one level skyline.

    The rows are in the order of their sectors and ascend in each; `ends` (sectors + 1,) are their bounds. The skyline
    is tried below all rows and at every row, and then shifted in ever smaller steps from the best one.
    """
    for s in range(len(found)):
        first, last = ends[s], ends[s + 1]
        at, step, best = 0.0, 0.0, 0.0
        for k in range(first, last):
            best += llr[k]
        best = max(best, 0.0)
        for k in range(first, last):
            value = _level_sum(elevation, llr, extended, sigma, first, last, elevation[k])
            if value > best:
                best, at, step = value, elevation[k], sigma[k]
        smallest = CEILING_STEP * step
        while step > smallest:
            higher = _level_sum(elevation, llr, extended, sigma, first, last, at + step)
            lower = _level_sum(elevation, llr, extended, sigma, first, last, at - step)
            if max(higher, lower) > best:
                at += step if higher > lower else -step
                best = max(higher, lower)
            else:
                step *= 0.5
        found[s] = best


@njit(cache=True, inner=True)
def _level_sum(elevation, llr, extended, sigma, first, last, horizon):  # type: ignore[no-untyped-def]
    """Sum of contributions of the rows from first to last where the skyline is level at that elevation."""
    total = 0.0
    for k in range(first, last):
        total += row_contribution(llr[k], extended[k], elevation[k] - horizon, sigma[k])
    return total
