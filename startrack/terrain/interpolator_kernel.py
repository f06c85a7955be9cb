"""Interpolation between traced horizons, compiled with numba."""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
from math import atan, floor

import numpy as np
from numba import njit

from startrack.terrain.horizon_kernel import surfaces


@njit(cache=True, nogil=True, inline="always")
def bilinear(nodes, k, x, y):
    """Azimuth k's value at (x, y) [steps from the first node]; beyond the nodes it goes on as at the edge."""
    across = nodes.shape[1]
    i, j = min(max(floor(x), 0), across - 2), min(max(floor(y), 0), across - 2)
    west = nodes[k, i, j] + (y - j) * (nodes[k, i, j + 1] - nodes[k, i, j])
    east = nodes[k, i + 1, j] + (y - j) * (nodes[k, i + 1, j + 1] - nodes[k, i + 1, j])
    return west + (x - i) * (east - west)


@njit(cache=True, nogil=True)
def between(ground, nodes, per_height, middle, east, north, half, points, column, found):
    """Fill found (n,) with the horizon [rad] at points (n, 2) and columns (n,)."""
    scale = (nodes.shape[1] - 1) / (2 * half)
    up = np.empty(1)
    for k in range(len(found)):
        if k == 0 or points[k, 0] != points[k - 1, 0] or points[k, 1] != points[k - 1, 1]:
            surfaces(ground, points[k : k + 1], up)
        x, y = (points[k, 0] - east + half) * scale, (points[k, 1] - north + half) * scale
        c = column[k]
        found[k] = atan(bilinear(nodes, c, x, y) - (up[0] - middle) * per_height[c])


@njit(cache=True, nogil=True)
def between_bounds(ground, nodes, per_height, rough, middle, east, north, half, centres, box_half, column, low, high):
    """Fill low and high (n,) [rad] with bounds over boxes no wider than a step of the nodes or a cell of the map.

    A bilinear sheet has its extremes at its corners. The ground's kinks bend it by no more than the second differences
    of its heights over the box, the nodes' own bends count twice: within a sheet, and between two that the box touches.
    """
    scale = (nodes.shape[1] - 1) / (2 * half)
    points, up = np.empty((9, 2)), np.empty(9)
    bend = 0.0
    for k in range(len(low)):
        if k == 0 or centres[k, 0] != centres[k - 1, 0] or centres[k, 1] != centres[k - 1, 1]:
            for a in range(9):
                points[a, 0] = centres[k, 0] + box_half * (a // 3 - 1)
                points[a, 1] = centres[k, 1] + box_half * (a % 3 - 1)
            surfaces(ground, points, up)
            along, across = 0.0, 0.0
            for a in range(3):
                along = max(along, abs(up[a] - 2 * up[3 + a] + up[6 + a]))
                across = max(across, abs(up[3 * a] - 2 * up[3 * a + 1] + up[3 * a + 2]))
            bend = along + across
        c = column[k]
        least, most = np.inf, -np.inf
        for a in (0, 2, 6, 8):
            x, y = (points[a, 0] - east + half) * scale, (points[a, 1] - north + half) * scale
            value = bilinear(nodes, c, x, y) - (up[a] - middle) * per_height[c]
            least, most = min(least, value), max(most, value)
        slack = 2 * rough[c] + bend * per_height[c]
        low[k], high[k] = atan(least - slack), atan(most + slack)
