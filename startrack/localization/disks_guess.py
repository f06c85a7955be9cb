"""A first good place for the compiled search of `disks.py`: a grid by the loudest rays, then a climb by all."""

from __future__ import annotations

import numpy as np
from numba import njit

from startrack.localization.cylinder_kernel import log_mixture
from startrack.types import Array, Ints

LEVELS = 255


@njit(cache=True)
def most_telling(disks_m: Array, llr: Array, radius_m: float, count: int) -> Ints:
    """Indices (<= count,) of rays among those that say most about the place: sure of themselves, low over the rim.

    Sorted into bins, not in order: the guess they are for needs no better.
    """
    telling = np.empty(len(llr))
    top = 1e-30
    for k in range(len(llr)):
        d2 = disks_m[k, 0] * disks_m[k, 0] + disks_m[k, 1] * disks_m[k, 1]
        telling[k] = abs(llr[k]) * min(d2, radius_m * radius_m)
        top = max(top, telling[k])
    in_bin = np.zeros(LEVELS + 1, dtype=np.int64)
    for k in range(len(llr)):
        in_bin[int(telling[k] / top * LEVELS)] += 1
    cut, found = LEVELS, in_bin[LEVELS]
    while found < count and cut > 0:
        cut -= 1
        found += in_bin[cut]
    chosen = np.empty(found, dtype=np.int64)
    n = 0
    for k in range(len(llr)):
        chosen[n] = k
        n += int(telling[k] / top * LEVELS) >= cut
        if n == found:
            break
    return chosen[:count]


@njit(cache=True)
def scout(
    disks_m: Array, llr: Array, radius_m: float, reach_m: float, across: int, kept: int, finest_m: float
) -> Array:
    """A place (2,) [m] that fits well by the plain sum of the llr of the rays given: grids around the best few."""
    step = 2 * reach_m / across
    best_x, best_y = np.zeros(kept), np.zeros(kept)
    best_score = np.full(kept, -np.inf)
    centres, width = np.zeros((1, 2)), across
    while True:
        best_score[:] = -np.inf
        for c in range(len(centres)):
            for i in range(width):
                for j in range(width):
                    x = centres[c, 0] + step * (i - (width - 1) / 2)
                    y = centres[c, 1] + step * (j - (width - 1) / 2)
                    if x * x + y * y >= radius_m * radius_m:
                        continue
                    total = 0.0
                    for k in range(len(llr)):
                        u, v = x - disks_m[k, 0], y - disks_m[k, 1]
                        total += llr[k] * (u * u + v * v < radius_m * radius_m)
                    worst = np.argmin(best_score)
                    if total > best_score[worst]:
                        best_x[worst], best_y[worst], best_score[worst] = x, y, total
        if step < finest_m:
            top = np.argmax(best_score)
            return np.array([best_x[top], best_y[top]])
        step /= 2
        found = np.flatnonzero(best_score > -np.inf)
        centres, width = np.empty((len(found), 2)), 5
        centres[:, 0], centres[:, 1] = best_x[found], best_y[found]


@njit(cache=True)
def score_at(
    x: float, y: float, disks_m: Array, llr: Array, sector: Ints, ceiling: Array, log_floor: float, radius_m: float
) -> float:
    """Log-likelihood of the place (x, y)."""
    sums = -ceiling
    for k in range(len(llr)):
        u, v = x - disks_m[k, 0], y - disks_m[k, 1]
        sums[sector[k]] += llr[k] * (u * u + v * v < radius_m * radius_m)
    log_keep = np.log1p(-np.exp(log_floor))
    total = 0.0
    for s in range(len(sums)):
        total += log_mixture(sums[s], log_keep, log_floor)
    return total


@njit(cache=True)
def climb(
    start_m: Array, step_m: float, disks_m: Array, llr: Array, sector: Ints, ceiling: Array, log_floor: float,
    radius_m: float, finest_m: float, range_m: float,
) -> tuple[Array, float]:  # fmt: skip
    """A better place (2,) within the range of the start and its log-likelihood: steps to the best of 8 neighbours.

    Only the rays whose disk's edge passes within the range can change on the way; the others are summed once.
    """
    settled = -ceiling
    near = np.empty(len(llr) + 1, dtype=np.int64)
    count = 0
    for k in range(len(llr)):
        u, v = start_m[0] - disks_m[k, 0], start_m[1] - disks_m[k, 1]
        off = np.sqrt(u * u + v * v) - radius_m
        near[count] = k
        count += abs(off) <= range_m
        settled[sector[k]] += llr[k] * (off < -range_m)
    near = near[:count]
    disks_m, llr, sector = disks_m[near], llr[near], sector[near]
    x, y = start_m[0], start_m[1]
    best = score_at(x, y, disks_m, llr, sector, -settled, log_floor, radius_m)
    while step_m > finest_m:
        go_x, go_y = x, y
        for i in range(-1, 2):
            for j in range(-1, 2):
                u, v = x + step_m * i, y + step_m * j
                inside = u * u + v * v < radius_m * radius_m
                if (i == 0 and j == 0) or not inside or np.hypot(u - start_m[0], v - start_m[1]) > range_m:
                    continue
                score = score_at(u, v, disks_m, llr, sector, -settled, log_floor, radius_m)
                if score > best:
                    best, go_x, go_y = score, u, v
        if go_x == x and go_y == y:
            step_m /= 2
        x, y = go_x, go_y
    return np.array([x, y]), best
