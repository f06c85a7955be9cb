"""Height maps as ground: the horizon traced exactly, with a table of bounds that is computed once and kept."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Self

import numpy as np

from startrack.core.types import Array, BadInput
from startrack.frames import Site
from startrack.terrain.ground import Ground, ground_up_m, pack_maps
from startrack.terrain.horizon_table import HorizonTable, Square
from startrack.terrain.protocol import Progress, Terrain
from startrack.terrain.raster import Projection, Raster
from startrack.terrain.table_cache import KeptTable
from startrack.terrain.tracing import Tracer

CELL_M = 200.0  # cells of the table are no wider
MAX_CELLS_ACROSS = 128
REACH_RADII = 1.15  # of the search radius: so far is searched, to notice that the camera left the area
SLOPE_STEP_M = 5.0


@dataclass(frozen=True, eq=False, kw_only=True)
class TracedMap(Terrain):
    """The surface that is bilinear between the posts of height maps, as true 3-D points on the Moon's sphere.

    tan H = max over s of (z(p + s u) - z(p) - camera height) / s, u the azimuth's direction. Where several maps cover
    a point the first holds. Raises BadInput bad_terrain if the maps do not cover the search area. See `Terrain`.
    """

    name: str = "height map"
    site: Site
    maps: tuple[Raster, ...]  # finest first
    files: tuple[Path, ...] = ()  # of them
    camera_height_m: float = 1.5
    search_radius_m: float = Terrain.search_radius_m
    finest_m = 0.45  # no height map is more accurate
    _uses_table = True  # traces begin at the horizon's distance of a table in memory

    def __post_init__(self) -> None:
        if not self.maps:
            raise BadInput("bad_terrain", "[dem] needs at least one map")
        if not self._covers(self.search_radius_m):
            area = f"the search area of {self.search_radius_m:.0f} m about the origin"
            raise BadInput("bad_terrain", f"the maps do not cover {area}, or have holes in it")

    @property
    def projection(self) -> Projection:  # type: ignore[override]
        """That of the finest map."""
        return self.maps[0].projection

    @cached_property
    def ground(self) -> Ground:
        """The maps packed for tracing."""
        return pack_maps(self.site, self.maps)

    @property
    def tracer(self) -> Tracer:
        """The compiled kernels on these maps."""
        return Tracer(self.ground, self.camera_height_m)

    @cached_property
    def finest_post_m(self) -> float:
        """Spacing of the posts of the finest map."""
        return min(m.post_m for m in self.maps)

    @cached_property
    def reach_m(self) -> float:
        """The search area and a margin, as far as the maps reach."""
        return (
            self.search_radius_m * REACH_RADII
            if self._covers(self.search_radius_m * REACH_RADII)
            else self.search_radius_m
        )

    @cached_property
    def square(self) -> Square:
        """The cells of the table."""
        across = 1
        while 2 * self.reach_m / across > CELL_M and across < MAX_CELLS_ACROSS:
            across *= 2
        return Square(self.reach_m, across)

    @cached_property
    def kept_table(self) -> KeptTable:
        """Where the table of horizons is kept."""
        return KeptTable(
            name=self.name, site=self.site, maps=self.maps, camera_height_m=self.camera_height_m,
            search_radius_m=self.search_radius_m, square=self.square,
        )  # fmt: skip

    @property
    def table_path(self) -> Path:  # type: ignore[override]
        """File of the table of horizons."""
        return self.kept_table.path

    @property
    def is_prepared(self) -> bool:
        """Whether the table of horizons is in memory or on disk."""
        return self.kept_table.in_memory is not None or self.table_path.is_file()

    def prepare(self, progress: Progress | None = None) -> None:
        """Have the table of horizons in memory: from the cache on disk, else computed and cached.

        If several processes need the same table, one computes it and the others wait.
        """
        if "table" not in self.__dict__:
            self.__dict__["table"] = self.kept_table.load_or_build(self.tracer, progress)

    @cached_property
    def table(self) -> HorizonTable:
        """The table of horizons; see `prepare`."""
        return self.kept_table.load_or_build(self.tracer)

    def discard_table(self) -> None:
        """Remove the table of horizons from memory and disk."""
        self.__dict__.pop("table", None)
        self.kept_table.discard()

    def without_table(self) -> Self:
        """The same map whose traces begin at the camera; see `Terrain`."""
        other = copy(self)
        other.__dict__["_uses_table"] = False
        return other

    def horizons(self, points_m: Array, azimuths_rad: Array) -> tuple[Array, Array, Array]:
        """tan, distance, and distance of the maps' end, (...) each, of the points (..., 2) at the azimuths (...)."""
        return self.tracer.horizons(self.kept_table.in_memory if self._uses_table else None, points_m, azimuths_rad)

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """Horizon elevation [rad], traced. See `Terrain`."""
        return np.arctan(self.horizons(points_m, azimuths_rad)[0])

    def horizon_bounds_rad(
        self, centres_m: Array, half_m: Array, azimuths_rad: Array, azimuth_half_rad: Array | float = 0.0
    ) -> tuple[Array, Array]:
        """Bounds of the horizon over boxes [rad]: from the table, and for single rays and small boxes by tracing."""
        return self.tracer.horizon_bounds_rad(self.table, centres_m, half_m, azimuths_rad, azimuth_half_rad)

    def horizon_spread_rad(self, points_m: Array, half_m: float, azimuths_rad: Array) -> tuple[Array, Array]:
        """From the horizon of the middle and its distance d: a move by `half_m` changes tan H by slopes half_m / d."""
        points = np.asarray(points_m, dtype=np.float64)
        tan, distance, _ = self.horizons(points, azimuths_rad)
        slopes = np.abs(tan) + np.tan(self.slope_rad(points))
        return np.arctan(tan), half_m * slopes / np.maximum(distance, half_m) / (1.0 + tan * tan)

    def ground_m(self, points_m: Array) -> Array:
        """Height of the ground in enu (...) [m]."""
        points = np.asarray(points_m, dtype=np.float64)
        return self.tracer.heights_m(points.reshape(-1, 2)).reshape(points.shape[:-1])

    def slope_rad(self, points_m: Array) -> Array:
        """Slope of the ground (...) over 10 m."""
        points = np.asarray(points_m, dtype=np.float64)
        steps = SLOPE_STEP_M * np.array([[1.0, 0], [-1, 0], [0, 1], [0, -1]])
        z = self.ground_m(points[..., None, :] + steps)
        return np.asarray(np.arctan(np.hypot(z[..., 0] - z[..., 1], z[..., 2] - z[..., 3]) / (2 * SLOPE_STEP_M)))

    def _covers(self, half_m: float) -> bool:
        """Whether the maps know all ground in the square about the origin."""
        line = np.linspace(-half_m, half_m, 65)
        points = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
        return not np.isnan(ground_up_m(self.site, self.maps, points)).any()
