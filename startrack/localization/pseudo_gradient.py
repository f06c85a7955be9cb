"""Kua's refinement: step by the difference of the centres of mass of the expected and the seen stars."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.core.types import Array, Bools, Evidence, Fix, NotLocated
from startrack.localization.convex_hull import hull_position
from startrack.localization.rim_plane import point_fix, stars_on_rim_plane
from startrack.terrain import Terrain

GAIN, MOST_STEPS = 1.0, 200


@dataclass(frozen=True)
class PseudoGradient:
    """Steps p <- p + gain (mean of the stars expected at p - mean of the stars seen) until both sets are the same.

    Stars are points on the plane of the rim; those expected at p are the ones with |p + point| < R. Source: Kua 2008,
    Algorithm 1. Weak when few stars differ: it may wander until the steps run out. Of a list with mistakes no position
    explains every star, so an end that leaves at most `most_unexplained` of the list unexplained is accepted. No
    covariance and no circle are stated; the thesis's mean error is 34 m on perfect lists.
    """

    gain: float = GAIN
    most_steps: int = MOST_STEPS
    most_unexplained: float = 0.02  # part of the list; rendered 4 Mpx frames end with 0.001 to 0.004

    def __call__(self, evidence: Evidence, terrain: Terrain) -> Fix:
        """The position from the `evidence` in a `terrain` that is a cylinder.

        Raises NotLocated as `Hull` does, and where the steps end at a position that does not explain the list;
        BadInput bad_terrain on another terrain.
        """
        plane = stars_on_rim_plane(evidence, terrain)
        start = hull_position(plane.points_m[plane.seen], plane.wall_m, plane.radius_m)
        position, settled = descend(plane.points_m, plane.seen, start, plane.radius_m, self.gain, self.most_steps)
        fix = point_fix(position, terrain)
        x, y = plane.points_m.T
        expected = _expected_stars(x, y, position[0], position[1], plane.radius_m)
        wrong = np.count_nonzero(expected != plane.seen)
        if not settled and wrong > self.most_unexplained * len(plane.seen):
            raise NotLocated(
                f"the descent did not settle: its last position leaves {wrong} of {len(plane.seen)} stars unexplained"
            )
        return fix


def descend(
    points_m: Array, seen: Bools, start_m: Array, radius_m: float, gain: float = GAIN, most_steps: int = MOST_STEPS
) -> tuple[Array, bool]:
    """Last position (2,) [m], and whether the expected stars became the `seen` ones (n,).

    At most `most_steps` steps are made from `start_m` (2,). The stars are `points_m` (n, 2) on the
    plane of a rim of `radius_m`; `gain` multiplies each step.
    """
    x, y = points_m[:, 0].copy(), points_m[:, 1].copy()
    seen_x, seen_y = float(x[seen].mean()), float(y[seen].mean())
    east, north = float(start_m[0]), float(start_m[1])
    for _ in range(most_steps):
        expected = _expected_stars(x, y, east, north, radius_m)
        if np.array_equal(expected, seen):
            return np.array([east, north]), True
        count = np.count_nonzero(expected)
        if not count:
            break
        east += gain * (float(np.sum(x * expected)) / count - seen_x)
        north += gain * (float(np.sum(y * expected)) / count - seen_y)
    return np.array([east, north]), False


def _expected_stars(x_m: Array, y_m: Array, east_m: float, north_m: float, radius_m: float) -> Bools:
    """Whether stars at x and y (n,) [m] on the rim's plane are visible from a position."""
    return np.asarray(np.square(x_m + east_m) + np.square(y_m + north_m) < radius_m**2)
