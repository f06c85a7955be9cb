"""The limit for a perfect list: the centroid of the cell of positions from which exactly the listed stars are visible.

By brute force on a grid, independently of the localizer's search, so that each checks the other.
"""

from __future__ import annotations

import numpy as np

from startrack.applications.reproduction.simulator import visible_stars
from startrack.core.types import Array, Bools

GRID_POINTS = 161  # a side; odd, so that the position itself is a point of the first grid and the cell is not missed
FIRST_HALF_M = 20.0
GROWTH, MARGIN = 2.0, 1.05
REFINEMENTS = 2  # of the grid


def cell_centroid(points_m: Array, position_m: Array, radius_m: float) -> Array:
    """Centroid (2,) [m] of the cell around a position (2,), the least-squares estimate from a perfect list.

    Stars (n, 2) as points on the rim's plane. The window grows until the cell does not touch its border, then shrinks
    to the cell; a part of the cell beyond a gap as wide as the window is not included.
    """
    seen = visible_stars(points_m, position_m, radius_m)
    low, high = position_m - FIRST_HALF_M, position_m + FIRST_HALF_M
    while True:
        inside, x, y = _cell_mask(points_m, seen, low, high, radius_m)
        rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
        if min(rows[0], columns[0]) > 0 and max(rows[-1], columns[-1]) < GRID_POINTS - 1:
            break
        low, high = position_m - GROWTH * (position_m - low), position_m + GROWTH * (high - position_m)
    for _ in range(REFINEMENTS):
        step = np.array([x[1] - x[0], y[1] - y[0]])
        ends = np.array([[x[columns[0]], y[rows[0]]], [x[columns[-1]], y[rows[-1]]]])
        middle, half = ends.mean(axis=0), MARGIN * (np.diff(ends, axis=0)[0] / 2 + step)
        closer, x_closer, y_closer = _cell_mask(points_m, seen, middle - half, middle + half, radius_m)
        if not closer.any():  # a sliver between the new grid's points: the coarser grid's result is kept
            break
        inside, x, y = closer, x_closer, y_closer
        rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    north, east = np.nonzero(inside)
    return np.array([x[east].mean(), y[north].mean()])


def _cell_mask(
    points_m: Array, seen: Bools, low_m: Array, high_m: Array, radius_m: float
) -> tuple[Bools, Array, Array]:
    """Grid points (rows north, columns east) from which exactly the listed stars are visible; x and y of the grid."""
    x = np.linspace(low_m[0], high_m[0], GRID_POINTS)
    y = np.linspace(low_m[1], high_m[1], GRID_POINTS)
    middle, half_diagonal_m = (low_m + high_m) / 2, float(np.hypot(*(high_m - low_m))) / 2
    crossing = np.abs(np.hypot(*(points_m + middle).T) - radius_m) <= half_diagonal_m
    inside = np.square(x)[None, :] + np.square(y)[:, None] < radius_m**2
    for (east, north), is_seen in zip(points_m[crossing], seen[crossing], strict=True):
        inside &= (np.square(x + east)[None, :] + np.square(y + north)[:, None] < radius_m**2) == is_seen
    return inside, x, y
