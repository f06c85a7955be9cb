"""The thesis's crater environment simulator: random starfields, a cylinder, the list of stars visible at a position.

The limit for a perfect list is the centroid of the cell of positions from which exactly the listed stars are visible:
by brute force on a grid, independently of the localizer's search, so that each checks the other.

Source, also of the published results: Kua 2008, CMU-RI-TR-08-21, sections 3.2.1 and 3.2.2. No pixels: stars are
identified and detected without error, except for `Mistakes`. All random draws depend on (seed, sky, number of the
position) only.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from startrack.core.types import Array, Bools, Evidence
from startrack.frames import Site
from startrack.terrain import Cylinder

DIAMETER_M, ASPECT_RATIO = 20_000.0, 10.0  # Shackleton as the thesis has it (section 3.3)
MAGNITUDE = 6.0
RIM_POINTS = 360  # of the drawn crater edge (section 3.2.1)
STEP_M = 5.0  # of the traverse through the middle of the crater (section 3.2.2)
GRID_POINTS = 161  # a side; odd, so that the position itself is a point of the first grid and the cell is not missed
FIRST_HALF_M = 20.0
CELL_MARGIN, REFINEMENTS = 1.05, 2  # of the grid
SHACKLETON = Site(body="moon", latitude_rad=float(np.radians(-89.66)), longitude_rad=float(np.radians(129.78)))
Stream = IntEnum("Stream", "STARS POSITIONS MISTAKES LIT TILT REST DRIVE HEADING ANY_HEADING PICTURE OBSTACLE")
THESIS: dict[str, Any] = {  # its results, those of the pseudo-gradient if it is not said
    "trials": [  # table 3.1: position errors
        {"mean_m": mean, "sd_m": sd, "max_m": largest}
        for mean, sd, largest in (
            (33.3, 29.8, 317.9), (33.7, 29.9, 327.3), (34.6, 31.7, 344.3), (33.6, 30.2, 271.2), (34.3, 30.2, 242.9),
            (34.1, 32.3, 300.7), (36.2, 32.9, 325.6), (33.9, 31.2, 300.2), (34.1, 31.2, 358.4), (34.4, 31.5, 356.6),
        )
    ],
    "overall": {"mean_m": 34.2, "sd_m": 31.1, "max_m": 358.4},  # table 3.1
    "hull": {"mean_m": 637.0, "sd_m": 275.0, "max_m": 1735.0},  # section 3.1.1
    "never_settle": 0.006,  # section 3.1.2
    "stars": 2142,  # section 3.2.2
    "aspect_ratios": [5.0, 50.0],  # section 3.2.3, of lunar craters
    "gaps": {"mean_m": 14.9031, "max_m": 215.0},  # between changes of the view: figure 3.7, magnitude 6
}  # fmt: skip


def star_count(magnitude: float) -> int:
    """Number of stars down to a magnitude on half the sky: 6.57 e^(1.08 M) (1 - cos(A / 2)) / 2 with A = 180 degrees.

    Rounded: 2142 at magnitude 6. Source: Liebe 2002, as Kua 2008, eq. 3.8.
    """
    return round(float(6.57 * np.exp(1.08 * magnitude) * 0.5))


def crater(aspect_ratio: float = ASPECT_RATIO) -> Cylinder:
    """A crater as wide as Shackleton, of any aspect ratio (diameter to depth); the camera is on the floor."""
    return Cylinder(
        name=f"kua-2008-{aspect_ratio:g}",
        site=SHACKLETON,
        diameter_m=DIAMETER_M,
        depth_m=DIAMETER_M / aspect_ratio,
        search_radius_m=DIAMETER_M / 2,
    )


@dataclass(frozen=True)
class Sky:
    """A random starfield: azimuths and elevations (n,) [rad] in enu. A deeper one begins with the same stars."""

    azimuth_rad: Array
    elevation_rad: Array

    @classmethod
    def draw(cls, seed: int, sky: int, magnitude: float = MAGNITUDE) -> Sky:
        """Starfield number `sky` of a `seed`: phi = 2 pi r1, theta = arcsin r2, r1 and r2 uniform: eq. 3.9 and 3.10."""
        r1, r2 = _draw_uniform([seed, Stream.STARS, sky], (star_count(magnitude), 2)).T
        return cls(2 * np.pi * r1, np.arcsin(r2))

    def __len__(self) -> int:
        return len(self.azimuth_rad)

    def project_to_rim_plane(self, cylinder: Cylinder) -> Array:
        """Points (n, 2) [m]: from p, star i is visible exactly when |p + point_i| < R."""
        rho = cylinder.wall_m / np.tan(self.elevation_rad)
        return rho[:, None] * directions(self.azimuth_rad)


def directions(azimuth_rad: Array) -> Array:
    """Horizontal unit vectors (n, 2), east and north."""
    return np.stack([np.sin(azimuth_rad), np.cos(azimuth_rad)], axis=-1)


def draw_positions(seed: int, sky: int, start: int, stop: int, radius_m: float = DIAMETER_M / 2) -> Array:
    """Positions number start to stop - 1 (n, 2) [m] of a sky, uniform over the crater's floor."""
    r1, r2 = _draw_uniform([seed, Stream.POSITIONS, sky], (stop, 2))[start:].T
    return radius_m * np.sqrt(r1)[:, None] * directions(2 * np.pi * r2)


