"""Height maps in memory: posts at pixel centres in a map projection, the ground bilinear between them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from startrack.core.types import Array, BadInput
from startrack.frames import MOON_RADIUS_M, R_enu_fixed, Site, enu_from_latlon, latlon_from_enu
from startrack.terrain.earth_projection import EarthProjection, is_earth

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
    common = {
        "longitude_rad": float(np.radians(float(p.get("lon_0", 0.0)))), "radius_m": radius,
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


@dataclass(frozen=True, eq=False, kw_only=True)
class Raster:
    """Heights above the Moon's sphere, or the Earth's ellipsoid.

    Post (row, column) stands at x = x0 + column dx, y = y0 + row dy.
    """

    heights_m: NDArray[np.float32]  # (rows, columns); NaN where the map has a hole
    projection: Projection | EarthProjection
    x0_m: float  # in the units of the projection, as all that follow
    y0_m: float
    dx_m: float
    dy_m: float  # negative where the first row is the northern one
    source: str = ""  # for messages

    @property
    def post_m(self) -> float:
        """Spacing of the posts, the wider of the two [m]."""
        return float(self.spacings_m.max())

    @property
    def spacings_m(self) -> Array:
        """Spacing (2,) of the rows and of the columns in the middle [m]."""
        if isinstance(self.projection, EarthProjection):
            at = np.array(self.heights_m.shape) / 2 + [[0, 0], [0, 1], [1, 0]]
            lat, lon = self.projection.latlon_from_xy(*self.xy(at))
            steps = enu_from_latlon(Site("earth", lat[0], lon[0]), lat[1:], lon[1:])
            return np.linalg.norm(steps, axis=-1)[::-1]
        stretch = np.array([1.0, 1.0])
        if self.projection.kind == EQUIRECTANGULAR:
            _, middle = self.xy(np.array(self.heights_m.shape) / 2)
            latitude = (middle - self.projection.false_y_m) / (self.projection.radius_m * self.projection.scale_y)
            stretch = np.array([np.cos(latitude) / self.projection.scale, 1 / self.projection.scale_y])
        return (np.abs([self.dx_m, self.dy_m]) * stretch)[::-1]

    def facts(self) -> dict[str, Any]:
        """File, size, projection and range of the heights, as JSON values."""
        return {
            "file": self.source,
            "posts": list(self.heights_m.shape),
            "post_m": round(self.post_m, 3),
            "projection": self.projection.name,
            "lowest_m": round(float(np.nanmin(self.heights_m)), 1),
            "highest_m": round(float(np.nanmax(self.heights_m)), 1),
        }

    def xy(self, row_column: Array) -> tuple[Array, Array]:
        """Map coordinates x, y (...) [m] of fractional `row_column` (..., 2)."""
        return self.x0_m + self.dx_m * row_column[..., 1], self.y0_m + self.dy_m * row_column[..., 0]

    def row_column(self, latitude_rad: Array, longitude_rad: Array) -> Array:
        """Fractional rows and columns (..., 2) of places at `latitude_rad`, `longitude_rad` (...)."""
        x, y = self.projection.xy_from_latlon(latitude_rad, longitude_rad)
        with np.errstate(over="ignore"):  # of a damaged file whose posts are 1e-300 m apart
            return np.stack([(y - self.y0_m) / self.dy_m, (x - self.x0_m) / self.dx_m], axis=-1)

    def sample(self, row_column: Array) -> Array:
        """Heights (...) [m] at fractional `row_column` (..., 2), bilinear; NaN beyond the outer posts."""
        row, column = row_column[..., 0], row_column[..., 1]
        rows, columns = self.heights_m.shape
        inside = (row >= 0) & (row <= rows - 1) & (column >= 0) & (column <= columns - 1)
        i = np.clip(np.floor(np.where(inside, row, 0)).astype(np.int64), 0, rows - 2)
        j = np.clip(np.floor(np.where(inside, column, 0)).astype(np.int64), 0, columns - 2)
        down, right = np.where(inside, row - i, np.nan), np.where(inside, column - j, np.nan)
        h = self.heights_m.astype(np.float64, copy=False) if self.heights_m.size < 1 << 16 else self.heights_m
        top = h[i, j] * (1 - right) + h[i, j + 1] * right
        bottom = h[i + 1, j] * (1 - right) + h[i + 1, j + 1] * right
        return np.asarray(top * (1 - down) + bottom * down)

    def grid_numbers(self, site: Site) -> Array:
        """Projection of a vector from the sphere's centre in the site's enu axes to (column, row), as 16 numbers.

        kind, R_projection_enu (9), size along x and y [m], column = (x - n12) n13, row = (y - n14) n15. On the Earth
        (n, 2) numbers, see `ellipsoid_fit.fit_cells`.
        """
        p = self.projection
        if isinstance(p, EarthProjection):
            from startrack.terrain.ellipsoid_fit import fit_cells

            return fit_cells(self, site)
        R_projection_enu = p.R_projection_fixed @ R_enu_fixed(site).T
        size = p.radius_m * p.scale * (2.0 if p.kind == STEREOGRAPHIC else 1.0)
        return np.array([
            p.kind, *R_projection_enu.ravel(), size, p.radius_m * p.scale_y,
            self.x0_m - p.false_x_m, 1 / self.dx_m, self.y0_m - p.false_y_m, 1 / self.dy_m,
        ], dtype=np.float64)  # fmt: skip

    def heights_above_origin_m(self, site: Site) -> NDArray[np.float32]:
        """Heights [m] above the sphere through the site, see `frames.sphere_radius_m`."""
        if isinstance(self.projection, EarthProjection):
            from startrack.terrain.ellipsoid_fit import heights_above_sphere

            return heights_above_sphere(self, site)
        return self.heights_m - np.float32(site.height_m) if site.height_m else self.heights_m

    def place_bytes(self, site: Site) -> bytes:
        """What the places of the posts in the site's enu follow from."""
        p = self.projection
        if isinstance(p, EarthProjection):
            return f"{p.wkt} {p.near} {[self.x0_m, self.y0_m, self.dx_m, self.dy_m]}".encode()
        return self.grid_numbers(site).tobytes()

    def crop(self, rows: slice, columns: slice) -> Raster:
        """The part of the map within the given rows and columns."""
        first_row, first_column = rows.start or 0, columns.start or 0
        return replace(
            self,
            heights_m=np.ascontiguousarray(self.heights_m[rows, columns]),
            x0_m=self.x0_m + first_column * self.dx_m,
            y0_m=self.y0_m + first_row * self.dy_m,
        )

    def window(self, latitude_rad: float, longitude_rad: float, half_m: float) -> tuple[slice, slice]:
        """Rows and columns within `half_m` of `latitude_rad`, `longitude_rad`, and a little more; empty off the map."""
        side = np.linspace(-1.0, 1.0, 33) * half_m
        east, north = np.meshgrid(side, side)
        lat, lon = latlon_from_enu(Site(self.projection.body, latitude_rad, longitude_rad), east, north, 0.0)
        at = self.row_column(lat, lon).reshape(-1, 2)
        if not np.isfinite(at).all():  # on the other side of the body
            return slice(0, 0), slice(0, 0)
        slices = []
        for low, high, n in zip(at.min(axis=0), at.max(axis=0), self.heights_m.shape, strict=True):
            slices.append(slice(int(np.clip(np.floor(low) - 1, 0, n)), int(np.clip(np.ceil(high) + 2, 0, n))))
        return slices[0], slices[1]

    def crop_around(self, latitude_rad: float, longitude_rad: float, half_m: float) -> Raster:
        """The part of the map within about `half_m` of `latitude_rad`, `longitude_rad`; empty off the map."""
        return self.crop(*self.window(latitude_rad, longitude_rad, half_m))
