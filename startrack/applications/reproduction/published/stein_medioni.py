"""Skylines as polygons in a hash table: chains of segments vote for positions, which the full skyline verifies.

Built from the description in Kua 2008, section 2.2 (its reference [10], Stein and Medioni), not from the paper: line
segments instead of the skyline, a grid of 75 m, skylines computed beforehand. The heading is known roughly. Published
errors on photographs: 300 to 600 m.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from startrack.applications.reproduction.published.polygons import chains_of, keys_of, near_keys, polygon_vertices
from startrack.applications.reproduction.published.skylines import MapGrid, close_gaps, require_bearings
from startrack.core.types import SECTORS, Array, Ints, MeasuredSkyline, NotLocated

TOLERANCES_RAD = tuple(float(np.radians(one)) for one in (1.6, 0.8, 0.4))  # of polygons; noise is a fifth of the last
ROUGH_HEADING_RAD = float(np.radians(3.0))  # standard deviation: two sectors
TURNS = 6  # sectors to either side: three sigma of the heading
VERIFIED = 2000  # positions with the most votes, a thirtieth of the grid


@dataclass(frozen=True, eq=False)
class PolygonTable:
    """The chains of all polygons of a grid by tolerance: sorted keys, and the position of each."""

    keys: tuple[Ints, ...]
    positions: tuple[Ints, ...]

    @classmethod
    def index(cls, grid: MapGrid) -> PolygonTable:
        """The table of a `grid`."""
        found = []
        for vertices in polygon_vertices(grid.horizon_rad, TOLERANCES_RAD):
            position, shape = chains_of(grid.horizon_rad, vertices)
            keys = keys_of(shape)
            order = np.argsort(keys, kind="stable")
            found.append((keys[order], position[order]))
        return cls(tuple(keys for keys, _ in found), tuple(positions for _, positions in found))

    def count_votes(self, elevation_rad: Array, positions: int) -> Ints:
        """Number of chains of a whole skyline (SECTORS,) that each of so many `positions` has too."""
        votes = np.zeros(positions, dtype=np.int64)
        polygons = polygon_vertices(elevation_rad[None], TOLERANCES_RAD)
        for vertices, keys, position in zip(polygons, self.keys, self.positions, strict=True):
            _, shapes = chains_of(elevation_rad[None], vertices)
            for shape in shapes:
                near = near_keys(shape)
                ends = np.searchsorted(keys, near), np.searchsorted(keys, near, side="right")
                found = [position[start:stop] for start, stop in zip(*ends, strict=True)]
                votes[np.unique(np.concatenate(found))] += 1
        return votes


polygon_table = lru_cache(maxsize=1)(PolygonTable.index)  # once a process: ten seconds


def locate_by_segments(
    skyline: MeasuredSkyline, grid: MapGrid, table: PolygonTable, heading_sigma_rad: float = ROUGH_HEADING_RAD
) -> Array:
    """The position (2,) [m] of the `grid` whose skyline, turned by a likely error of the heading, is the one seen.

    Raises NotLocated where no chain of the `table` is seen, and for a `skyline` at too few bearings.
    """
    require_bearings(skyline)
    votes = table.count_votes(close_gaps(skyline), len(grid.points_m))
    if not votes.any():
        raise NotLocated("no position has a chain of segments of the skyline")
    best = np.argsort(-votes, kind="stable")[:VERIFIED]
    best = best[votes[best] > 0]
    return np.asarray(grid.points_m[best[np.argmin(_misfit(skyline, grid.horizon_rad[best], heading_sigma_rad))]])


def _misfit(skyline: MeasuredSkyline, horizon_rad: Array, heading_sigma_rad: float) -> Array:
    """Sum (n,) of squares of a skyline from those of the map (n, SECTORS), in sigmas, at the best heading."""
    turns = range(-TURNS, TURNS + 1) if heading_sigma_rad > 0.0 else (0,)
    known, found = np.flatnonzero(skyline.known), []
    for turn in turns:
        off = (horizon_rad[:, (known + turn) % SECTORS] - skyline.elevation_rad[known]) / skyline.sigma_rad[known]
        angle = turn * 2 * np.pi / SECTORS
        found.append(np.square(off).sum(axis=1) + (np.square(angle / heading_sigma_rad) if turn else 0.0))
    return np.asarray(np.min(found, axis=0))
