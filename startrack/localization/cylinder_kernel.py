"""The same branch and bound compiled, for the cylinder with hard edges: every ray's visible ground is a disk.

Ray i is visible from p exactly when p lies in the disk of the rim's radius about -rho_i u_i, so bounds over a box are
two comparisons of squared distances. numba compiles it once per machine; results are those of `search.py`.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from startrack.types import Array, Ints

NEGLIGIBLE_NATS = 14.0  # e^-14 beside 1 is left out: a millionth
DIGITS_NATS = 37.0  # what is smaller than this beside 1 has no digit in a float64
DOOM_EVERY = 32  # rays between two looks at whether a box is lost already


@njit(cache=True)
def log_mixture(below: float, log_keep: float, log_floor: float) -> float:
    """log(exp(min(below, 0) + log_keep) + exp(log_floor)); log_floor = -inf means no floor and no ceiling."""
    if log_floor == -np.inf:
        return below
    a = min(below, 0.0) + log_keep
    if a > log_floor + NEGLIGIBLE_NATS:
        return a
    if a < log_floor - NEGLIGIBLE_NATS:
        return log_floor
    if a > log_floor:
        return a + np.log1p(np.exp(log_floor - a))
    return log_floor + np.log1p(np.exp(a - log_floor))


@njit(cache=True)
def _log_add(a: float, b: float) -> float:
    top, low = max(a, b), min(a, b)
    return top if low < top - DIGITS_NATS or low == -np.inf else top + np.log1p(np.exp(low - top))


@njit(cache=True)
def _smaller_variance(centres: Array, score: Array, top: float) -> float:
    """Variance [m2] along the shorter axis of the boxes weighted by exp(score - top)."""
    total, mean_x, mean_y = 0.0, 0.0, 0.0
    for b in range(len(centres)):
        w = np.exp(score[b] - top)
        total += w
        mean_x += w * centres[b, 0]
        mean_y += w * centres[b, 1]
    mean_x /= total
    mean_y /= total
    xx, yy, xy = 0.0, 0.0, 0.0
    for b in range(len(centres)):
        w = np.exp(score[b] - top) / total
        u, v = centres[b, 0] - mean_x, centres[b, 1] - mean_y
        xx += w * u * u
        yy += w * v * v
        xy += w * u * v
    return 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)


@njit(cache=True)
def explore(
    disks_m: Array,
    llr: Array,
    sector: Ints,
    ceiling: Array,
    log_floor: float,
    radius_m: float,
    reach_m: float,
    best: float,
    prune_nats: float,
    negligible_nats: float,
    finest_m: float,
    boxes_per_sigma: float,
    most_boxes: int,
) -> tuple[Array, float, Array, float]:
    """Centres (n, 2), half side, log-likelihoods (n,) at the centres (-inf off the floor), log of the mass dropped.

    `disks_m` (m, 2) are the disks' centres, `ceiling` (sectors,) the best that any skyline reaches, `log_floor` the log
    of the probability that a sector is wrong, `best` a known lower bound of the maximum.
    """
    sectors = len(ceiling)
    log_keep = np.log1p(-np.exp(log_floor))
    r2 = radius_m * radius_m
    half = reach_m
    centres = np.zeros((1, 2))
    sums = -np.ones((1, 1)) * ceiling.reshape(1, sectors)
    base = np.zeros(1)
    for s in range(sectors):
        base[0] += log_mixture(sums[0, s], log_keep, log_floor)
    rays = np.arange(len(llr)).astype(np.uint32)
    first = np.zeros(2, dtype=np.int64)
    first[1] = len(llr)
    # Without a floor losses simply add up, and most boxes are seen to be hopeless after a few dozen rays.
    additive = log_floor == -np.inf
    upper_of = base + np.maximum(llr, 0.0).sum()
    dropped = -np.inf
    certain = -np.inf  # log of the mass that the boxes are sure to hold
    least, most, at_centre = np.zeros(sectors), np.zeros(sectors), np.zeros(sectors)
    touched = np.zeros(sectors, dtype=np.int64)
    stamp = np.zeros(sectors, dtype=np.int64)
    ticket = 0
    while True:
        half /= 2
        room = 4 * len(centres)
        new_centres, new_sums = np.empty((room, 2)), np.empty((room, sectors))
        new_base, new_upper, new_score, new_lower = np.empty(room), np.empty(room), np.empty(room), np.empty(room)
        new_first = np.zeros(room + 1, dtype=np.int64)
        new_rays = np.empty(max(4096, 2 * len(rays)), dtype=np.uint32)
        inner, outer = radius_m - half * np.sqrt(2.0), radius_m + half * np.sqrt(2.0)
        inner2 = inner * inner if inner > 0 else -1.0
        outer2 = outer * outer
        cell = np.log(4 * half * half)
        enough = certain - negligible_nats - cell
        n, used = 0, 0
        for b in range(len(centres)):
            for child in range(4):
                x = centres[b, 0] + (half if child % 2 else -half)
                y = centres[b, 1] + (half if child // 2 else -half)
                nearest_x, nearest_y = max(abs(x) - half, 0.0), max(abs(y) - half, 0.0)
                if nearest_x * nearest_x + nearest_y * nearest_y >= r2:
                    continue
                count = first[b + 1] - first[b]
                if used + count > len(new_rays):
                    grown = np.empty(2 * (used + count), dtype=np.uint32)
                    grown[:used] = new_rays[:used]
                    new_rays = grown
                new_sums[n] = sums[b]
                ticket += 1
                dirty, start = 0, used
                doomed, found = upper_of[b] - max(best - prune_nats, enough), 0.0
                for q in range(first[b], first[b + 1]):
                    if additive and q % DOOM_EVERY == 0 and found + doomed <= 0.0:
                        break
                    k = rays[q]
                    s = sector[k]
                    if stamp[s] != ticket:
                        stamp[s] = ticket
                        touched[dirty] = s
                        dirty += 1
                        least[s], most[s], at_centre[s] = 0.0, 0.0, 0.0
                    u, v = x - disks_m[k, 0], y - disks_m[k, 1]
                    d2 = u * u + v * v
                    # No processor foretells which case holds: multiplying by 0 or 1 takes half the time of branches.
                    inside = d2 < inner2
                    open_ = (d2 >= inner2) & (d2 <= outer2)
                    gain = llr[k] * open_
                    new_sums[n, s] += llr[k] * inside
                    most[s] += gain * (gain > 0)
                    least[s] += gain * (gain < 0)
                    at_centre[s] += gain * (d2 < r2)
                    found += min(llr[k], 0.0) * inside - max(llr[k], 0.0) * (d2 > outer2)
                    new_rays[used] = k
                    used += open_
                if additive and found + doomed <= 0.0:
                    dropped = _log_add(dropped, upper_of[b] + found + cell)
                    used = start
                    continue
                score, lower, upper, settled = base[b], base[b], base[b], base[b]
                for t in range(dirty):
                    s = touched[t]
                    before = log_mixture(sums[b, s], log_keep, log_floor)
                    now = new_sums[n, s]
                    settled += log_mixture(now, log_keep, log_floor) - before
                    lower += log_mixture(now + least[s], log_keep, log_floor) - before
                    upper += log_mixture(now + most[s], log_keep, log_floor) - before
                    score += log_mixture(now + at_centre[s], log_keep, log_floor) - before
                if x * x + y * y < r2:
                    best = max(best, score)
                else:
                    score, lower = -np.inf, -np.inf
                if upper <= max(best - prune_nats, enough):
                    dropped = _log_add(dropped, upper + cell)
                    used = start
                    continue
                new_centres[n, 0], new_centres[n, 1] = x, y
                new_base[n], new_upper[n], new_score[n], new_lower[n] = settled, upper, score, lower
                new_first[n + 1] = used
                n += 1
        # Boxes kept before a better place was found may have lost their case since.
        certain = -np.inf
        for b in range(n):
            certain = _log_add(certain, new_lower[b] + cell)
        enough = certain - negligible_nats - cell
        write, write_ray, begin = 0, 0, 0
        for b in range(n):
            end = new_first[b + 1]
            if new_upper[b] <= max(best - prune_nats, enough):
                dropped = _log_add(dropped, new_upper[b] + cell)
            else:
                for q in range(begin, end):
                    new_rays[write_ray + q - begin] = new_rays[q]
                write_ray += end - begin
                new_centres[write], new_sums[write] = new_centres[b], new_sums[b]
                new_base[write], new_upper[write], new_score[write] = new_base[b], new_upper[b], new_score[b]
                write += 1
                new_first[write] = write_ray  # write <= b + 1, whose own offset is already in `end`
            begin = end
        n = write
        centres, sums, base, score_now = new_centres[:n], new_sums[:n], new_base[:n], new_score[:n]
        upper_of = new_upper[:n]
        rays, first = new_rays[:write_ray], new_first[: n + 1]
        if n == 0 or half <= finest_m or 4 * n > most_boxes or write_ray == 0:
            return centres.copy(), half, score_now.copy(), dropped
        top = score_now.max()
        if top == -np.inf:
            continue
        smaller = _smaller_variance(centres, score_now, top)
        if smaller > 0 and 2 * half * boxes_per_sigma < np.sqrt(smaller):
            return centres.copy(), half, score_now.copy(), dropped