def visible_stars(points_m: Array, position_m: Array, radius_m: float) -> Bools:
    """Whether stars (n,), given on the rim's plane [m], are in sight from a position (2,) [m].

    The thesis tests against a polygon of 360 points of the rim; it differs from the circle by 0.4 m at most.
    """
    east, north = (points_m + position_m).T
    return np.asarray(np.square(east) + np.square(north) < radius_m**2)


def crater_edge(cylinder: Cylinder, position_m: Array) -> tuple[Array, Array]:
    """Azimuths and elevations (361,) [rad] of the rim from a position, at even steps along the rim, closed."""
    rim = cylinder.radius_m * directions(np.linspace(0.0, 2 * np.pi, RIM_POINTS + 1)) - position_m
    return np.arctan2(rim[:, 0], rim[:, 1]), np.arctan2(cylinder.wall_m, np.hypot(rim[:, 0], rim[:, 1]))


@dataclass(frozen=True)
class Mistakes:
    """The error rates of a list of stars, which the evidence assumes too."""

    missed: float  # probability for a visible star
    false: float  # for a hidden star

    def draw_list(self, in_sight: Bools, seed: int, sky: int, number: int) -> Bools:
        """Draw the list of position `number`: whether each star (n,) is on it."""
        r = _draw_uniform([seed, Stream.MISTAKES, sky, number], (len(in_sight),))
        return np.where(in_sight, r >= self.missed, r < self.false)

    def evidence(self, sky: Sky, listed: Bools) -> Evidence:
        """Evidence of a list: ln((1 - missed) / false) of the stars on it, ln(missed / (1 - false)) of the others."""
        for_it, against = np.log([(1 - self.missed) / self.false, self.missed / (1 - self.false)])
        llr = np.where(listed, for_it, against)
        return Evidence(azimuth_rad=sky.azimuth_rad, elevation_rad=sky.elevation_rad, llr=llr)


PERFECT = Mistakes(missed=1e-6, false=1e-6)  # none, as in the thesis


