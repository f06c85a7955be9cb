"""The limit for a perfect list: the middle of the cell of places from which exactly the listed stars are in sight.

By brute force on a grid, apart from the localizer's own search, so that each can check the other.
"""

from __future__ import annotations

import numpy as np

from startrack.reproduction.simulator import visible
from startrack.types import Array, Bools

ACROSS = 161  # odd: the place itself is a point of the first grid, so the cell is never missed
FIRST_HALF_M = 20.0
WIDER, MARGIN = 2.0, 1.05
FINER = 2  # times


def cell_centroid(points_m: Array, place_m: Array, radius_m: float) -> Array:
    """Centroid (2,) [m] of the cell around a place (2,): no estimate from a perfect list has a smaller mean square.

    Stars (n, 2) as points on the rim's plane. The window grows until the cell does not touch its border, then shrinks
    to the cell; a part of the cell beyond a gap as wide as the window is not seen.
    """
    seen = visible(points_m, place_m, radius_m)
    low, high = place_m - FIRST_HALF_M, place_m + FIRST_HALF_M
    while True:
        inside, x, y = _inside(points_m, seen, low, high, radius_m)
        rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
        if min(rows[0], columns[0]) > 0 and max(rows[-1], columns[-1]) < ACROSS - 1:
            break
        low, high = place_m - WIDER * (place_m - low), place_m + WIDER * (high - place_m)
    for _ in range(FINER):
        step = np.array([x[1] - x[0], y[1] - y[0]])
        ends = np.array([[x[columns[0]], y[rows[0]]], [x[columns[-1]], y[rows[-1]]]])
        middle, half = ends.mean(axis=0), MARGIN * (np.diff(ends, axis=0)[0] / 2 + step)
        closer, x_closer, y_closer = _inside(points_m, seen, middle - half, middle + half, radius_m)
        if not closer.any():  # a sliver between the new grid's points: what the coarser one saw of it stands
            break
        inside, x, y = closer, x_closer, y_closer
        rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    north, east = np.nonzero(inside)
    return np.array([x[east].mean(), y[north].mean()])


def _inside(points_m: Array, seen: Bools, low_m: Array, high_m: Array, radius_m: float) -> tuple[Bools, Array, Array]:
    """Which points of a grid (rows north, columns east) see the listed stars and no others; the grid's x and y."""
    x = np.linspace(low_m[0], high_m[0], ACROSS)
    y = np.linspace(low_m[1], high_m[1], ACROSS)
    middle, reach = (low_m + high_m) / 2, float(np.hypot(*(high_m - low_m))) / 2
    crossing = np.abs(np.hypot(*(points_m + middle).T) - radius_m) <= reach
    inside = np.square(x)[None, :] + np.square(y)[:, None] < radius_m**2
    for (east, north), is_seen in zip(points_m[crossing], seen[crossing], strict=True):
        inside &= (np.square(x + east)[None, :] + np.square(y + north)[:, None] < radius_m**2) == is_seen
    return inside, x, y
