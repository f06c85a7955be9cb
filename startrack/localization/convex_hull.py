"""Kua's first estimate: the hull of the seen stars taken as the skyline, and a circle through it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.core.types import Array, Evidence, Fix, NotLocated
from startrack.localization.rim_plane import point_fix, stars_on_rim_plane
from startrack.terrain import Terrain


@dataclass(frozen=True)
class Hull:
    """Position from the convex hull of the seen stars, fitted by the rim's circle of known radius.

    The hull is that of the picture of the sky; its stars are taken as points (x, y) of the rim, and
    [1, -2x, -2y] (h^2 + k^2, h, k) = r^2 - x^2 - y^2 is solved in the least-squares sense; the position is (-h, -k).
    Biased: the outermost seen stars stand above the skyline. No covariance and no circle are stated; the thesis's mean
    error is 637 m. Source: Kua 2008, eq. 3.1-3.6 and section 3.1.1.
    """

    def __call__(self, evidence: Evidence, terrain: Terrain) -> Fix:
        """The position from the `evidence` in a `terrain` that is a cylinder.

        Raises NotLocated with fewer than 3 seen stars, with stars on one line, and where the position is outside the
        search area; BadInput bad_terrain on another terrain.
        """
        plane = stars_on_rim_plane(evidence, terrain)
        position = hull_position(plane.points_m[plane.seen], plane.wall_m, plane.radius_m)
        return point_fix(position, terrain)


def hull_position(points_m: Array, wall_m: float, radius_m: float) -> Array:
    """Position (2,) [m] from the seen stars' `points_m` (n, 2) on the rim's plane, `wall_m` above the camera.

    `radius_m` is that of the rim. Raises NotLocated where the stars span no area.
    """
    from scipy.spatial import ConvexHull, QhullError

    if len(points_m) < 3:
        raise NotLocated(f"{len(points_m)} seen stars make no hull")
    try:
        hull = ConvexHull(_project_equidistant(points_m, wall_m))
    except QhullError as cause:
        raise NotLocated(f"{len(points_m)} seen stars make no hull: they stand on one line") from cause
    x, y = points_m[hull.vertices].T
    a = np.stack([np.ones_like(x), -2 * x, -2 * y], axis=1)
    q, *_ = np.linalg.lstsq(a, radius_m**2 - x * x - y * y, rcond=None)
    return -q[1:]


def _project_equidistant(points_m: Array, wall_m: float) -> Array:
    """Images (n, 2) of the stars in an ideal fisheye: zenith distance [rad] times the horizontal direction.

    The plane decides which stars make the hull, and the thesis does not name it. Mean errors in its crater: rim plane
    380 m, stereographic 570 m, equidistant 630 m, orthographic 860 m; the thesis's is 637 m.
    """
    rho = np.hypot(points_m[:, 0], points_m[:, 1])
    per_metre = np.divide(np.arctan2(rho, wall_m), rho, out=np.full_like(rho, 1 / wall_m), where=rho > 0)
    return points_m * per_metre[:, None]
