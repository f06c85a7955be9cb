"""Height maps as terrain: the horizon traced exactly, with a table of bounds that is computed once and kept."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.core.types import Array, BadInput, Bools, Ints
from startrack.frames import Site
from startrack.terrain import table_cache as cache
from startrack.terrain import tracing
from startrack.terrain.deformed_map import DeformedMap, slopes_of_map
from startrack.terrain.horizon_interpolator import NODES_ACROSS, HorizonInterpolator
from startrack.terrain.horizon_posts import HorizonPosts, cell_posts, post_positions
from startrack.terrain.horizon_sigma import HorizonSigma
from startrack.terrain.horizon_table import BINS, HorizonTable, Square
from startrack.terrain.masks import GLARE, OFF_MAP, Sectors, describe_masks, in_sectors
from startrack.terrain.protocol import Progress, Terrain
from startrack.terrain.pyramid import Ground, ground_up_m, pack_maps
from startrack.terrain.raster import Projection, Raster
from startrack.terrain.shape import BIAS, CAMERA_ERROR, STRETCH, VERTICAL, ShapeError, by_name
from startrack.terrain.table_building import load_or_build_table

FINEST_BOX_M = 0.45  # half side of the smallest boxes of positions: no height map is more accurate
CELL_M = 200.0  # cells of the table are no wider
MAX_CELLS_ACROSS = 128
COMMON_PER_POST = 3.0
MARGIN = 1.15  # of the search radius: so far is searched, to notice that the camera left the area
SLOPE_STEP_M = 5.0


@dataclass(frozen=True, eq=False, kw_only=True)
class HeightMap(Terrain):
    """The surface that is bilinear between the posts of height maps, as true 3-D points on the Moon's sphere.

    tan H = max over s of (z(p + s u) - z(p) - camera height) / s, u the azimuth's direction. Where several maps cover
    a point the first holds. Raises BadInput bad_terrain if the maps do not cover the search area. See `Terrain`.
    """

    name: str = "height map"
    site: Site
    maps: tuple[Raster, ...]  # finest first
    camera_height_m: float = 1.5
    search_radius_m: float = 10_000.0
    height_sigma_m: float = 0.0  # of single posts, independent of each other
    horizon_sigma_common_rad: float | None = None  # of an error that all azimuths share; None: see common_sigma_rad
    stretch_sigma_1: float | None = 0.0  # of the factor of tan H, less 1; None: not stated, see `terrain.shape`
    vertical_sigma_rad: float | None = 0.0  # of a tilt of the whole map, of each of two axes
    camera_height_sigma_m: float | None = 0.0
    most_slope_rad: float = np.pi / 2  # a rover does not stand on steeper ground
    glare_rad: Sectors = ()  # lit by the Sun: no evidence there
    unstated_errors: tuple[str, ...] = ()
    finest_m = FINEST_BOX_M
    _uses_table = True  # traces begin at the horizon's distance of a table in memory

    def __post_init__(self) -> None:
        if not self.maps:
            raise BadInput("bad_terrain", "[dem] needs at least one map")
        if not self._covers(self.search_radius_m):
            area = f"the search area of {self.search_radius_m:.0f} m about the origin"
            raise BadInput("bad_terrain", f"the maps do not cover {area}, or have holes in it")

    @property
    def hard_edges(self) -> bool:  # type: ignore[override]
        """Whether single posts have no error: the horizon of a point is then exact, but for a common error."""
        return self.height_sigma_m == 0

    @property
    def projection(self) -> Projection:  # type: ignore[override]
        """That of the finest map."""
        return self.maps[0].projection

    @cached_property
    def ground(self) -> Ground:
        """The maps packed for tracing."""
        return pack_maps(list(self.maps), self.site)

    @cached_property
    def finest_post_m(self) -> float:
        """Spacing of the posts of the finest map."""
        return min(m.post_m for m in self.maps)

    @cached_property
    def common_sigma_rad(self) -> float:  # type: ignore[override]
        """Standard deviation [rad] of the error that all azimuths share, with that of the camera's own ground.

        If it is not known, three times the horizon's sigma from `height_sigma_m`: crests clipped by the grid of posts
        stand too low by some such amount all around.
        """
        if not self.height_sigma_m and not self.horizon_sigma_common_rad:
            return 0.0
        own = float(np.median(self._sigma.cells_rad[self._search_area_cells])) if self.height_sigma_m else 0.0
        known = self.horizon_sigma_common_rad
        return float(np.hypot(own, COMMON_PER_POST * own if known is None else known))

    @cached_property
    def shape_errors(self) -> tuple[ShapeError, ...]:  # type: ignore[override]
        """Bias, stretch, tilt of the vertical, and height of the camera. The bias needs the table of horizons."""
        return (
            *BIAS.shape_errors(self.common_sigma_rad), *STRETCH.shape_errors(self.stretch_sigma_1),
            *VERTICAL.shape_errors(self.vertical_sigma_rad), *CAMERA_ERROR.shape_errors(self.camera_height_sigma_m),
        )  # fmt: skip

    def shape_slopes_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """From the traced horizon and the distance of its crest; see `Terrain`."""
        tan, distance, _ = self.horizons(points_m, azimuths_rad)
        return slopes_of_map(self.shape_errors, tan, 1.0 / distance, azimuths_rad)

    def with_shape(self, values: Array) -> DeformedMap:
        """The ground with these errors; see `Terrain`."""
        return DeformedMap(self, **by_name(self.shape_errors, values))

    @cached_property
    def _search_area_cells(self) -> Bools:
        """Cells (n,) in the search area."""
        return np.asarray(np.hypot(*self.square.centres_m.T) < self.search_radius_m)

    @cached_property
    def reach_m(self) -> float:
        """The search area and a margin, as far as the maps reach."""
        return self.search_radius_m * MARGIN if self._covers(self.search_radius_m * MARGIN) else self.search_radius_m

    @cached_property
    def square(self) -> Square:
        """The cells of the table."""
        across = 1
        while 2 * self.reach_m / across > CELL_M and across < MAX_CELLS_ACROSS:
            across *= 2
        return Square(self.reach_m, across)

    @cached_property
    def _key(self) -> str:
        return cache.key_of(self)

    @property
    def table_path(self) -> Path:  # type: ignore[override]
        """File of the table of horizons."""
        return cache.path_of(self._key)

    @property
    def is_prepared(self) -> bool:
        """Whether the table of horizons is in memory or on disk."""
        return self._key in cache.TABLES_IN_MEMORY or self.table_path.is_file()

    def prepare(self, progress: Progress | None = None) -> None:
        """Have the table of horizons in memory: from the cache on disk, else computed and cached.

        If several processes need the same table, one computes it and the others wait.
        """
        if "table" not in self.__dict__:
            self.__dict__["table"] = load_or_build_table(self, self._key, progress)

    @cached_property
    def table(self) -> HorizonTable:
        """The table of horizons; see `prepare`."""
        return load_or_build_table(self, self._key)

    def discard_table(self) -> None:
        """Remove the table of horizons from memory and disk."""
        self.__dict__.pop("table", None)
        self.__dict__.pop("_sigma", None)
        cache.discard_table(self._key)

    def without_table(self) -> HeightMap:
        """The same map whose traces begin at the camera; see `Terrain`."""
        other = copy(self)
        other.__dict__["_uses_table"] = False
        return other

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """Horizon elevation [rad], traced. See `Terrain`."""
        return np.arctan(self.horizons(points_m, azimuths_rad)[0])

    def horizon_bounds_rad(
        self, centres_m: Array, half_m: Array, azimuths_rad: Array, azimuth_half_rad: Array | float = 0.0
    ) -> tuple[Array, Array]:
        """Bounds of the horizon over boxes [rad]: from the table, and for single rays and small boxes by tracing."""
        return tracing.bound_horizons(self, self.table, centres_m, half_m, azimuths_rad, azimuth_half_rad)

    def horizon_sigma_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """From the height of the single post that makes the horizon: sigma cos^2 H / its distance."""
        if self.height_sigma_m == 0:
            return np.zeros(np.broadcast_shapes(np.shape(points_m)[:-1], np.shape(azimuths_rad)))
        return self._sigma.sigma_rad(points_m, azimuths_rad)

    def horizon_spread_rad(self, points_m: Array, half_m: float, azimuths_rad: Array) -> tuple[Array, Array]:
        """From the horizon of the middle and its distance d: a move by `half_m` changes tan H by slopes half_m / d."""
        points = np.asarray(points_m, dtype=np.float64)
        tan, distance, _ = self.horizons(points, azimuths_rad)
        slopes = np.abs(tan) + np.tan(self.slope_rad(points))
        return np.arctan(tan), half_m * slopes / np.maximum(distance, half_m) / (1.0 + tan * tan)

    def max_horizon_sigma_rad(
        self, centres_m: Array, half_m: float, azimuths_rad: Array, azimuth_half_rad: float
    ) -> Array:
        """The largest `horizon_sigma_rad` (n,) over boxes and azimuths."""
        if self.height_sigma_m == 0:
            return np.zeros(np.broadcast_shapes(np.shape(centres_m)[:-1], np.shape(azimuths_rad)))
        return self._sigma.max_sigma_rad(centres_m, half_m, azimuths_rad, azimuth_half_rad)

    @cached_property
    def _sigma(self) -> HorizonSigma:
        return HorizonSigma(self.table, self.height_sigma_m)

    def ground_m(self, points_m: Array) -> Array:
        """Height of the ground in enu (...) [m]."""
        points = np.asarray(points_m, dtype=np.float64)
        return tracing.ground_heights(self, points.reshape(-1, 2)).reshape(points.shape[:-1])

    def allowed(self, points_m: Array) -> Bools:
        """Whether the points (..., 2) are within reach and not too steep."""
        points = np.asarray(points_m)
        inside = np.hypot(points[..., 0], points[..., 1]) <= self.reach_m
        if self.most_slope_rad >= np.pi / 2:
            return np.asarray(inside)
        return np.asarray(inside & (self.slope_rad(points) <= self.most_slope_rad))

    def slope_rad(self, points_m: Array) -> Array:
        """Slope of the ground (...) over 10 m."""
        points = np.asarray(points_m, dtype=np.float64)
        steps = SLOPE_STEP_M * np.array([[1.0, 0], [-1, 0], [0, 1], [0, -1]])
        z = self.ground_m(points[..., None, :] + steps)
        return np.asarray(np.arctan(np.hypot(z[..., 0] - z[..., 1], z[..., 2] - z[..., 3]) / (2 * SLOPE_STEP_M)))

    def is_informative(self, azimuths_rad: Array, elevations_rad: Array) -> Bools:
        """Whether the map decides if the rays (...) are visible: outside glare, and above unmapped ground."""
        azimuths = np.asarray(azimuths_rad) % (2 * np.pi)
        b = (azimuths / (2 * np.pi) * BINS).astype(np.int64) % BINS
        above = np.asarray(elevations_rad) > self.unknown_rad[b]
        return np.asarray(above & ~in_sectors(azimuths, self.glare_rad))

    @property
    def unknown_rad(self) -> Array:
        """(n,) of n sectors from north eastward: below which elevation ground off the maps may stand, or -pi/2."""
        return self.table.unknown_rad

    def mask_reason(self, azimuths_rad: Array, elevations_rad: Array) -> NDArray[np.str_]:
        """Why rays (n,) are not informative; empty where they are."""
        reason = np.where(self.is_informative(azimuths_rad, elevations_rad), "", OFF_MAP)
        return np.where((reason != "") & in_sectors(azimuths_rad, self.glare_rad), GLARE, reason)

    def masked_sectors(self) -> list[str]:
        """One line of text per range of azimuths that is not informative."""
        return describe_masks(self.glare_rad, self.unknown_rad)

    def facts(self) -> dict[str, Any]:
        """Facts about the maps and their errors, as JSON values."""
        common = self.horizon_sigma_common_rad
        return {
            "kind": "dem",
            "maps": [raster.facts() for raster in self.maps],
            "height_sigma_m": self.height_sigma_m,
            "horizon_sigma_deg": None if common is None else round(float(np.degrees(common)), 6),
            "horizons": str(self.table_path),
            "horizons_ready": self.table_path.is_file(),
        }

    def near(self, centre_m: Array, half_m: float, azimuths_rad: Array, across: int = NODES_ACROSS) -> Terrain:
        """The ground near a centre (2,), see `HorizonInterpolator`."""
        centre = np.asarray(centre_m, dtype=np.float64)
        return HorizonInterpolator(self, centre, half_m, np.unique(azimuths_rad), across)

    def horizon_posts(self, point_m: Array, azimuths_rad: Array) -> HorizonPosts:
        """The posts about the crests seen from `point_m`; see `Terrain`."""
        tan, distance, _ = self.horizons(point_m, azimuths_rad)
        away = distance[:, None] * np.stack([np.sin(azimuths_rad), np.cos(azimuths_rad)], axis=1)
        up = float(self.ground_m(point_m)) + self.camera_height_m + tan * distance
        post, weight = cell_posts(self.site, self.maps, np.column_stack([point_m + away, up]))
        return HorizonPosts(post, weight / ((1.0 + tan * tan) * distance)[:, None], np.arctan(tan))

    def ground_posts(self, point_m: Array, azimuths_rad: Array) -> HorizonPosts:
        """The posts about a camera at `point_m`; see `Terrain`."""
        tan, distance, _ = self.horizons(point_m, azimuths_rad)
        post, weight = cell_posts(self.site, self.maps, np.append(point_m, self.ground_m(point_m))[None])
        weights = -weight / ((1.0 + tan * tan) * distance)[:, None]
        return HorizonPosts(np.repeat(post, len(tan), axis=0), weights, np.arctan(tan))

    def post_positions_m(self, posts: Ints) -> Array:
        """See `Terrain`."""
        return post_positions(self.site, self.maps, posts)

    def horizons(self, points_m: Array, azimuths_rad: Array) -> tuple[Array, Array, Array]:
        """tan, distance, and distance of the maps' end, of each point and azimuth."""
        shape = np.broadcast_shapes(np.shape(points_m)[:-1], np.shape(azimuths_rad))
        points = tracing.flatten(points_m, (*shape, 2)).reshape(-1, 2)
        table = cache.TABLES_IN_MEMORY.get(self._key) if self._uses_table else None
        found = tracing.trace_horizons(self, table, points, tracing.flatten(azimuths_rad, shape).ravel())
        return tuple(a.reshape(shape) for a in found)  # type: ignore[return-value]

    def _covers(self, half_m: float) -> bool:
        """Whether the maps know all ground in the square about the origin."""
        line = np.linspace(-half_m, half_m, 65)
        points = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
        return not np.isnan(ground_up_m(self.site, list(self.maps), points)).any()
