"""Boxes of positions: how they are quartered, and what a search leaves of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from startrack.core.types import Array
from startrack.terrain import Terrain

SMALL_BOX_M = 20.0  # half side up to which boxes are tested for allowed ground point by point
QUARTERS = np.array([[-0.5, -0.5], [0.5, -0.5], [-0.5, 0.5], [0.5, 0.5]])  # of half a side


class Explored(NamedTuple):
    """The posterior on equal boxes."""

    centres_m: Array  # (n, 2)
    half_m: float
    log_likelihood: Array  # (n,) at the centres
    log_dropped: float  # logarithm of a bound of the mass [m2] that was dropped
    search: str  # "proven" or "beam"
    dropped_probability: float | None = None  # of an earlier fix with these points; None: by `log_dropped`


def log_sum(values: Array) -> float:
    """Logarithm of the sum of exponentials; -inf of none."""
    return float(np.logaddexp.reduce(values, initial=-np.inf))


def split_boxes(centres_m: Array, half_m: float, terrain: Terrain) -> Array:
    """Centres (m, 2) of the quarters of boxes that touch the searched disk and may hold ground for a camera.

    Small ones are tested on a grid that is closer than slopes change: at most single metres of a box's ground are
    missed.
    """
    centres = (centres_m[:, None] + half_m * QUARTERS).reshape(-1, 2)
    east_m, north_m, reach_m = terrain.searched
    beyond = np.maximum(np.abs(centres - [east_m, north_m]) - 0.5 * half_m, 0.0)
    centres = centres[np.hypot(beyond[:, 0], beyond[:, 1]) <= reach_m]
    if half_m > 2 * SMALL_BOX_M:
        return centres
    points = centres[:, None] + square_grid(0.5 * half_m, 5)
    return centres[np.any(terrain.allowed(points), axis=1)]


def square_grid(half_m: float, across: int) -> Array:
    """Points (across^2, 2) of an even grid about the origin, up to `half_m` from it along each axis."""
    line = np.linspace(-half_m, half_m, across)
    return np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
