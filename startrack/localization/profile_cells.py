"""Cells of heights in which the log-likelihood of a sector's skyline is quadratic, as the kernels read them."""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
from math import copysign, exp, sqrt
from typing import NamedTuple

import numpy as np

from startrack.core.kernels import njit
from startrack.core.types import Array, Ints

LOW_RAD, HIGH_RAD = np.radians(-12.0), np.radians(20.0)  # window of heights: beyond it a skyline is no skyline
GUIDE = 256  # heights of the guide to the cells, to each side


class Profiles(NamedTuple):
    """F of each sector in cells of heights, quadratic in each, as the kernels read it.

    Cell k reaches from x[k] to x[k + 1]; the last one of a sector is a sentinel.
    """

    first: Ints  # (SECTORS + 1,) cell where each sector begins
    x: Array  # (m,) [rad]
    left: Array  # (m,) F at the begin of a cell
    right: Array  # (m,) and at its end
    bend: Array  # (m,) 4 (F in the middle - mean of both)
    integral: Array  # (m,) of exp(F - free) from the lowest height to x
    free: Array  # (SECTORS,) R
    guide: Ints  # (SECTORS, 2 GUIDE + 1) cells of heights closer to each other about 0, where a search begins
    scale: (
        Array  # (SECTORS,) exp(R + H - N): H is the sum of the stars above the window, N the greater one of R + H and 0
    )
    hidden: Array  # (SECTORS,) exp(-N): of a sector in which everything is hidden, the stars above the window too
    offset: Array  # (SECTORS,) N: all likelihoods of a sector are less it


@njit(cache=True, inner=True)
def integrate_cells(first, x, left, right, bend, width):
    """The cells with `free`, the guide and the integral; each cell by Simpson's rule."""
    sectors = len(first) - 1
    integral, free = np.zeros(len(x)), np.zeros(sectors)
    for s in range(sectors):
        top = -np.inf
        for k in range(first[s], first[s + 1] - 1):
            top = max(top, left[k], right[k], 0.5 * (left[k] + right[k]) + 0.25 * bend[k])
        total = 0.0
        for k in range(first[s], first[s + 1] - 1):
            integral[k] = total
            middle = exp(0.5 * (left[k] + right[k]) + 0.25 * bend[k] - top)
            total += (x[k + 1] - x[k]) / 6.0 * (exp(left[k] - top) + 4.0 * middle + exp(right[k] - top))
        last = first[s + 1] - 1
        integral[last] = total
        free[s] = top + np.log(total / width)
        for k in range(first[s], last + 1):
            integral[k] *= width / total
    return first, x, left, right, bend, integral, free, _guide_to(first, x)


@njit(cache=True, inner=True)
def _guide_to(first, x):
    """The `guide`: the cell (SECTORS, 2 GUIDE + 1) that holds each of its heights."""
    found = np.empty((len(first) - 1, 2 * GUIDE + 1), dtype=np.int32)
    for s in range(len(found)):
        k, last = first[s], first[s + 1] - 2
        for i in range(2 * GUIDE + 1):
            u = i / GUIDE - 1.0
            while k < last and x[k + 1] <= u * abs(u) * HIGH_RAD:
                k += 1
            found[s, i] = k
    return found


@njit(cache=True, inline="always")
def cell_at(x, guide, s, height):
    """The cell of a sector that holds a height, or the nearest one."""
    u = copysign(sqrt(abs(height) * (1.0 / HIGH_RAD)), height)
    i = min(max(int((u + 1.0) * GUIDE), 0), 2 * GUIDE - 1)
    k, last = guide[s, i], guide[s, i + 1]
    k += k < last and x[k + 1] <= height
    while k < last and x[k + 1] <= height:
        k += 1
    return k


@njit(cache=True, inline="always")
def value_in(profiles, k, u):
    """F at a part u of the way through cell k."""
    return profiles.left[k] + u * (profiles.right[k] - profiles.left[k]) + u * (1.0 - u) * profiles.bend[k]


@njit(cache=True)
def log_at(profiles, s, height):
    """F - R of a sector at a height."""
    if height >= HIGH_RAD:
        return -profiles.free[s]
    k = cell_at(profiles.x, profiles.guide, s, height)
    u = min(max((height - profiles.x[k]) / (profiles.x[k + 1] - profiles.x[k]), 0.0), 1.0)
    return value_in(profiles, k, u) - profiles.free[s]


@njit(cache=True)
def integral_to(profiles, s, height):
    """Integral of exp(F - R) of a sector up to a height; constant beyond the window's ends, where none is."""
    if height >= HIGH_RAD:
        last = profiles.first[s + 1] - 1
        return profiles.integral[last] + (height - HIGH_RAD) * exp(-profiles.free[s])
    k = cell_at(profiles.x, profiles.guide, s, height)
    u = (height - profiles.x[k]) / (profiles.x[k + 1] - profiles.x[k])
    return profiles.integral[k] + u * (profiles.integral[k + 1] - profiles.integral[k])
