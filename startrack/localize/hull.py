"""Kua's first estimate: the hull of the seen stars taken as the skyline, and a circle through it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.localize.seen import cylinder_of, on_rim_plane, point_fix, seen_stars
from startrack.terrain import Terrain
from startrack.types import Array, Evidence, Fix, NotLocated

PUBLISHED_SIGMA_M = float(np.hypot(637.0, 275.0) / np.sqrt(2))  # mean and s.d. of the error, thesis section 3.1.1


@dataclass(frozen=True)
class Hull:
    """Position from the convex hull of the seen stars on the rim's plane, fitted by the rim's circle of known radius.

    Solves [1, -2x, -2y] (h^2 + k^2, h, k) = r^2 - x^2 - y^2 in the least-squares sense; the position is (-h, -k).
    Biased: the outermost seen stars stand above the skyline. Source: Kua 2008, eq. 3.1-3.6.
    """

    def __call__(self, evidence: Evidence, terrain: Terrain) -> Fix:
        """Raises NotLocated with fewer than 3 seen stars."""
        cylinder = cylinder_of(terrain)
        points = on_rim_plane(evidence, cylinder)[seen_stars(evidence)]
        return point_fix(hull_position(points, cylinder.radius_m), PUBLISHED_SIGMA_M, cylinder)


def hull_position(points_m: Array, radius_m: float) -> Array:
    """Position (2,) [m] from the seen stars' points (n, 2) on the rim's plane."""
    from scipy.spatial import ConvexHull

    if len(points_m) < 3:
        raise NotLocated(f"{len(points_m)} seen stars make no hull")
    x, y = points_m[ConvexHull(points_m).vertices].T
    a = np.stack([np.ones_like(x), -2 * x, -2 * y], axis=1)
    q, *_ = np.linalg.lstsq(a, radius_m**2 - x * x - y * y, rcond=None)
    return -q[1:]
