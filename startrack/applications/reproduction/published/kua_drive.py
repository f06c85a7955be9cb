"""Stars along a straight drive: the outermost ones as a skyline, depth of the crater and positions by least squares.

Built from the description of the author's earlier work in Kua 2008, section 2.2 (its reference [13]), not from the
paper: skylines along the outermost stars, odometry, a straight line, a crater of known diameter; depth and positions
are estimated. Published, scaled to a crater of 20 km: 800 m, and 110 m for the depth. Neither the length of the drive
nor its stops are given.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.core.types import Array, NotLocated

DRIVE_M = 4000.0  # a fifth of the crater
STOPS = 9  # one in 500 m
ODOMETRY_SIGMA_1 = 0.02  # of a leg's length; the stars give its direction
SKYLINE_SIGMA_M = 1000.0  # of an outermost star's point on the rim, about its scatter: odometry outweighs it
START_DEPTH_1 = 0.1  # of the diameter


@dataclass(frozen=True, eq=False)
class Drive:
    """Positions of the stops of a straight drive, the last one at the place, and the legs that odometry measures."""

    positions_m: Array  # (STOPS, 2): the truth, not an input
    legs_m: Array  # (STOPS - 1, 2)


def draw_drive(end_m: Array, radius_m: float, *, rng: np.random.Generator) -> Drive:
    """A drive in a random direction that ends at `end_m` (2,) and begins inside the circle of `radius_m`."""
    while True:
        heading = rng.uniform(0.0, 2 * np.pi)
        way = np.array([np.sin(heading), np.cos(heading)])
        if np.hypot(*(end_m - DRIVE_M * way)) < radius_m:
            break
    leg = DRIVE_M / (STOPS - 1)
    positions = end_m - leg * np.arange(STOPS - 1, -1, -1)[:, None] * way
    measured = leg * (1.0 + ODOMETRY_SIGMA_1 * rng.standard_normal(STOPS - 1))
    return Drive(positions, measured[:, None] * way)


def outermost_stars(points_m: Array, wall_m: float) -> Array:
    """Horizontal vectors (k, 2) to the stars of the hull, per metre of depth; `points_m` (n, 2) lie on the rim's plane.

    The plane of the hull is the picture of an equidistant fisheye, as in `startrack.localization.hull_position`.
    Raises NotLocated for fewer than three stars.
    """
    from scipy.spatial import ConvexHull

    if len(points_m) < 3:
        raise NotLocated(f"{len(points_m)} seen stars make no hull")
    rho = np.hypot(*points_m.T)
    per_metre = np.arctan2(rho, wall_m) / np.maximum(rho, 1e-9)
    return np.asarray(points_m[ConvexHull(points_m * per_metre[:, None]).vertices] / wall_m)


def locate_by_drive(vectors: list[Array], legs_m: Array, radius_m: float) -> tuple[Array, float]:
    """Positions (stops, 2) [m] of all stops and the depth [m] of a crater of `radius_m`.

    `vectors` of each stop (k, 2) are those of `outermost_stars`, `legs_m` (stops - 1, 2) the odometry. Minimised are
    the distances of the stars' points from the rim, and of the legs from the odometry. Raises NotLocated where the
    iteration does not settle, or settles outside the crater.
    """
    from scipy.optimize import least_squares

    stops = len(vectors)
    stop = np.repeat(np.arange(stops), [len(one) for one in vectors])
    ways, leg_sigma = np.concatenate(vectors), ODOMETRY_SIGMA_1 * np.hypot(*legs_m.T)

    def residuals(unknown: Array) -> Array:
        positions, depth = unknown[:-1].reshape(stops, 2), unknown[-1] * radius_m
        off_rim = np.hypot(*(positions[stop] + depth * ways).T) - radius_m
        off_legs = (np.diff(positions, axis=0) - legs_m) / leg_sigma[:, None]
        return np.concatenate([off_rim / SKYLINE_SIGMA_M, off_legs.ravel()])

    driven = np.concatenate([np.zeros((1, 2)), np.cumsum(legs_m, axis=0)])
    start = np.mean([_fit_circle(2 * START_DEPTH_1 * radius_m * one, radius_m) for one in vectors] - driven, axis=0)
    first = np.append((start + driven).ravel(), 2 * START_DEPTH_1)
    found = least_squares(residuals, first, x_scale=np.append(np.full(2 * stops, radius_m / 10), START_DEPTH_1))
    positions = found.x[:-1].reshape(stops, 2)
    if not found.success or found.x[-1] <= 0.0 or np.hypot(*positions.T).max() > radius_m:
        raise NotLocated("the least squares over depth and positions do not settle in the crater")
    return positions, float(found.x[-1] * radius_m)


def _fit_circle(points_m: Array, radius_m: float) -> Array:
    """Position (2,) [m] from which the points (n, 2) lie on the rim: the linear fit of Kua 2008, eq. 3.4 to 3.6."""
    a = np.column_stack([np.ones(len(points_m)), -2 * points_m])
    solution, *_ = np.linalg.lstsq(a, radius_m**2 - np.square(points_m).sum(axis=1), rcond=None)
    return -solution[1:]
