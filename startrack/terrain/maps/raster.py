"""Height maps in memory: posts at pixel centres in a map projection, the ground bilinear between them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.core.types import Array
from startrack.frames import R_enu_fixed, Site, enu_from_latlon, latlon_from_enu
from startrack.terrain.maps.projections import EQUIRECTANGULAR, STEREOGRAPHIC, EarthProjection, Projection


@dataclass(frozen=True, eq=False, kw_only=True)
class Raster:
    """A height map: heights above the Moon's sphere, or the Earth's ellipsoid.

    Post (row, column) stands at x = x0 + column dx, y = y0 + row dy.
    """

    heights_m: NDArray[np.float32]  # (rows, columns); NaN where the map has a hole
    projection: Projection | EarthProjection
    x0_m: float  # in the units of the projection, as all that follow
    y0_m: float
    dx_m: float
    dy_m: float  # negative where the first row is the northern one
    source: str = ""  # for messages
    notes: tuple[str, ...] = ()  # of its reader: what a user has to know of the heights

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
        """Facts about the map as JSON values: file, size, projection and range of the heights."""
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
        (n, 2) numbers, see `ellipsoid.fit_cells`.
        """
        p = self.projection
        if isinstance(p, EarthProjection):
            from startrack.terrain.maps.ellipsoid import fit_cells

            return fit_cells(self, site)
        R_projection_enu = p.R_projection_fixed @ R_enu_fixed(site).T
        size = p.radius_m * p.scale * (2.0 if p.kind == STEREOGRAPHIC else 1.0)
        return np.array([
            p.kind, *R_projection_enu.ravel(), size, p.radius_m * p.scale_y,
            self.x0_m - p.false_x_m, 1 / self.dx_m, self.y0_m - p.false_y_m, 1 / self.dy_m,
        ], dtype=np.float64)  # fmt: skip

    def heights_above_origin_m(self, site: Site) -> NDArray[np.float32]:
        """Heights (rows, columns) [m] above the sphere through the site, see `frames.sphere_radius_m`."""
        if isinstance(self.projection, EarthProjection):
            from startrack.terrain.maps.ellipsoid import heights_above_sphere

            return heights_above_sphere(self, site)
        return self.heights_m - np.float32(site.height_m) if site.height_m else self.heights_m

    def place_bytes(self, site: Site) -> bytes:
        """Bytes that differ where the places of the posts in the site's enu do."""
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
