"""Map projections of the Moon: stereographic, orthographic, equirectangular, and longitude and latitude."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from startrack.core.types import Array, BadInput
from startrack.frames import MOON_RADIUS_M, R_enu_fixed, Site
from startrack.terrain.earth_projection import is_earth

STEREOGRAPHIC, ORTHOGRAPHIC, EQUIRECTANGULAR = 0, 1, 2
PROJECTION_NAMES = ("stereographic", "orthographic", "equirectangular")
MAX_NUMBER = 1e12  # of a map's place, spacing and projection: squares of larger ones, and of their inverse, overflow
RADIUS_TOLERANCE_M = 50.0  # maps name 1737.4 km or, rarely, 1737.4 with other digits; Mars and the Earth are far away


@dataclass(frozen=True, kw_only=True)
class Projection:
    """x to the east and y to the north at the centre [m], on the sphere of the Moon.

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
        """Of the projection, for people."""
        return PROJECTION_NAMES[self.kind]

    def units_per_m(self, latitude_rad: float) -> tuple[float, float]:
        """Map units of a metre on the ground along x and y at `latitude_rad`; of azimuthal maps at the centre."""
        if self.kind == EQUIRECTANGULAR:
            return self.scale / float(np.cos(latitude_rad)), self.scale_y
        return self.scale, self.scale

    def centred_at(self, x_m: float) -> Projection:
        """The same map coordinates, of an equirectangular map with longitudes counted to half a turn from `x_m`."""
        turned = (x_m - self.false_x_m) / (self.radius_m * self.scale)
        return replace(self, longitude_rad=self.longitude_rad + turned, false_x_m=x_m)

    @property
    def proj_text(self) -> str:
        """The projection as PROJ reads it; degrees are those of a map whose longitudes count from 0."""
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
    """The Moon's projection of PROJ's parameters. Raises BadInput bad_terrain for one that is not known here."""
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
