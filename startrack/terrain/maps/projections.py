"""Projections of maps: of the Moon by formulas, of the Earth by pyproj."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from startrack.core.errors import how_to_install, length_text
from startrack.core.types import Array, BadInput
from startrack.frames import EARTH_RADIUS_M, MOON_RADIUS_M, R_enu_fixed, Site

if TYPE_CHECKING:
    import pyproj

STEREOGRAPHIC, ORTHOGRAPHIC, EQUIRECTANGULAR = 0, 1, 2
PROJECTION_NAMES = ("stereographic", "orthographic", "equirectangular")
MAX_NUMBER = 1e12  # of a map's place, spacing and projection: squares of larger ones, and of their inverse, overflow
RADIUS_TOLERANCE_M = 50.0  # maps name 1737.4 km or, rarely, 1737.4 with other digits; Mars and the Earth are far away
WGS84_CODE = 4326
EARTH_RADII_M = 6_300_000.0, 6_450_000.0  # semi-major axes of all ellipsoids that maps of the Earth are on
FOOT_M = 0.3048
SCALE_STEP_M = 100.0  # over which the scale of a map is measured
UNNAMED = "unnamed", "unknown"  # names that decoders give
AREA_DEG = 1.0  # about a place, for the choice of a datum's transformation


@dataclass(frozen=True, kw_only=True)
class Projection:
    """A projection of the Moon's sphere: x to the east and y to the north at the centre [m].

    stereographic: (x, y) = 2 R scale (v1, v2) / (1 + v3); orthographic: (x, y) = R scale (v1, v2), v the direction in
    the frame east, north, up of the centre. equirectangular: (x, y) = R (scale longitude', scale_y latitude), the
    longitude counted from the centre's. About a pole, "north" is the centre longitude's side: x = rho sin(lon - lon0).
    """

    kind: int
    latitude_rad: float = 0.0
    longitude_rad: float = 0.0
    scale: float = 1.0  # along x, at the centre
    scale_y: float = 1.0  # equirectangular only
    false_x_m: float = 0.0
    false_y_m: float = 0.0
    radius_m: float = MOON_RADIUS_M
    body = "moon"
    wkt = ""  # the fields say all
    transformation_warning = ""  # of the shift to the datum of sites

    def __post_init__(self) -> None:
        numbers = (self.latitude_rad, self.longitude_rad, self.scale, self.scale_y, self.false_x_m, self.false_y_m)
        small, large = min(self.scale, self.scale_y) < 1 / MAX_NUMBER, max(map(abs, numbers)) > MAX_NUMBER
        if small or large or not np.isfinite(numbers).all() or abs(self.latitude_rad) > 1.6:
            raise BadInput("bad_terrain", f"the map's projection has impossible numbers: {numbers}")
        if not abs(self.radius_m - MOON_RADIUS_M) <= RADIUS_TOLERANCE_M:
            raise BadInput(
                "bad_terrain",
                f"the map is of a body of {self.radius_m / 1000:.1f} km radius, not the Moon's 1737.4 km sphere",
            )

    @property
    def name(self) -> str:
        """Name of the projection, for people."""
        return PROJECTION_NAMES[self.kind]

    def units_per_m(self, latitude_rad: float) -> tuple[float, float]:
        """Map units of a metre on the ground along x and y at `latitude_rad`; of azimuthal maps at the centre."""
        if self.kind == EQUIRECTANGULAR:
            return self.scale / float(np.cos(latitude_rad)), self.scale_y
        return self.scale, self.scale

    def centred_at(self, x_m: float) -> Projection:
        """Copy with the same coordinates, whose longitudes count to half a turn from `x_m`; of equirectangular maps."""
        turned = (x_m - self.false_x_m) / (self.radius_m * self.scale)
        return replace(self, longitude_rad=self.longitude_rad + turned, false_x_m=x_m)

    @property
    def proj_text(self) -> str:
        """Text of the projection for PROJ; degrees are those of a map whose longitudes count from 0."""
        if self.is_in_degrees:
            return f"+proj=longlat +R={self.radius_m!r} +no_defs"
        latitude, longitude = (float(np.degrees(angle)) for angle in (self.latitude_rad, self.longitude_rad))
        place = f"+lat_0={latitude!r} +k_0={self.scale!r}"
        if self.kind == EQUIRECTANGULAR:
            place = f"+lat_ts={float(np.degrees(np.arccos(self.scale)))!r}"
        false = f"+x_0={self.false_x_m!r} +y_0={self.false_y_m!r}"
        name = {STEREOGRAPHIC: "stere", ORTHOGRAPHIC: "ortho", EQUIRECTANGULAR: "eqc"}[self.kind]
        return f"+proj={name} {place} +lon_0={longitude!r} {false} +R={self.radius_m!r} +units=m +no_defs"

    @property
    def is_in_degrees(self) -> bool:
        """Whether x and y are longitude and latitude themselves."""
        return self.kind == EQUIRECTANGULAR and self.scale_y != 1.0

    @property
    def R_projection_fixed(self) -> Array:
        """Rotation (3, 3) from the body-fixed frame to the frame in which the projection's formula is written."""
        if self.kind == EQUIRECTANGULAR:
            s, c = np.sin(self.longitude_rad), np.cos(self.longitude_rad)
            return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        return R_enu_fixed(Site("moon", self.latitude_rad, self.longitude_rad))

    def xy_from_latlon(self, latitude_rad: ArrayLike, longitude_rad: ArrayLike) -> tuple[Array, Array]:
        """Map coordinates x, y (...) [m] of places at `latitude_rad` and `longitude_rad` (...).

        They are not finite where the projection does not reach.
        """
        lat, lon = np.asarray(latitude_rad, dtype=float), np.asarray(longitude_rad, dtype=float)
        fixed = np.stack(np.broadcast_arrays(np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)), -1)
        v = fixed @ self.R_projection_fixed.T
        size = self.radius_m * self.scale
        if self.kind == EQUIRECTANGULAR:
            x = size * np.arctan2(v[..., 1], v[..., 0])
            y = self.radius_m * self.scale_y * np.arctan2(v[..., 2], np.hypot(v[..., 0], v[..., 1]))
        else:
            with np.errstate(divide="ignore", invalid="ignore"):  # not finite at the antipode
                k = 2 * size / (1 + v[..., 2]) if self.kind == STEREOGRAPHIC else size
                x, y = k * v[..., 0], k * v[..., 1]
        return x + self.false_x_m, y + self.false_y_m

    def latlon_from_xy(self, x_m: ArrayLike, y_m: ArrayLike) -> tuple[Array, Array]:
        """Latitude and longitude (...) [rad] of map coordinates `x_m`, `y_m` (...); inverse of xy_from_latlon."""
        x = (np.asarray(x_m, dtype=float) - self.false_x_m) / (self.radius_m * self.scale)
        if self.kind == EQUIRECTANGULAR:
            y = (np.asarray(y_m, dtype=float) - self.false_y_m) / (self.radius_m * self.scale_y)
            lat, lon = np.broadcast_arrays(y, x)
            return lat, (lon + self.longitude_rad + np.pi) % (2 * np.pi) - np.pi
        y = (np.asarray(y_m, dtype=float) - self.false_y_m) / (self.radius_m * self.scale)
        r2 = x * x + y * y
        if self.kind == STEREOGRAPHIC:
            up = (4 - r2) / (4 + r2)
            k = (1 + up) / 2
        else:
            up = np.sqrt(np.maximum(1 - r2, 0.0))
            k = np.ones_like(up)
        v = np.stack(np.broadcast_arrays(k * x, k * y, up), -1)
        fixed = v @ self.R_projection_fixed
        lat = np.arctan2(fixed[..., 2], np.hypot(fixed[..., 0], fixed[..., 1]))
        return lat, np.arctan2(fixed[..., 1], fixed[..., 0])


