"""Height maps as ground: the horizon traced exactly, with a table of bounds that is computed once and kept."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np

from startrack.core.types import SECTORS, Array, BadInput, Bools
from startrack.frames import Site
from startrack.terrain.ground import Ground, ground_up_m, pack_maps, surfaces
from startrack.terrain.horizon_table import (
    AZIMUTH_BINS,
    NO_TABLE,
    HorizonTable,
    Square,
    box_bounds,
    flatten,
    flatten_rays,
    rows_of_rays,
    run_in_threads,
    sector_bounds,
    trace_horizons,
)
from startrack.terrain.maps.projections import EarthProjection, Projection
from startrack.terrain.maps.raster import Raster
from startrack.terrain.protocol import Progress, Terrain, TerrainFile
from startrack.terrain.table_cache import (
    TABLES_IN_MEMORY,
    costs_of,
    discard_table,
    key_of_table,
    load_or_build_table,
    path_of_table,
)

CELL_M = 200.0  # cells of the table are no wider
MAX_CELLS_ACROSS = 128
REACH_RADII = 1.15  # of the search radius: so far is searched, to notice that the camera left the area
SLOPE_STEP_M = 5.0
POINT_M, WIDE_RAD = 1.0, np.radians(2.0)  # boxes up to this half side are points: bounds that are wider are traced
MAX_TRACED_TURN_RAD = 0.25 * 2 * np.pi / AZIMUTH_BINS  # half widths of azimuths: bounds over wider ones are looked up
SECTOR_AZIMUTHS_RAD = (2 * np.arange(SECTORS) + 1)[None] * np.pi / SECTORS  # the localizer's, (1, SECTORS)
SECTOR_TURN_RAD = np.pi / SECTORS


@dataclass(frozen=True, eq=False, kw_only=True)
class TracedMap(Terrain):
    """The surface that is bilinear between the posts of height maps, as true 3-D points on the body.

    tan H = max over s of (z(p + s u) - z(p) - camera height + k s^2 / 2 R) / s, u the azimuth's direction, k the
    coefficient of terrestrial refraction, R the body's radius. Where several maps cover a point the first holds.
    Raises BadInput bad_terrain if the maps do not cover the search area. See `Terrain`.
    """

    name: str = "height map"
    site: Site
    maps: tuple[Raster, ...]  # finest first
    file: TerrainFile = Terrain.file
    camera_height_m: float = 1.5
    search_radius_m: float = Terrain.search_radius_m
    terrestrial_refraction_1: float = 0.0  # curvature of a level sight line in air, relative to the body's
    highest_beyond_m: float = -np.inf  # ground off the maps is no higher, nor than their highest post; as their heights
    _uses_table = True  # traces begin at the horizon's distance of a table in memory
    _similar_table: HorizonTable | None = None  # of a map much like this one: it tells about where horizons stand

    def __post_init__(self) -> None:
        if not self.maps:
            raise BadInput("bad_terrain", "[dem] needs at least one map")
        other = [one.source for one in self.maps if one.projection.body != self.site.body]
        if other:
            cause = f"{other[0]} is not a map of the {self.site.body.title()}, where the origin is"
            raise BadInput("bad_terrain", cause)
        if not self._covers(self.search_radius_m):
            raise BadInput(
                "bad_terrain",
                f"the maps do not cover the search area of {self.search_radius_m:.0f} m about the origin, or have "
                f"holes in it{self._voids_text()}: give a wider map, or a smaller radius",
            )

    def _voids_text(self) -> str:
        """The voids of each map, in brackets, with what its reader noted; empty where there are none."""
        counts = [(one, np.count_nonzero(np.isnan(one.heights_m))) for one in self.maps]
        found = [
            ", ".join([f"{count} of {one.heights_m.size} posts of {one.source or 'a map'} are voids", *one.notes])
            for one, count in counts if count
        ]  # fmt: skip
        return f" ({'; '.join(found)})" if found else ""

    @property
    def projection(self) -> Projection | EarthProjection:  # type: ignore[override]
        """Projection of the finest map."""
        return self.maps[0].projection

    @cached_property
    def ground(self) -> Ground:
        """Ground of the maps, packed for tracing."""
        return self._pack(keep_voids=False)

    def with_voids(self) -> Self:
        """Copy of this map whose `horizons` end at its voids, without its table."""
        if any(np.isnan(one.heights_m).any() for one in self.maps):
            return self.without_table().changed(ground=self._pack(keep_voids=True))
        return self.without_table()

    def _pack(self, keep_voids: bool) -> Ground:
        """Ground of the maps, packed with the bend of sight lines and the height of ground beyond."""
        packed = pack_maps(self.site, self.maps, keep_voids=keep_voids)
        return replace(
            packed,
            sag_per_m=self.terrestrial_refraction_1 / (2 * packed.radius_m),
            highest_m=max(packed.highest_m, self.highest_beyond_m - self.site.height_m),
        )

    @cached_property
    def reach_m(self) -> float:
        """Half side [m] of the searched square: the search area and a margin, as far as the maps reach."""
        wider = self.search_radius_m * REACH_RADII
        return wider if self._covers(wider) else self.search_radius_m

    @cached_property
    def square(self) -> Square:
        """Square of the cells of the table."""
        across = 1
        while 2 * self.reach_m / across > CELL_M and across < MAX_CELLS_ACROSS:
            across *= 2
        return Square(self.reach_m, across)

    @cached_property
    def crest_rad_per_m(self) -> float:
        """Rise [rad/m] of the horizon with its crest's height, cos^2 H / distance: the median from the origin."""
        return float(np.median(self._rad_per_m(*self.horizons(np.zeros(2), SECTOR_AZIMUTHS_RAD[0])[:2])))

    def crest_share(self, tan: Array, distance_m: Array) -> Array:
        """Error (...) of horizons by an error of height that crests share, relative to that at the median crest.

        Nearer than the spacing of the posts the ground below the camera errs with the crest.
        """
        return self._rad_per_m(tan, distance_m) / self.crest_rad_per_m

    def _rad_per_m(self, tan: Array, distance_m: Array) -> Array:
        """Rise (...) [rad/m] of horizons with the height of their crests, at `tan` of the horizon and distances."""
        return np.asarray(1.0 / ((1.0 + np.square(tan)) * np.maximum(distance_m, self.maps[0].post_m)))

    @cached_property
    def table_key(self) -> str:
        """Name of the table of horizons, by all that it follows from."""
        return key_of_table(self)

    @property
    def table_path(self) -> Path:  # type: ignore[override]
        """File of the table of horizons."""
        return path_of_table(self.table_key)

    @property
    def is_prepared(self) -> bool:
        """Whether the table of horizons is in memory or on disk."""
        return self.table_key in TABLES_IN_MEMORY or self.table_path.is_file()

    def prepare(self, progress: Progress | None = None) -> None:
        """Have the table of horizons in memory: from the cache on disk, else computed and cached.

        If several processes need the same table, one computes it and the others wait.
        """
        if "table" not in self.__dict__:
            self.__dict__["table"] = load_or_build_table(self, progress)

    @cached_property
    def table(self) -> HorizonTable:
        """The table of horizons; see `prepare`."""
        return load_or_build_table(self)

    def discard_table(self) -> None:
        """Remove the table of horizons from memory and disk."""
        self.__dict__.pop("table", None)
        discard_table(self.table_key)

    def costs_s(self) -> dict[str, float]:
        """Times [s] of "horizons", the table, where it is not there, and of "frame", the position of an image."""
        return costs_of(self)

    def without_table(self) -> Self:
        """Copy of this map whose traces begin at the camera; see `Terrain`."""
        return self.changed(_uses_table=False)

    def horizons(self, points_m: Array, azimuths_rad: Array) -> tuple[Array, Array, Array]:
        """Tangent, distance, and distance of the maps' end, (...) each, for the points (..., 2) at the azimuths (...).

        Distances are in metres, the last 1e9 beyond the horizon. A table in memory tells a trace where to begin.
        """
        shape, points, azimuths = flatten_rays(points_m, azimuths_rad)
        found = np.empty((3, len(azimuths)))
        table = TABLES_IN_MEMORY.get(self.table_key) if self._uses_table else None
        similar = self._similar_table if self._uses_table and table is None else None
        fixed = (*self._kernel_arguments(table or similar), similar is None)
        run_in_threads(trace_horizons, fixed, (points, azimuths, *found))
        tan, distance, edge = found.reshape(3, *shape)
        return tan, distance, edge

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """Elevation (...) [rad] of the horizon from points at azimuths, traced. See `Terrain`."""
        return np.arctan(self.horizons(points_m, azimuths_rad)[0])

    def horizon_bounds_rad(
        self, centres_m: Array, half_m: Array, azimuths_rad: Array, azimuth_half_rad: Array | float = 0.0
    ) -> tuple[Array, Array]:
        """Least and greatest horizon [rad] over boxes: by the table, for single rays and small boxes by tracing."""
        if np.ndim(half_m) == np.ndim(azimuth_half_rad) == 0 and half_m > POINT_M:
            shape, centres, azimuths = rows_of_rays(centres_m, azimuths_rad)
            if azimuth_half_rad >= MAX_TRACED_TURN_RAD or half_m >= self.table.square.half_m:
                found = self._bounds_of_sectors(centres, float(half_m), azimuths, float(azimuth_half_rad))
                return found[0].reshape(shape), found[1].reshape(shape)
        shape = np.broadcast_shapes(
            np.shape(centres_m)[:-1], np.shape(half_m), np.shape(azimuths_rad), np.shape(azimuth_half_rad)
        )
        centres = flatten(centres_m, (*shape, 2)).reshape(-1, 2)
        half, azimuths, turn = (flatten(a, shape).ravel() for a in (half_m, azimuths_rad, azimuth_half_rad))
        low, high = np.empty((2, len(half)))
        traced = (turn < MAX_TRACED_TURN_RAD) & (half < self.table.square.half_m)
        if traced.all():
            self._trace_bounds(centres, half, azimuths, turn, low, high)
        elif not traced.any() and np.all(half == half[0]):
            self._look_up_bounds(centres, half, azimuths, turn, low, high)
            wide = high - low > WIDE_RAD
            if half[0] <= POINT_M and wide.any():
                some = [a[wide] for a in (centres, half, azimuths, turn)]
                results = np.empty((2, len(some[0])))
                run_in_threads(box_bounds, self._kernel_arguments(self.table), (*some, *results))
                low[wide], high[wide] = results
        else:
            parts = [(self._look_up_bounds, ~traced & (half == kind)) for kind in np.unique(half[~traced])]
            for bounds, which in [*parts, (self._trace_bounds, traced)]:
                if which.any():
                    some = [np.ascontiguousarray(a[which]) for a in (centres, half, azimuths, turn)]
                    results = np.empty((2, len(some[0])))
                    bounds(*some, *results)
                    low[which], high[which] = results
        return low.reshape(shape), high.reshape(shape)

    def _trace_bounds(self, *arrays: Array) -> None:
        """Fill bounds over small boxes: centres (n, 2), half sides, azimuths, their half widths; then low, high."""
        *boxes, low, high = arrays

        def trace(missing: Bools) -> Array:
            found = np.empty((2, np.count_nonzero(missing)))
            run_in_threads(box_bounds, self._kernel_arguments(self.table), (*(one[missing] for one in boxes), *found))
            return found[:, :, None]

        self.table.box_memory.fill(np.column_stack(boxes), low[:, None], high[:, None], trace)

    def _look_up_bounds(self, *arrays: Array) -> None:
        """Fill bounds by the table over boxes of one size; arrays as in `_trace_bounds`."""
        centres, half, azimuths, turn, low, high = arrays
        each = azimuths[:, None], turn[:, None], centres, half, low[:, None], high[:, None]
        run_in_threads(sector_bounds, self._look_up_arguments(float(half[0])), each)

    def _bounds_of_sectors(self, centres: Array, half_m: float, azimuths: Array, turn_rad: float) -> Array:
        """Bounds (2, n, m) from the table over boxes of one size at centres (n, 2), and azimuths (1, m) or (n, 1)."""
        found = np.empty((2, len(centres), azimuths.shape[1]))
        numbers = np.column_stack([centres, np.full(len(centres), half_m)])

        def look_up(which: Bools) -> Array:
            some = np.ascontiguousarray(numbers[which])
            results = np.empty((2, len(some), azimuths.shape[1]))
            own = azimuths if len(azimuths) == 1 else azimuths[which]
            fixed, each = self._look_up_arguments(half_m), (own, np.full_like(own, turn_rad))
            boxes = np.ascontiguousarray(some[:, :2]), np.ascontiguousarray(some[:, 2]), *results
            if len(own) == 1:
                run_in_threads(sector_bounds, (*fixed, *each), boxes)
            else:
                run_in_threads(sector_bounds, fixed, (*each, *boxes))
            return results

        if turn_rad == SECTOR_TURN_RAD and np.array_equal(azimuths, SECTOR_AZIMUTHS_RAD):
            self.table.sector_memory.fill(numbers, found[0], found[1], look_up)
            return found
        return look_up(np.ones(len(centres), dtype=np.bool_))

    def _look_up_arguments(self, half_m: float) -> tuple[Any, ...]:
        """The first arguments of `sector_bounds` for boxes of this half side."""
        ground, table, height_m = self._kernel_arguments(self.table)
        return ground, table, *self.table.pyramid[self.table.level_for(half_m)], height_m

    def _kernel_arguments(self, table: HorizonTable | None) -> tuple[Any, ...]:
        """The first arguments of kernels: maps, table, height of the camera."""
        return self.ground.record, (table or NO_TABLE).record, self.camera_height_m

    def horizon_spread_rad(self, points_m: Array, half_m: float, azimuths_rad: Array) -> tuple[Array, Array]:
        """Middle and half width (...) [rad] of the horizon over boxes: tan H changes by slopes `half_m` / distance."""
        points = np.asarray(points_m, dtype=np.float64)
        tan, distance, _ = self.horizons(points, azimuths_rad)
        slopes = np.abs(tan) + np.tan(self.slope_rad(points))
        return np.arctan(tan), half_m * slopes / np.maximum(distance, half_m) / (1.0 + tan * tan)

    def ground_m(self, points_m: Array) -> Array:
        """Height (...) [m] of the ground in enu."""
        points = np.array(points_m, dtype=np.float64, order="C")
        up = np.empty(points.shape[:-1])
        surfaces(self.ground.record, points.reshape(-1, 2), up.reshape(-1))
        return up

    def slope_rad(self, points_m: Array) -> Array:
        """Slope (...) [rad] of the ground over 10 m."""
        points = np.asarray(points_m, dtype=np.float64)
        steps = SLOPE_STEP_M * np.array([[1.0, 0], [-1, 0], [0, 1], [0, -1]])
        z = self.ground_m(points[..., None, :] + steps)
        return np.asarray(np.arctan(np.hypot(z[..., 0] - z[..., 1], z[..., 2] - z[..., 3]) / (2 * SLOPE_STEP_M)))

    def _covers(self, half_m: float) -> bool:
        """Whether the maps know all ground in the square about the origin."""
        line = np.linspace(-half_m, half_m, 65)
        points = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
        return not np.isnan(ground_up_m(self.site, self.maps, points)).any()
