"""Distances from a point to the circle of a crater's rim."""

from __future__ import annotations

from math import atan2, sqrt

import numpy as np

from startrack.core.kernels import njit
from startrack.core.types import Array


def distance_to_circle(points_m: Array, azimuths_rad: Array, radius_m: Array | float) -> Array:
    """Distance (...) from points (..., 2) along azimuths to the far side of the origin's circle; 0: none ahead."""
    points_m = np.asarray(points_m, dtype=np.float64)
    x, y = points_m[..., 0], points_m[..., 1]
    return chord(x * np.sin(azimuths_rad) + y * np.cos(azimuths_rad), np.hypot(x, y), radius_m)


def chord(along_m: Array, off_centre_m: Array, radius_m: Array | float) -> Array:
    """Distance to the circle ahead of a point `off_centre_m` from its middle, `along_m` of that in the direction."""
    inner = np.square(np.maximum(radius_m, 0.0)) - np.square(off_centre_m)
    root = np.sqrt(np.maximum(np.square(along_m) + inner, 0.0))
    # Outside the circle (inner < 0) the rim no longer surrounds the point: the wall is overhead, at distance 0.
    return np.where(inner > 0, np.maximum(root - along_m, 0.0), 0.0)


def distance_bounds(
    centres_m: Array, half_m: Array, azimuths_rad: Array, azimuth_half_rad: Array | float,
    least_radius_m: float, greatest_radius_m: float,
) -> tuple[Array, Array]:  # fmt: skip
    """Least and greatest distance (...) to a rim between two circles, over boxes and azimuths as in `Terrain`.

    A point within r of the centre c sees the circle of radius R no nearer than c sees the one of radius R - r, and no
    farther than c sees the one of radius R + r. Over azimuths the distance grows steadily from the side that the point
    is on to the opposite one.
    """
    reach = np.sqrt(2.0) * np.asarray(half_m)
    if not np.any(azimuth_half_rad):
        nearest = distance_to_circle(centres_m, azimuths_rad, least_radius_m - reach)
        return nearest, distance_to_circle(centres_m, azimuths_rad, greatest_radius_m + reach)
    x, y, sine, cosine = centres_m[..., 0], centres_m[..., 1], np.sin(azimuths_rad), np.cos(azimuths_rad)
    along, across = x * sine + y * cosine, np.abs(x * cosine - y * sine)
    half = np.minimum(azimuth_half_rad, np.pi)
    off_centre, turn, turned = np.hypot(x, y), np.cos(half), np.sin(half)
    side = off_centre * turn
    most_along = np.where(along >= side, off_centre, along * turn + across * turned)
    least_along = np.where(along <= -side, -off_centre, along * turn - across * turned)
    nearest = chord(most_along, off_centre, least_radius_m - reach)
    return nearest, chord(least_along, off_centre, greatest_radius_m + reach)


def horizons_of_circle(points_m: Array, azimuths_rad: Array, radius_m: float, wall_m: float) -> Array:
    """Elevations (n, m) [rad] of a circular rim `wall_m` above points (n, 2) [m], at azimuths (m,) [rad]."""
    sines, cosines = np.sin(azimuths_rad), np.cos(azimuths_rad)
    return np.asarray(_horizons(np.ascontiguousarray(points_m), sines, cosines, radius_m, wall_m))


@njit(cache=True, nogil=True)
def _horizons(points, sines, cosines, radius, wall):  # type: ignore[no-untyped-def]
    found = np.empty((len(points), len(sines)))
    for i in range(len(points)):
        x, y = points[i, 0], points[i, 1]
        inner = radius * radius - x * x - y * y
        for k in range(len(sines)):
            along = x * sines[k] + y * cosines[k]
            distance = max(sqrt(along * along + inner) - along, 0.0) if inner > 0.0 else 0.0
            found[i, k] = atan2(wall, distance)
    return found
