"""The skyline that the methods get in sunlight, and the grid of the map."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import cast

import numpy as np

from startrack.core.types import MIDDLES_RAD, SECTORS, Array, MeasuredSkyline, NotLocated
from startrack.terrain import NO_POST, HeightMap, Terrain, cell_posts, require_site

LIT_SIGMA_RAD = 1.0 / 652.0  # one pixel of a 180-degree fisheye of 2048 pixels: the noise that the papers assume
MAP_STEP_M = 75.0  # between positions of a grid: that of Stein and Medioni (Kua 2008, section 2.2), the only one given
LEAST_BEARINGS = 3  # of a skyline: two coordinates and one to spare
PROFILE_BLOCK = 4096  # positions traced at once


def lit_skyline(
    truth_m: Array, terrain: Terrain, heading_error_rad: float = 0.0, *, rng: np.random.Generator
) -> MeasuredSkyline:
    """The skyline at `truth_m` (2,) in sunlight, at the middles of all sectors, with one pixel of normal noise.

    A bearing b of it is the azimuth b + `heading_error_rad`.
    """
    elevation = terrain.horizon_rad(np.tile(truth_m, (SECTORS, 1)), MIDDLES_RAD + heading_error_rad)
    return MeasuredSkyline(
        azimuth_rad=MIDDLES_RAD,
        elevation_rad=elevation + LIT_SIGMA_RAD * rng.standard_normal(SECTORS),
        sigma_rad=np.full(SECTORS, LIT_SIGMA_RAD),
        source=np.full(SECTORS, "sky light"),
    )


def require_bearings(skyline: MeasuredSkyline) -> None:
    """Raise NotLocated for a `skyline` that is known at too few bearings."""
    count = int(np.count_nonzero(skyline.known))
    if count < LEAST_BEARINGS:
        raise NotLocated(f"the skyline is known in {count} sectors, and {LEAST_BEARINGS} are needed")


def close_gaps(skyline: MeasuredSkyline) -> Array:
    """Elevations (SECTORS,) [rad] of a `skyline`, interpolated where it is not known."""
    known = np.flatnonzero(skyline.known)
    return np.interp(np.arange(SECTORS), known, skyline.elevation_rad[known], period=SECTORS)


@dataclass(frozen=True, eq=False)
class MapGrid:
    """Positions on a grid of the map where a camera can stand, and the map's skylines there."""

    points_m: Array  # (n, 2)
    horizon_rad: Array  # (n, SECTORS) at the middles of the sectors, in single precision: 1e-8 rad

    @classmethod
    def trace(cls, terrain: Terrain, step_m: float = MAP_STEP_M) -> MapGrid:
        """The grid of `step_m` over the search area of a `terrain`."""
        points = grid_points(terrain, step_m)
        blocks = [points[start : start + PROFILE_BLOCK, None, :] for start in range(0, len(points), PROFILE_BLOCK)]
        return cls(points, np.concatenate([terrain.horizon_rad(one, MIDDLES_RAD).astype(np.float32) for one in blocks]))


def grid_points(terrain: Terrain, step_m: float = MAP_STEP_M) -> Array:
    """Multiples (n, 2) [m] of `step_m` east and north of the origin that a `terrain` allows."""
    count = int(terrain.search_radius_m / step_m)
    line = step_m * np.arange(-count, count + 1)
    points = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)
    return points[terrain.allowed(points) & (np.hypot(*points.T) <= terrain.search_radius_m)]


def crest_posts_m(terrain: Terrain, view_m: Array) -> Array:
    """East, north and up (SECTORS, 3) [m] of the posts nearest to the crests of a map seen from `view_m` (2,).

    nan of ground without posts, and where a crest is on no map.
    """
    found = np.full((SECTORS, 3), np.nan)
    if terrain.rim is not None:
        return found
    ground = cast(HeightMap, terrain)
    tan, distance_m, _ = ground.horizons(view_m, MIDDLES_RAD)
    away_m = distance_m[:, None] * np.stack([np.sin(MIDDLES_RAD), np.cos(MIDDLES_RAD)], axis=1)
    up_m = float(ground.ground_m(view_m)) + ground.camera_height_m + tan * distance_m
    post, weight = cell_posts(require_site(ground), ground.maps, np.column_stack([view_m + away_m, up_m]))
    nearest = post[np.arange(len(post)), np.argmax(weight, axis=1)]
    found[nearest != NO_POST] = ground.errors.post_positions_m(nearest[nearest != NO_POST])
    return found


traced_grid = lru_cache(maxsize=1)(MapGrid.trace)  # once a process: minutes on a height map
