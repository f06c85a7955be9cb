"""Points and azimuths, broadcast, as the kernels take them: rays one by one, or all azimuths of a point in a row."""

from __future__ import annotations

from typing import Any

import numpy as np

from startrack.core.types import Array


def flatten_rays(points_m: Array, azimuths_rad: Array) -> tuple[tuple[int, ...], Array, Array]:
    """The shape of points (..., 2) broadcast with azimuths (...), and its n points (n, 2) and azimuths (n,)."""
    shape = np.broadcast_shapes(np.shape(points_m)[:-1], np.shape(azimuths_rad))
    return shape, flatten(points_m, (*shape, 2)).reshape(-1, 2), flatten(azimuths_rad, shape).ravel()


def rows_of_rays(points_m: Array, azimuths_rad: Array) -> tuple[tuple[int, ...], Array, Array]:
    """The same shape, and its points (n, 2) and azimuths: (1, m) those of all points, else (n, 1)."""
    if np.ndim(points_m) > 1 and np.shape(points_m)[-2] == 1 and np.ndim(azimuths_rad) == 1:
        shape = (*np.shape(points_m)[:-2], len(azimuths_rad))
        return shape, flatten(points_m, np.shape(points_m)).reshape(-1, 2), np.array(azimuths_rad, np.float64)[None]
    shape, points, azimuths = flatten_rays(points_m, azimuths_rad)
    return shape, points, azimuths[:, None]


def flatten(a: Any, shape: tuple[int, ...]) -> Array:
    """The values of `a`, broadcast to the shape, in one contiguous array of their own: kernels have one layout."""
    return np.array(np.broadcast_to(np.asarray(a, dtype=np.float64), shape), order="C")
