"""The localizers of Kua's thesis, which know round craters and lists of seen and missing stars on the plane of the rim.

The hull of the seen stars is taken as the skyline, and a circle through it is the first estimate. Steps by the
difference of the centres of mass of the expected and the seen stars refine it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.core.types import Array, BadInput, Bools, Evidence, Fix, Mode, NotLocated
from startrack.localization.conclusion import camera_at, require_inside
from startrack.terrain import Terrain, require_terrain

DECISIVE_NATS = 5.0  # wrong for 1 star in 150; on a rendered 4 Mpx frame 3 nats double the pseudo-gradient's error
FAR_M = 1e12
GAIN, MOST_STEPS = 1.0, 200


@dataclass(frozen=True)
class RimPlane:
    """Stars where their rays pierce the plane of a circular rim, seen from the camera."""

    points_m: Array  # (n, 2): rho u
    seen: Bools  # (n,): the likelier of the two, as a detection list would say
    radius_m: float
    wall_m: float  # height of the rim above the camera


def stars_on_rim_plane(evidence: Evidence, terrain: Terrain) -> RimPlane:
    """The stars that a detection list would hold or lack: with decisive evidence, and above the lowest skyline.

    Faint stars whose light was not measured either way are on no list. A star lower than the rim seen from the opposite
    wall is hidden from everywhere on the floor. Raises BadInput bad_terrain where the terrain is no cylinder, or none.
    """
    terrain = require_terrain(terrain)
    certainty = np.abs(evidence.llr)
    evidence = evidence.take(certainty >= min(DECISIVE_NATS, 0.5 * float(certainty.max(initial=0.0))))
    if terrain.rim is None:
        raise BadInput("bad_terrain", f"{terrain.name}: this method needs a [cylinder]")
    radius, height = terrain.rim
    points = points_of_rays(height, evidence.azimuth_rad, evidence.elevation_rad)
    rho = np.hypot(points[:, 0], points[:, 1])
    above = rho < 2 * radius
    wall = float(np.median(rho[above] * np.tan(evidence.elevation_rad[above]))) if above.any() else 0.0
    return RimPlane(points[above], evidence.llr[above] > 0, radius, wall)


def points_of_rays(wall_m: float, azimuths_rad: Array, elevations_rad: Array) -> Array:
    """Points (n, 2) [m] where rays (n,) pierce a plane `wall_m` above the camera: rho u, rho = wall / tan e, u level.

    A ray is visible from p exactly where |p + rho u| is below the radius of the rim in that plane; rays at or below
    the horizontal pierce it infinitely far away.
    """
    tan = np.tan(elevations_rad)
    rho = np.divide(wall_m, tan, out=np.full_like(tan, FAR_M), where=tan > 0)
    return np.minimum(rho, FAR_M)[:, None] * np.stack([np.sin(azimuths_rad), np.cos(azimuths_rad)], axis=-1)


def point_fix(position_m: Array, terrain: Terrain) -> Fix:
    """The fix at a position (2,) [m] of a method without a posterior: covariance and circles are infinite, not stated.

    The method's published error is no substitute: it holds for the publication's skies, not for this evidence. Raises
    NotLocated outside_search_area where the position is beyond the search radius or no camera can stand there.
    """
    require_inside(position_m[None], np.ones(1), terrain)
    if not terrain.allowed(position_m[None])[0]:
        raise NotLocated(
            f"the stars place the camera at E {position_m[0]:.0f} m N {position_m[1]:.0f} m, where none can stand",
            reason="outside_search_area",
        )
    return Fix(
        position_enu_m=camera_at(position_m, terrain),
        covariance_m2=np.full((2, 2), np.inf),
        radius95_m=np.inf,
        radius999_m=np.inf,
        modes=(Mode(east_m=float(position_m[0]), north_m=float(position_m[1]), weight=1.0),),
        ambiguous=False,
        search="approximate",
    )


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
