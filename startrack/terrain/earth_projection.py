"""By pyproj: projections of maps of the Earth (longitude and latitude of WGS 84 without it), and grids of the geoid."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property, lru_cache
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from startrack.core.errors import how_to_install, length_text
from startrack.core.types import Array, BadInput
from startrack.frames import EARTH_RADIUS_M, Site, latlon_from_enu

if TYPE_CHECKING:
    import pyproj

WGS84_CODE = 4326
EARTH_RADII_M = 6_300_000.0, 6_450_000.0  # semi-major axes of all ellipsoids that maps of the Earth are on
FOOT_M = 0.3048
SCALE_STEP_M = 100.0  # over which the scale of a map is measured
UNNAMED = "unnamed", "unknown"  # names that decoders give
BASE_M = 10_000.0  # from the site to the points that give the slope: the grids have posts every 2 to 30 km
AREA_DEG = 1.0  # about a place, for the choice of a datum's transformation


@dataclass(frozen=True, kw_only=True)
class EarthProjection:
    """x to the east and y to the north in the units of a reference system, from geodetic places of WGS 84.

    Where datums differ, PROJ's best transformation about the place `near` is taken; `transformation_warning` says what
    it lacks.
    """

    wkt: str = ""  # of the reference system, horizontal; "": longitude and latitude of WGS 84 in degrees
    near: tuple[float, float] = (0.0, 0.0)  # latitude and longitude [rad] of the map
    middle_x: float | None = 0.0  # of the map, where x is a longitude in degrees: counted to half a turn from here
    body = "earth"

    @property
    def name(self) -> str:
        """Of the reference system, for people."""
        return _name_of(self.wkt) if self.wkt else "WGS 84 longitude and latitude"

    @property
    def crs(self) -> pyproj.CRS:
        """The reference system."""
        return reference_system(self.wkt)

    def units_per_m(self, latitude_rad: float) -> tuple[float, float]:
        """Map units of a metre on the ground along x and y at `latitude_rad`; of projected maps near their middle."""
        lat, lon = (latitude_rad, 0.0) if self.middle_x is not None else self.near
        step = SCALE_STEP_M / EARTH_RADIUS_M
        x, y = self.xy_from_latlon(
            np.array([lat, lat, lat + step]), lon + step / np.cos(lat) * np.array([0.0, 1.0, 0.0])
        )
        return float(np.hypot(x[1] - x[0], y[1] - y[0]) / SCALE_STEP_M), float(
            np.hypot(x[2] - x[0], y[2] - y[0]) / SCALE_STEP_M
        )

    def xy_from_latlon(self, latitude_rad: ArrayLike, longitude_rad: ArrayLike) -> tuple[Array, Array]:
        """Map coordinates x, y (...) of places at `latitude_rad` and `longitude_rad` (...); not finite out of reach."""
        lon, lat = np.broadcast_arrays(np.degrees(longitude_rad), np.degrees(latitude_rad))
        x, y = self._transformation[0].transform(lon, lat) if self.wkt else (lon, lat)
        x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
        if self.middle_x is not None:
            x = self.middle_x + (x - self.middle_x + 180.0) % 360.0 - 180.0
        return x, y

    def latlon_from_xy(self, x: ArrayLike, y: ArrayLike) -> tuple[Array, Array]:
        """Latitude and longitude (...) [rad], the longitude in [-pi, pi); inverse of xy_from_latlon."""
        lon, lat = np.broadcast_arrays(np.asarray(x, dtype=float), np.asarray(y, dtype=float))
        if self.wkt:
            lon, lat = self._transformation[0].transform(lon, lat, direction="INVERSE")
        return np.radians(lat), (np.radians(lon) + np.pi) % (2 * np.pi) - np.pi

    @property
    def transformation_warning(self) -> str:
        """What is not known of the shift from the map's datum to WGS 84; empty where PROJ has all that it needs."""
        return self._transformation[1] if self.wkt else ""

    @cached_property
    def _transformation(self) -> tuple[pyproj.Transformer, str]:
        return _best_transformation(self.wkt, *(round(float(np.degrees(angle))) for angle in self.near))


def is_earth(semi_major_m: float) -> bool:
    """Whether an ellipsoid with this semi-major axis [m] is of the Earth."""
    return EARTH_RADII_M[0] < semi_major_m < EARTH_RADII_M[1]


def reference_system(wkt: str) -> pyproj.CRS:
    """The reference system of a text that PROJ reads. Raises BadInput bad_terrain without pyproj."""
    if find_spec("pyproj") is None:
        raise BadInput(
            "bad_terrain",
            f"maps of the Earth that are not in longitude and latitude of WGS 84 need pyproj: {how_to_install('dem')}",
        )
    return _read_reference_system(wkt)


@lru_cache(maxsize=32)
def _read_reference_system(wkt: str) -> pyproj.CRS:
    import pyproj

    return pyproj.CRS.from_user_input(wkt)


@lru_cache(maxsize=32)
def _name_of(wkt: str) -> str:
    crs = reference_system(wkt)
    known = crs.to_authority(min_confidence=25) if crs.name in UNNAMED else None
    return str(crs.name if known is None else reference_system(":".join(known)).name)


