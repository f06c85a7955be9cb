"""Compiled loops over the elevations of columns: evidence of steps of light, and the chain around the compass."""

from __future__ import annotations

from math import exp, log, pi, sqrt

import numpy as np

from startrack.core.kernels import REORDERED_SUMS, njit

REACH_SIGMAS = 10.0  # beyond, exp(-z^2 / 2) is lost in rounding beside the likelihood of no step


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
        for i in range(low):
            total[c, i] += temper * log(nothing)
        for i in range(low, high):
            total[c, i] += temper * log(mixture[i])
        for i in range(high, n):
            total[c, i] += temper * log(nothing)


@njit(cache=True, fastmath=REORDERED_SUMS)
def pass_messages(likelihood, forward, ratio, weight, jump, landing, part, switch):  # type: ignore[no-untyped-def]
    """Messages (kinds, columns, n) that reach each column: what those before it say, or, not `forward`, those after it.

    The product of both with the `likelihood` (kinds, columns, n) is the posterior of kind and elevation, to a factor in
    each column. Between columns a kind and an elevation change by one matrix: the elevation by three Laplace
    distributions that fall by `ratio` (3,) per sample, with the sums `weight` (3,), within the n samples. With the
    probability `switch` the kind is drawn anew from the shares `part` (kinds,), and so are, with the probability
    `jump`, kind and elevation, this by the probabilities `landing` (n,). Backward messages go through the transposed
    matrix. The exponentials are summed by recursion, from below and from above. Those six chains take their steps
    beside each other.
    """
    kinds, columns, n = likelihood.shape
    found = np.empty((kinds, columns, n), np.float32)
    message, after, from_below, both = np.empty((kinds, n)), np.empty(n), np.empty(n), np.empty(n)
    r0, r1, r2 = ratio[0], ratio[1], ratio[2]
    scale = weight * (1.0 - ratio) / (1.0 + ratio)
    w0, w1, w2 = scale[0], scale[1], scale[2]
    inside = np.zeros(n)  # what the sums of exponentials about each sample hold within the n samples
    for j in range(len(ratio)):
        for i in range(n):
            inside[i] += weight[j] * (1.0 - (ratio[j] ** (i + 1) + ratio[j] ** (n - i)) / (1.0 + ratio[j]))
    # Factors of what is taken from each kind and sample, and of what is given to it.
    if forward:
        taken, given, left, landed, before, behind = np.ones(kinds), part, np.ones(n), landing, 1.0 / inside, np.ones(n)
    else:
        taken, given, left, landed, before, behind = part, np.ones(kinds), landing, np.ones(n), np.ones(n), 1.0 / inside
    for k in range(kinds):
        message[k] = given[k] * landed
    for number in range(2 * columns):  # the second round starts where the first one ended: the compass is a circle
        c = number % columns if forward else columns - 1 - number % columns
        both[:] = 0.0
        total = jumped = 0.0
        for k in range(kinds):
            own = message[k]
            found[k, c] = own
            own_total = own_left = 0.0
            for i in range(n):
                weighed = own[i] * likelihood[k, c, i]
                own_total += weighed
                own_left += weighed * left[i]
                after[i] = weighed * before[i]
            total += own_total
            jumped += taken[k] * own_left
            a0 = a1 = a2 = b0 = b1 = b2 = 0.0
            for i in range(n):
                below, above = after[i], after[n - 1 - i]
                a0, a1, a2 = a0 * r0 + below, a1 * r1 + below, a2 * r2 + below
                own[n - 1 - i] = w0 * b0 + w1 * b1 + w2 * b2
                from_below[i] = w0 * a0 + w1 * a1 + w2 * a2
                b0, b1, b2 = r0 * (b0 + above), r1 * (b1 + above), r2 * (b2 + above)
            for i in range(n):
                own[i] = (own[i] + from_below[i]) * behind[i]
                both[i] += taken[k] * own[i]
        kept, drawn = (1.0 - jump) * (1.0 - switch) / total, (1.0 - jump) * switch / total
        jumped *= jump / total
        for k in range(kinds):
            own = message[k]
            for i in range(n):
                own[i] = kept * own[i] + given[k] * (drawn * both[i] + jumped * landed[i])
    return found
