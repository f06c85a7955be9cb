"""Kua's refinement: step by the difference of the centres of mass of the expected and the seen stars."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.localization.convex_hull import hull_position
from startrack.localization.rim_plane import point_fix, stars_on_rim_plane
from startrack.terrain import Terrain
from startrack.types import Array, Bools, Evidence, Fix

PUBLISHED_SIGMA_M = float(np.hypot(34.2, 31.1) / np.sqrt(2))  # mean and s.d. of the error, thesis table 3.1


@dataclass(frozen=True)
class PseudoGradient:
    """Repeats p <- p + gain (mean of the stars expected at p - mean of the stars seen) until both sets are the same.

    Stars are points on the plane of the rim; those expected at p are the ones with |p + point| < R. Source: Kua 2008,
    Algorithm 1. Weak when few stars differ: it may wander until the steps run out.
    """

    gain: float = 1.0
    most_steps: int = 200

    def __call__(self, evidence: Evidence, terrain: Terrain) -> Fix:
        """The position from the `evidence` in a `terrain` that is a cylinder.

        Raises NotLocated with fewer than 3 seen stars, BadInput bad_terrain on another terrain.
        """
        plane = stars_on_rim_plane(evidence, terrain)
        start = hull_position(plane.points_m[plane.seen], plane.wall_m, plane.radius_m)
        position, _ = descend(plane.points_m, plane.seen, start, plane.radius_m, self.gain, self.most_steps)
        return point_fix(position, PUBLISHED_SIGMA_M, terrain)


def descend(
    points_m: Array, seen: Bools, start_m: Array, radius_m: float, gain: float, most_steps: int
) -> tuple[Array, bool]:
    """Last position (2,) and whether the expected stars became the seen ones."""
    x, y = points_m[:, 0].copy(), points_m[:, 1].copy()
    seen_x, seen_y = float(x[seen].mean()), float(y[seen].mean())
    east, north = float(start_m[0]), float(start_m[1])
    for _ in range(most_steps):
        expected = np.square(x + east) + np.square(y + north) < radius_m**2
        if np.array_equal(expected, seen):
            return np.array([east, north]), True
        count = np.count_nonzero(expected)
        if not count:
            break
        east += gain * (float(np.sum(x * expected)) / count - seen_x)
        north += gain * (float(np.sum(y * expected)) / count - seen_y)
    return np.array([east, north]), False
