"""Places of a prediction: cells of the search area in the terrain's map projection, or points along a path."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from startrack.applications.prediction.draws import Place
from startrack.core import MAX_COUNT
from startrack.core.types import Array, BadInput, Ints
from startrack.frames import Site, enu_from_latlon, latlon_from_enu
from startrack.output import nice_step
from startrack.rendering import STEP_ROUNDING_1, Drive
from startrack.terrain import Raster, Terrain

DEFAULT_CELLS_ACROSS = 10  # of the default spacing
HEIGHT_STEPS = 4  # the horizontal position of a map's point depends on its height: 1 part in 1000 a step
PLACES_RING_RAD = np.linspace(0.0, 2 * np.pi, 181)


def numbered_places(numbers: Iterable[int], position_m: Array) -> list[Place]:
    """The places at positions (k, 2) east and north with their `numbers` (k,)."""
    return [Place(int(k), float(east), float(north)) for k, (east, north) in zip(numbers, position_m, strict=True)]


@dataclass(frozen=True, eq=False)
class PathPoints:
    """Points of a path: its waypoints, and points between them."""

    distance_m: Array  # (k,) from its start
    position_m: Array  # (k, 2) east and north
    kind = "path"

    @property
    def spacing_m(self) -> float:
        """Largest distance of neighbours along the path [m]."""
        return float(np.diff(self.distance_m).max())

    @property
    def places(self) -> list[Place]:
        """The points, numbered from the start."""
        return numbered_places(range(len(self.position_m)), self.position_m)


@dataclass(frozen=True, eq=False)
class AreaCells:
    """Cells of a grid in a map projection whose middles are in the search area."""

    frame: Raster  # without values: the place of the grid
    cell: Ints  # (k,) index into the flattened grid
    position_m: Array  # (k, 2) east and north of the middles
    spacing_m: float  # at the origin
    site: Site  # of the terrain
    kind = "area"

    @property
    def places(self) -> list[Place]:
        """The middles of the cells, numbered over the whole grid."""
        return numbered_places(self.cell, self.position_m)

    def band(self, values: Array) -> NDArray[np.float32]:
        """The `values` (k,) of the cells on the whole grid (rows, columns), NaN elsewhere."""
        whole = np.full(self.frame.heights_m.size, np.nan, dtype=np.float32)
        whole[self.cell] = values
        return whole.reshape(self.frame.heights_m.shape)

    def raster(self, values: Array) -> Raster:
        """The `values` (k,) of the cells as a map."""
        return replace(self.frame, heights_m=self.band(values))


def area_cells(terrain: Terrain, spacing_m: float) -> AreaCells:
    """The cells of the search area, `spacing_m` apart at the origin, one of which is centred there.

    Raises BadInput (bad_terrain) for a terrain without a map projection, without a place for a camera, and for more
    than a million cells.
    """
    site, projection = terrain.site, terrain.projection
    if site is None or projection is None:
        raise BadInput(
            "bad_terrain", f"terrain {terrain.name} has no map projection: give one of height maps, or on the Moon"
        )
    ring_m = terrain.search_radius_m * np.stack([np.sin(PLACES_RING_RAD), np.cos(PLACES_RING_RAD)], axis=-1)
    x, y = projection.xy_from_latlon(*latlon_from_enu(site, ring_m[:, 0], ring_m[:, 1], 0.0))
    middle_x, middle_y = projection.xy_from_latlon(site.latitude_rad, site.longitude_rad)
    x_per_m, y_per_m = projection.units_per_m(site.latitude_rad)
    dx, dy = spacing_m * x_per_m, spacing_m * y_per_m
    half_x = int(np.ceil(np.max(np.abs(x - middle_x)) / dx))
    half_y = int(np.ceil(np.max(np.abs(y - middle_y)) / dy))
    shape = 2 * half_y + 1, 2 * half_x + 1
    if shape[0] * shape[1] > MAX_COUNT:
        raise BadInput("bad_terrain", f"{shape[0]} x {shape[1]} cells of {spacing_m:g} m: more than {MAX_COUNT}")
    frame = Raster(
        heights_m=np.zeros(shape, dtype=np.float32), projection=projection, x0_m=float(middle_x - half_x * dx),
        y0_m=float(middle_y + half_y * dy), dx_m=float(dx), dy_m=float(-dy), source=terrain.name,
    )  # fmt: skip
    rows_columns = np.indices(shape).reshape(2, -1).T.astype(np.float64)
    points_m = _ground_points_m(terrain, site, *projection.latlon_from_xy(*frame.xy(rows_columns)))
    inside = np.hypot(*points_m.T) <= terrain.search_radius_m
    inside[inside] = np.asarray(terrain.allowed(points_m[inside]), dtype=bool)
    if not inside.any():
        raise BadInput("bad_terrain", f"{terrain.name}: no camera can stand in any cell of {spacing_m:g} m")
    return AreaCells(frame, np.flatnonzero(inside), points_m[inside], spacing_m, site)


def default_spacing_m(terrain: Terrain) -> float:
    """Spacing [m] of cells: a nice number, at most a tenth of the width of a `terrain`'s search area."""
    return nice_step(2 * terrain.search_radius_m / DEFAULT_CELLS_ACROSS)


def path_points(drive: Drive, terrain: Terrain, spacing_m: float) -> PathPoints:
    """The waypoints of a `drive` on a `terrain`, with evenly spaced points between, at most `spacing_m` apart.

    Raises BadInput (bad_odometry) where a point is outside of the search area, or no camera can stand there.
    """
    parts = np.ceil(np.diff(drive.distance_m) / spacing_m * (1 - STEP_ROUNDING_1))  # of the lines between waypoints
    if parts.sum() >= MAX_COUNT:
        raise BadInput("bad_odometry", f"{parts.sum() + 1:.0f} points on the path: more than {MAX_COUNT}")
    number = np.append(0, np.cumsum(np.maximum(parts, 1)))  # of each waypoint among the points
    distance_m = np.interp(np.arange(number[-1] + 1), number, drive.distance_m)
    points_m = np.stack([np.interp(distance_m, drive.distance_m, axis) for axis in drive.waypoints_m.T], axis=-1)
    bad = np.hypot(*points_m.T) > terrain.search_radius_m
    bad |= ~np.asarray(terrain.allowed(points_m), dtype=bool)
    if bad.any():
        east, north = points_m[np.argmax(bad)]
        raise BadInput(
            "bad_odometry", f"the path leaves the search area of {terrain.name} at {east:.0f} m east, {north:.0f} north"
        )
    return PathPoints(distance_m, points_m)


def _ground_points_m(terrain: Terrain, site: Site, latitude_rad: Array, longitude_rad: Array) -> Array:
    """East and north (n, 2) of the ground at places (n,); of places beyond the terrain's reach as on the sphere."""
    height_m = np.zeros(len(latitude_rad))
    for _ in range(HEIGHT_STEPS):
        points = enu_from_latlon(site, latitude_rad, longitude_rad, height_m)
        near = np.hypot(points[:, 0], points[:, 1]) <= terrain.reach_m
        height_m[near] += np.asarray(terrain.ground_m(points[near, :2])) - points[near, 2]
    return np.asarray(points[:, :2])
