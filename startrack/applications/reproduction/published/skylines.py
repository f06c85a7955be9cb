"""The skylines that the methods get, one in sunlight and one that the stars show in the dark; the grid of the map."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from startrack.core.types import MIDDLES_RAD, SECTORS, Array, Evidence, MeasuredSkyline, NotLocated, sector_of
from startrack.evidence import Skyline, average_shifts
from startrack.terrain import Terrain

LIT_SIGMA_RAD = 1.0 / 652.0  # one pixel of a 180-degree fisheye of 2048 pixels: the noise that the papers assume
MAP_STEP_M = 75.0  # between positions of a grid: that of Stein and Medioni (Kua 2008, section 2.2), the only one given
LEAST_BEARINGS = 3  # of a skyline: two coordinates and one to spare
MERGED_SECTORS = 5  # 7.5 degrees: about 8 hidden stars of 2142 below the skyline of the thesis's crater
DARK_SHIFTS_RAD = np.radians(np.arange(-45.0, 45.0, 0.02))  # of the map's skyline, in which stars are looked for
END_WEIGHT = 1e-6  # of the first and the last shift: a larger one shows that no star stops the skyline on that side
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


def dark_skyline(evidence: Evidence, fix_m: Array, terrain: Terrain) -> MeasuredSkyline:
    """The skyline that the stars of the `evidence` show about startrack's fix at `fix_m` (2,).

    As `startrack.chain` measures it: the map gives the shape within a sector only, and every shift of it is equally
    likely before. Its sectors are too narrow for a list of 2142 stars (one in a hundred has stars on both sides within
    three degrees), so that five of them count as one here, and the shifts reach farther. Known at the middle one of
    the five, where stars stand on both sides.
    """
    horizon = Skyline.trace(fix_m, terrain)
    above = evidence.elevation_rad - horizon(evidence.azimuth_rad)
    column = np.searchsorted(DARK_SHIFTS_RAD, above)  # the star is visible at the shifts below its height
    sums = np.zeros((SECTORS // MERGED_SECTORS, len(DARK_SHIFTS_RAD) + 1))
    np.add.at(sums, (sector_of(evidence.azimuth_rad) // MERGED_SECTORS, column), evidence.llr)
    log = sums.sum(axis=1, keepdims=True) - np.cumsum(sums, axis=1)[:, :-1]
    weight, shift, sigma = average_shifts(log, DARK_SHIFTS_RAD)
    known = weight[:, [0, -1]].max(axis=1) < END_WEIGHT
    middle = np.arange(MERGED_SECTORS // 2, SECTORS, MERGED_SECTORS)[known]
    elevation_rad, sigma_rad, source = np.full(SECTORS, np.nan), np.full(SECTORS, np.inf), np.full(SECTORS, "", "<U9")
    elevation_rad[middle] = horizon(MIDDLES_RAD[middle]) + shift[known]
    sigma_rad[middle], source[middle] = sigma[known], "stars"
    return MeasuredSkyline(azimuth_rad=MIDDLES_RAD, elevation_rad=elevation_rad, sigma_rad=sigma_rad, source=source)


def require_bearings(skyline: MeasuredSkyline) -> None:
    """Raises NotLocated for a `skyline` that is known at too few bearings."""
    count = int(np.count_nonzero(skyline.known))
    if count < LEAST_BEARINGS:
        raise NotLocated(f"the skyline is known in {count} sectors, and {LEAST_BEARINGS} are needed")


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


traced_grid = lru_cache(maxsize=1)(MapGrid.trace)  # once a process: minutes on a height map