def project_earth(crs: pyproj.CRS, middle_xy: tuple[float, float], near: tuple[float, float] | None) -> EarthProjection:
    """The projection of a map of the Earth, with its middle, near a latitude and longitude [rad].

    Raises BadInput bad_terrain for a system without a horizontal part in degrees or lengths.
    """
    horizontal = crs.sub_crs_list[0] if crs.is_compound else crs
    horizontal = horizontal if horizontal.is_bound else horizontal.to_2d()
    if not (horizontal.is_geographic or horizontal.is_projected):
        raise BadInput("bad_terrain", f"maps in the reference system {crs.name!r} are not known: gdalwarp them to UTM")
    if horizontal.is_geographic and abs(np.radians(1.0) / horizontal.axis_info[0].unit_conversion_factor - 1.0) > 1e-9:
        raise BadInput("bad_terrain", f"{crs.name!r} counts angles in {horizontal.axis_info[0].unit_name}, not degrees")
    middle_x = middle_xy[0] if horizontal.is_geographic else None
    if horizontal.is_geographic and horizontal.equals(f"EPSG:{WGS84_CODE}", ignore_axis_order=True):
        return EarthProjection(middle_x=middle_x)
    wkt = horizontal.to_wkt()
    if near is None:
        latitude, longitude = EarthProjection(wkt=wkt, middle_x=middle_x).latlon_from_xy(*middle_xy)
        near = float(latitude), float(longitude)
    return EarthProjection(wkt=wkt, near=near, middle_x=middle_x)


@lru_cache(maxsize=32)
def _best_transformation(wkt: str, latitude_deg: int, longitude_deg: int) -> tuple[pyproj.Transformer, str]:
    """PROJ's best transformation from WGS 84 that it has the grids for, and a warning if there is a better one."""
    from pyproj.transformer import AreaOfInterest, TransformerGroup

    south, north = np.clip([latitude_deg - AREA_DEG, latitude_deg + AREA_DEG], -90.0, 90.0)
    west, east = longitude_deg - AREA_DEG, longitude_deg + AREA_DEG
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of grids that are missing: it is said here
        group = TransformerGroup(
            WGS84_CODE, reference_system(wkt), always_xy=True, area_of_interest=AreaOfInterest(west, south, east, north)
        )
    if not group.transformers:
        raise BadInput("bad_terrain", f"PROJ has no transformation from WGS 84 to {_name_of(wkt)}")
    return group.transformers[0], _lacking(group, _name_of(wkt))


def _lacking(group: Any, name: str) -> str:
    """One line on the transformations of `group` if the best is not there or not known."""
    accuracy = group.transformers[0].accuracy
    known = "with an unknown accuracy, perhaps 100 m" if accuracy < 0 else f"to {length_text(accuracy)}"
    if group.best_available and accuracy >= 0:
        return ""
    text = f"its shift from {name} to WGS 84 is known {known}: positions in latitude and longitude are as wrong"
    better = [one for one in group.unavailable_operations if one.accuracy >= 0]
    if better:
        best = min(better, key=lambda one: one.accuracy)
        grids = ", ".join(grid.short_name for grid in best.grids if not grid.available)
        text += f"; PROJ's grid {grids} gives {length_text(best.accuracy)} (projsync --file {grids})"
    return text


ELLIPSOID = "ellipsoid"  # in place of a grid of the geoid: heights are above the ellipsoid


class Geoid(NamedTuple):
    """The geoid above the ellipsoid: its height at a site, and how it rises there to the east and to the north."""

    height_m: float
    slope_arcsec: tuple[float, float]


def geoid_at(grid: str, site: Site) -> Geoid:
    """The geoid at a `site` on the Earth by a `grid`: a name that PROJ finds, or the path of a GTX or GeoTIFF grid.

    Raises BadInput (bad_terrain) where PROJ has no such grid, or it does not reach the site.
    """
    if find_spec("pyproj") is None:
        raise BadInput("bad_terrain", f"grids of the geoid need pyproj: {how_to_install('dem')}")
    from pyproj import Transformer
    from pyproj.exceptions import ProjError

    try:
        shift = Transformer.from_pipeline(f"+proj=vgridshift +grids={grid} +multiplier=1")
    except ProjError as cause:
        advice = f"projsync --file {grid} fetches those of PROJ"
        raise BadInput("bad_terrain", f"{grid}: PROJ finds no such grid of the geoid: {advice}") from cause
    east_m, north_m = BASE_M * np.array([[0, -1, 1, 0, 0], [0, 0, 0, -1, 1]])
    latitude, longitude = latlon_from_enu(site, east_m, north_m, np.zeros(5))
    here, west, east, south, north = shift.transform(longitude, latitude, np.zeros(5), radians=True)[2]
    if not np.isfinite([here, west, east, south, north]).all():
        raise BadInput("bad_terrain", f"{grid}: this grid of the geoid does not reach the origin")
    slope = np.degrees(np.arctan([(east - west) / (2 * BASE_M), (north - south) / (2 * BASE_M)])) * 3600.0
    return Geoid(float(here), (float(slope[0]), float(slope[1])))
