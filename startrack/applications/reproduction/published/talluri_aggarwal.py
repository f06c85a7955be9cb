"""Four bearings of the skyline prune a grid of positions; the full skylines of the others are compared.

Built from the description in Kua 2008, section 2.2 (its reference [9], Talluri and Aggarwal), not from the paper. The
heading is known. Published mean errors: 26 m with exact skylines, 55 m with noise.
"""

from __future__ import annotations

import numpy as np

from startrack.applications.reproduction.published.skylines import MAP_STEP_M, MapGrid, require_bearings
from startrack.core.types import SECTORS, Array, Bools, Ints, MeasuredSkyline, NotLocated
from startrack.terrain import Terrain

PRUNING_SIGMAS = 3.0  # of the skyline at each of the four bearings


def locate_by_four_bearings(skyline: MeasuredSkyline, terrain: Terrain, grid: MapGrid) -> Array:
    """The position (2,) [m] of the `grid` whose skyline has the least mean square distance from the one seen.

    Raises NotLocated where no position has the four elevations, and for a `skyline` at too few bearings.
    """
    require_bearings(skyline)
    left = positions_with_elevations(skyline, terrain, grid.points_m)
    if not left.any():
        raise NotLocated("no position of the grid has the skyline's elevations at the four bearings")
    known = skyline.known
    difference = grid.horizon_rad[left][:, known] - skyline.elevation_rad[known]
    return np.asarray(grid.points_m[left][np.argmin(np.square(difference).mean(axis=1))])


def positions_with_elevations(skyline: MeasuredSkyline, terrain: Terrain, points_m: Array) -> Bools:
    """Whether cells of the grid `points_m` (n, 2) contain a position with the elevations seen at the four bearings."""
    left, half_m = np.arange(len(points_m)), np.array(0.5 * MAP_STEP_M)
    for sector in cardinal_sectors(skyline):
        low, high = terrain.horizon_bounds_rad(points_m[left], half_m, skyline.azimuth_rad[sector])
        seen, margin = skyline.elevation_rad[sector], PRUNING_SIGMAS * skyline.sigma_rad[sector]
        left = left[(low - margin <= seen) & (seen <= high + margin)]
    return np.isin(np.arange(len(points_m)), left)


def cardinal_sectors(skyline: MeasuredSkyline) -> Ints:
    """Sectors (4,) with a known elevation that are nearest to north, east, south and west."""
    known = np.flatnonzero(skyline.known)
    away = np.abs(known[None, :] + 0.5 - 0.25 * SECTORS * np.arange(4)[:, None])
    return np.asarray(known[np.argmin(np.minimum(away, SECTORS - away), axis=1)])
