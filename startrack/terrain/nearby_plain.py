"""Interpolation between traced horizons with numpy alone: as `nearby_compiled.py`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from startrack.types import Array, Ints

if TYPE_CHECKING:
    from startrack.terrain.horizon_interpolator import Nearby

THREE = np.array([[i, j] for i in (-1, 0, 1) for j in (-1, 0, 1)], dtype=np.float64)
CORNERS = [0, 2, 6, 8]


def between(near: Nearby, points: Array, column: Ints, found: Array) -> None:
    """Fill found (n,) with the horizon [rad] at points (n, 2) and columns (n,)."""
    found[:] = np.arctan(_tan(near, points, column, near.whole.ground_m(points)))


def between_bounds(near: Nearby, centres: Array, half: float, column: Ints, low: Array, high: Array) -> None:
    """Fill low and high (n,) [rad] with bounds over boxes no wider than a step of the nodes or a cell of the map."""
    boxes, of = np.unique(centres, axis=0, return_inverse=True)
    up = near.whole.ground_m(boxes[:, None] + half * THREE).reshape(-1, 3, 3)
    bend = sum(np.abs(np.diff(up, 2, axis=axis)).max(axis=(1, 2)) for axis in (1, 2))[of.ravel()]
    up = up.reshape(-1, 9)[of.ravel()]
    values = np.array([_tan(near, centres + half * THREE[k], column, up[:, k]) for k in CORNERS])
    slack = 2 * near.rough[column] + bend * near.per_height[column]
    low[:], high[:] = np.arctan(values.min(axis=0) - slack), np.arctan(values.max(axis=0) + slack)


def _tan(near: Nearby, points: Array, column: Ints, up: Array) -> Array:
    x, y = ((points[:, k] - near.centre_m[k] + near.half_m) / near.step_m for k in (0, 1))
    i, j = (np.clip(np.floor(a), 0, near.across - 2).astype(np.int64) for a in (x, y))
    u, v = x - i, y - j
    west = near.nodes[column, i, j] * (1 - v) + near.nodes[column, i, j + 1] * v
    east = near.nodes[column, i + 1, j] * (1 - v) + near.nodes[column, i + 1, j + 1] * v
    return np.asarray(west * (1 - u) + east * u - (up - near.middle_up_m) * near.per_height[column])