def cell_centroid(points_m: Array, position_m: Array, radius_m: float) -> Array:
    """Centroid (2,) [m] of the cell around a position (2,), the least-squares estimate from a perfect list.

    Stars (n, 2) as points on the rim's plane. The window grows until the cell does not touch its border, then shrinks
    to the cell; a part of the cell beyond a gap as wide as the window is not included.
    """
    seen = visible_stars(points_m, position_m, radius_m)
    low, high = position_m - FIRST_HALF_M, position_m + FIRST_HALF_M
    while True:
        inside, x, y = _cell_mask(points_m, seen, low, high, radius_m)
        rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
        if min(rows[0], columns[0]) > 0 and max(rows[-1], columns[-1]) < GRID_POINTS - 1:
            break
        low, high = position_m - 2 * (position_m - low), position_m + 2 * (high - position_m)
    for _ in range(REFINEMENTS):
        step = np.array([x[1] - x[0], y[1] - y[0]])
        ends = np.array([[x[columns[0]], y[rows[0]]], [x[columns[-1]], y[rows[-1]]]])
        middle, half = ends.mean(axis=0), CELL_MARGIN * (np.diff(ends, axis=0)[0] / 2 + step)
        closer, x_closer, y_closer = _cell_mask(points_m, seen, middle - half, middle + half, radius_m)
        if not closer.any():  # a sliver between the new grid's points: the coarser grid's result is kept
            break
        inside, x, y = closer, x_closer, y_closer
        rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    north, east = np.nonzero(inside)
    return np.array([x[east].mean(), y[north].mean()])


def _cell_mask(
    points_m: Array, seen: Bools, low_m: Array, high_m: Array, radius_m: float
) -> tuple[Bools, Array, Array]:
    """Grid points (rows north, columns east) from which exactly the listed stars are visible; x and y of the grid."""
    x = np.linspace(low_m[0], high_m[0], GRID_POINTS)
    y = np.linspace(low_m[1], high_m[1], GRID_POINTS)
    middle, half_diagonal_m = (low_m + high_m) / 2, float(np.hypot(*(high_m - low_m))) / 2
    crossing = np.abs(np.hypot(*(points_m + middle).T) - radius_m) <= half_diagonal_m
    inside = np.square(x)[None, :] + np.square(y)[:, None] < radius_m**2
    for (east, north), is_seen in zip(points_m[crossing], seen[crossing], strict=True):
        inside &= (np.square(x + east)[None, :] + np.square(y + north)[:, None] < radius_m**2) == is_seen
    return inside, x, y


def changes_m(sky: Sky, cylinder: Cylinder) -> Array:
    """Sorted distances from the centre [m], west to east, at which a star appears or disappears.

    Star i is visible inside the circle of radius R about -point_i, so the changes are where the line north = 0 crosses
    these circles: exact, where the thesis compares views at steps along the line.
    """
    east, north = sky.project_to_rim_plane(cylinder).T
    met = np.abs(north) < cylinder.radius_m
    half_chord = np.sqrt(np.square(cylinder.radius_m) - np.square(north[met]))
    crossings = np.concatenate([-east[met] - half_chord, -east[met] + half_chord])
    return np.sort(crossings[np.abs(crossings) < cylinder.radius_m])


def gaps_m(changes: Array, cylinder: Cylinder) -> Array:
    """Distances (n - 1,) [m] from one change to the next; the diameter if there are fewer than two changes."""
    return np.diff(changes) if len(changes) > 1 else np.array([cylinder.diameter_m])


def mean_gap_m(changes: Array, cylinder: Cylinder) -> float:
    """Mean distance between changes: the diameter over their number (the thesis's 14.9031 m is 20 km / 1342)."""
    return cylinder.diameter_m / max(len(changes), 1)


def change_steps_m(changes: Array, cylinder: Cylinder, step_m: float = STEP_M) -> Array:
    """Ends (n,) [m] of the steps along the traverse within which the view changes.

    Several changes within one step count as one. Source: Kua 2008, figures 3.7-3.9, whose step is not given: 5 m is
    what its figures at magnitude 6 are multiples of (215 m), and what gives its mean (20 km / 1342).
    """
    steps = np.unique(np.floor((changes + cylinder.radius_m) / step_m))
    return (steps + 1) * step_m - cylinder.radius_m


def _draw_uniform(stream: list[int], shape: tuple[int, ...]) -> Array:
    """Array of this shape, uniform over [0, 1), the same for a `stream`; a longer one begins with the shorter one."""
    rng = np.random.default_rng(stream)
    return rng.random(shape)