def projection_of(p: Mapping[str, Any]) -> Projection:
    """Projection of the Moon with PROJ's parameters `p`. Raises BadInput bad_terrain for one that is not known here."""
    radius = float(p.get("R", p.get("a", MOON_RADIUS_M)))
    if is_earth(radius) or str(p.get("ellps", p.get("datum", ""))).upper() in ("WGS84", "GRS80"):
        raise BadInput("bad_terrain", "the map is of the Earth, not of the Moon")
    if "a" in p and "b" in p and abs(float(p["a"]) - float(p["b"])) > 1:
        raise BadInput("bad_terrain", "the map is on an ellipsoid, not on the Moon's 1737.4 km sphere")
    meridian = p.get("pm", 0.0)
    if not isinstance(meridian, int | float):
        raise BadInput("bad_terrain", f"the map counts longitudes from {meridian}: bring it to the body's (gdalwarp)")
    common = {
        "longitude_rad": float(np.radians(float(p.get("lon_0", 0.0)) + meridian)), "radius_m": radius,
        "false_x_m": float(p.get("x_0", 0.0)), "false_y_m": float(p.get("y_0", 0.0)),
    }  # fmt: skip
    name, lat_0 = p.get("proj"), float(p.get("lat_0", 0.0))
    if name == "stere":
        scale = float(p.get("k_0", p.get("k", 1.0)))
        if "lat_ts" in p:
            scale = (1 + np.sin(np.radians(abs(float(p["lat_ts"]))))) / 2
        return Projection(kind=STEREOGRAPHIC, latitude_rad=float(np.radians(lat_0)), scale=float(scale), **common)
    if name == "ortho":
        return Projection(kind=ORTHOGRAPHIC, latitude_rad=float(np.radians(lat_0)), **common)
    if name == "eqc":
        scale = float(np.cos(np.radians(float(p.get("lat_ts", 0.0)))))
        common["false_y_m"] -= radius * float(np.radians(lat_0))
        return Projection(kind=EQUIRECTANGULAR, scale=scale, **common)
    if name == "longlat":
        degrees = float(180 / np.pi / radius)
        return Projection(kind=EQUIRECTANGULAR, scale=degrees, scale_y=degrees, **common)
    raise BadInput(
        "bad_terrain",
        f"projection {name!r} is not known: bring the map to polar stereographic, stereographic, orthographic or "
        "equirectangular (gdalwarp -r bilinear -t_srs ...)",
    )


@dataclass(frozen=True, kw_only=True)
class EarthProjection:
    """A projection of the Earth: from places of WGS 84 to x to the east and y to the north in a system's units.

    Where datums differ, PROJ's best transformation about the place `near` is taken; `transformation_warning` says what
    it lacks.
    """

    wkt: str = ""  # of the reference system, horizontal; "": longitude and latitude of WGS 84 in degrees
    near: tuple[float, float] = (0.0, 0.0)  # latitude and longitude [rad] of the map
    middle_x: float | None = 0.0  # of the map, where x is a longitude in degrees: counted to half a turn from here
    body = "earth"

    @property
    def name(self) -> str:
        """Name of the reference system, for people."""
        return _name_of(self.wkt) if self.wkt else "WGS 84 longitude and latitude"

    @property
    def crs(self) -> pyproj.CRS:
        """Reference system of the map."""
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
        """Warning of an unknown shift from the map's datum to WGS 84; empty where PROJ has all that it needs."""
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
    """Warning that the best transformation of a `group` is not there or not known; empty otherwise."""
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
