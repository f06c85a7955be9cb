"""Height maps as terrain: traced ground, the errors of its horizon, and azimuths that give no evidence."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.core.types import Array, Bools
from startrack.terrain import shape
from startrack.terrain.derived_maps import DeformedMap, HorizonInterpolator
from startrack.terrain.horizon_table import AZIMUTH_BINS
from startrack.terrain.map_ends import (
    GLARE,
    OFF_MAP,
    Sectors,
    are_in_sectors,
    describe_masks,
    facts_of_ends,
    unknown_elevations_rad,
)
from startrack.terrain.map_errors import MapErrors
from startrack.terrain.protocol import Terrain, with_refraction_error
from startrack.terrain.table_cache import load_table
from startrack.terrain.traced_map import TracedMap


@dataclass(frozen=True, eq=False, kw_only=True)
class HeightMap(TracedMap):
    """Height maps and what is stated of their errors: see `TracedMap` for the ground, `Terrain` for the methods."""

    height_sigma_m: float = 0.0  # of single posts, independent of each other
    horizon_sigma_common_rad: float | None = None  # of an error that all azimuths share; None: see `MapErrors`
    stretch_sigma_1: float | None = shape.EXACT  # of the factor of tan H, less 1; None: not stated, see `terrain.shape`
    vertical_sigma_rad: float | None = shape.EXACT  # of a tilt of the whole map, of each of two axes
    waves_sigma_rad: tuple[float, ...] | None = shape.EXACT_WAVES  # of waves 1 to 8 of the horizon's error over azimuth
    map_offset_sigma_m: float | None = shape.EXACT  # of the heights of each further map against the first one
    camera_height_sigma_m: float | None = shape.EXACT
    terrestrial_refraction_sigma_1: float | None = shape.EXACT
    most_slope_rad: float = np.pi / 2  # a rover does not stand on steeper ground
    glare_rad: Sectors = ()  # lit by the Sun: no evidence there
    height_sigma_is_stated: bool = True  # else it counts as 0, with a warning

    @cached_property
    def errors(self) -> MapErrors:  # type: ignore[override]
        """Errors of the maps, stated or usual, by a copy's horizons: a circle would keep the maps in memory."""
        return MapErrors(self.changed(ground=self.ground))

    def with_shape(self, values: Array) -> Terrain:
        """Ground with the errors `values` (n,), in the order of `errors.shape`; see `Terrain`."""
        errors = shape.errors_by_name(self.errors.shape, values)
        offsets_m = [errors.pop(name, 0.0) for name in shape.offset_names(len(self.maps))]
        refraction_1 = errors.pop("refraction_1", 0.0)
        whole = self
        if any(offsets_m):
            risen = zip(self.maps, [0.0, *offsets_m], strict=True)
            maps = (replace(one, heights_m=one.heights_m + np.float32(rise)) for one, rise in risen)
            whole = replace(self, maps=tuple(maps))
        return with_refraction_error(DeformedMap(whole, **errors), refraction_1)

    def discard_table(self) -> None:
        """Remove the table of horizons from memory and disk."""
        super().discard_table()
        self.__dict__.pop("errors", None)

    def allowed(self, points_m: Array) -> Bools:
        """Whether the points (..., 2) are within reach and not too steep."""
        inside = super().allowed(np.asarray(points_m))
        if self.most_slope_rad >= np.pi / 2:
            return inside
        return np.asarray(inside & (self.slope_rad(points_m) <= self.most_slope_rad))

    def is_informative(self, azimuths_rad: Array, elevations_rad: Array) -> Bools:
        """Whether the map decides if the rays (...) are visible: outside glare, and above unmapped ground."""
        self.prepare()  # which knows them
        above = np.asarray(elevations_rad) > self.unknown_below_rad(azimuths_rad)
        return np.asarray(above & ~are_in_sectors(azimuths_rad, self.glare_rad))

    def unknown_below_rad(self, azimuths_rad: Array) -> Array:
        """Elevation (...) [rad] below which ground off the maps could stand: the same from all of the search area."""
        b = np.floor(np.asarray(azimuths_rad) / (2 * np.pi) * AZIMUTH_BINS).astype(np.int64) % AZIMUTH_BINS
        return np.asarray(self.unknown_rad[b])

    def mask_reason(self, azimuths_rad: Array, elevations_rad: Array) -> NDArray[np.str_]:
        """Reason (n,) why rays (n,) are not informative: glare, or off the map; empty where they are."""
        reason = np.where(self.is_informative(azimuths_rad, elevations_rad), "", OFF_MAP)
        return np.where((reason != "") & are_in_sectors(azimuths_rad, self.glare_rad), GLARE, reason)

    def warnings(self) -> list[str]:
        """Warnings: a line per range of azimuths that is not informative, and those of the map's errors."""
        return [*describe_masks(self.glare_rad, self.unknown_rad), *self.errors.warnings()]

    @cached_property
    def unknown_rad(self) -> Array:
        """Elevation (AZIMUTH_BINS,) [rad] below which ground off the maps could stand, or -pi/2; needs no table."""
        table = load_table(self.table_key, self.square)
        return unknown_elevations_rad(self) if table is None else table.unknown_rad

    def facts(self) -> dict[str, Any]:
        """Facts about the maps and their errors, as JSON values."""
        common = self.horizon_sigma_common_rad
        return {
            "kind": "dem",
            "maps": [raster.facts() for raster in self.maps],
            "maps_end": facts_of_ends(self, self.unknown_rad),
            "height_sigma_m": self.height_sigma_m,
            "horizon_sigma_deg": None if common is None else round(float(np.degrees(common)), 6),
            "horizons": str(self.table_path),
            "horizons_ready": self.table_path.is_file(),
        }

    def near(self, centre_m: Array, half_m: float, azimuths_rad: Array, across: int = 3) -> Terrain:
        """Terrain near a centre (2,) [m] with horizons interpolated between traced nodes, see `HorizonInterpolator`."""
        centre = np.asarray(centre_m, dtype=np.float64)
        return HorizonInterpolator(self, centre, half_m, np.unique(azimuths_rad), across)
