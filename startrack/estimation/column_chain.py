"""Compiled loops over the elevations of columns: evidence of steps of light, and the chain around the compass."""

from __future__ import annotations

from math import exp, log, pi, sqrt

import numpy as np

from startrack.core.kernels import njit

REACH_SIGMAS = 39.0  # beyond, exp(-z^2 / 2) is zero


@njit(cache=True)
def add_steps(total, temper, lowest, step, column, place, sigma, weight, passed, nothing):  # type: ignore[no-untyped-def]
    """Add the log-likelihood of steps of light (k,), sorted by column, times `temper` to `total` (columns, n).

    The grid of elevations begins at `lowest` and has a constant `step` [rad]. A step lies at the `place` with a `sigma`
    [rad]; a skyline there has the likelihood `weight`, one above it the factor exp(`passed`), and `nothing` is that of
    a skyline that shows no step.
    """
    n, k = total.shape[1], 0
    mixture = np.empty(n)
    while k < len(column):
        c, low, high = column[k], n, 0
        mixture[:] = nothing
        while k < len(column) and column[k] == c:
            first = max(int((place[k] - REACH_SIGMAS * sigma[k] - lowest) / step), 0)
            last = min(int((place[k] + REACH_SIGMAS * sigma[k] - lowest) / step) + 2, n)
            low, high = min(low, first), max(high, last)
            for i in range(first, last):
                z = (lowest + step * i - place[k]) / sigma[k]
                mixture[i] += weight[k] * exp(-0.5 * z * z) / (sigma[k] * sqrt(2.0 * pi))
            for i in range(n):
                if lowest + step * i >= place[k] - 2.0 * sigma[k]:
                    break
                total[c, i] += temper * passed[k]
            k += 1
        for i in range(n):
            total[c, i] += temper * (log(mixture[i]) if low <= i < high else log(nothing))


@njit(cache=True)
def pass_messages(likelihood, forward, ratio, weight, jump):  # type: ignore[no-untyped-def]
    """Messages (columns, n) that reach each column from those before it, in the order `forward` or against it.

    Between columns a message is convolved with Laplace distributions that fall by `ratio` (m,) per sample and have the
    sums `weight` (m,); a part `jump` goes anywhere. The exponentials are summed by recursion, upwards and downwards.
    """
    columns, n = likelihood.shape
    found = np.empty((columns, n))
    message, after = np.full(n, 1.0 / n), np.empty(n)
    scale = weight * (1.0 - ratio) / (1.0 + ratio)
    for number in range(2 * columns):  # the second round starts where the first one ended: the compass is a circle
        c = number % columns if forward else columns - 1 - number % columns
        found[c] = message
        after[:] = message * likelihood[c]
        after /= after.sum()
        message[:] = 0.0
        for m in range(len(ratio)):
            up, down = 0.0, 0.0
            for i in range(n):
                up = up * ratio[m] + after[i]
                message[i] += scale[m] * up
                message[n - 1 - i] += scale[m] * down
                down = ratio[m] * (down + after[n - 1 - i])
        message[:] = (1.0 - jump) * message / message.sum() + jump / n
    return found
