"""Log-likelihoods from interpolated horizons, compiled with numba: as `vicinity.py` does with numpy."""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
from math import erfc, exp, expm1, floor, log, log1p, sqrt

import numpy as np
from numba import njit

from startrack.terrain.horizon_kernel import surfaces

CERTAIN_SIGMAS = 6.0


@njit(cache=True, nogil=True)
def _score(
    ground, nodes, per_height, middle, east, north, half, llr, sigma, sector, visible, ceiling, epsilon, place, rise,
    sums,
):  # fmt: skip
    """Log-likelihood of one place (1, 2); rise (n,): tan of the rays' elevations."""
    across = nodes.shape[1]
    scale = (across - 1) / (2 * half)
    x, y = (place[0, 0] - east + half) * scale, (place[0, 1] - north + half) * scale
    up = np.empty(1)
    surfaces(ground, place, up)
    higher = up[0] - middle
    i, j = min(max(floor(x), 0), across - 2), min(max(floor(y), 0), across - 2)
    u, v = x - i, y - j
    a, b, c, d = (1 - u) * (1 - v), (1 - u) * v, u * (1 - v), u * v
    sums[:] = visible
    for k in range(len(llr)):
        tan = a * nodes[k, i, j] + b * nodes[k, i, j + 1] + c * nodes[k, i + 1, j] + d * nodes[k, i + 1, j + 1]
        tan -= higher * per_height[k]
        above = (rise[k] - tan) / (1.0 + rise[k] * tan)  # tan of the difference
        wide = CERTAIN_SIGMAS * sigma[k]
        if above > wide:
            sums[sector[k]] += llr[k]
        elif above > -wide and wide > 0.0:
            z = above / sigma[k]
            unlikely = 0.5 * erfc(-z / sqrt(2.0)) if llr[k] > 0.0 else 0.5 * erfc(z / sqrt(2.0))
            sums[sector[k]] += min(llr[k], 0.0) + log1p(unlikely * expm1(abs(llr[k])))
    total = 0.0
    for s in range(len(sums)):
        below = sums[s] - ceiling[s]
        if epsilon > 0.0:
            below = log((1.0 - epsilon) * exp(min(below, 0.0)) + epsilon)
        total += below
    return total


@njit(cache=True, nogil=True)
def scores(
    ground, nodes, per_height, middle, east, north, half, llr, sigma, sector, visible, ceiling, epsilon, places, rise,
    found,
):  # fmt: skip
    """Fill found (n,) with the log-likelihoods of places (n, 2)."""
    sums = np.empty(len(ceiling))
    for p in range(len(found)):
        found[p] = _score(
            ground, nodes, per_height, middle, east, north, half, llr, sigma, sector, visible, ceiling, epsilon,
            places[p : p + 1], rise, sums,
        )  # fmt: skip


@njit(cache=True, nogil=True)
def climb(
    ground, nodes, per_height, middle, east, north, half, llr, sigma, sector, visible, ceiling, epsilon, start,
    first_step, last_step, rise,
):  # fmt: skip
    """Best place near the start and its log-likelihood: steps to the best of 8 neighbours, ever shorter."""
    sums = np.empty(len(ceiling))
    at = np.empty((1, 2))
    x, y, step, known = start[0], start[1], first_step, False
    best = 0.0
    while step >= last_step:
        to_x, to_y, high = x, y, best
        better = False
        for turn in range(9):
            if turn != 4 or not known:
                at[0, 0], at[0, 1] = x + step * (turn // 3 - 1), y + step * (turn % 3 - 1)
                score = _score(
                    ground, nodes, per_height, middle, east, north, half, llr, sigma, sector, visible, ceiling,
                    epsilon, at, rise, sums,
                )  # fmt: skip
                if score > high or (not known and not better):
                    to_x, to_y, high, better = at[0, 0], at[0, 1], score, True
        x, y, best = to_x, to_y, high
        if not better:
            step *= 0.5
        known = True
    return x, y, best
