"""Map projections on the sphere, in closed form: azimuthal ones about any centre, and latitude-longitude grids."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from startrack.frames import MOON_RADIUS_M, R_enu_fixed, Site
from startrack.types import Array, BadInput

STEREOGRAPHIC, ORTHOGRAPHIC, EQUIRECTANGULAR = 0, 1, 2
NAMES = ("stereographic", "orthographic", "equirectangular")
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

    def __post_init__(self) -> None:
        if abs(self.radius_m - MOON_RADIUS_M) > RADIUS_TOLERANCE_M:
            raise BadInput(
                "bad_terrain",
                f"the map is of a body of {self.radius_m / 1000:.1f} km radius, not the Moon's 1737.4 km sphere",
            )

    @property
    def R_projection_fixed(self) -> Array:
        """Rotation (3, 3) from the body-fixed frame to the frame in which the projection's formula is written."""
        if self.kind == EQUIRECTANGULAR:
            s, c = np.sin(self.longitude_rad), np.cos(self.longitude_rad)
            return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        return R_enu_fixed(Site("moon", self.latitude_rad, self.longitude_rad))

    def xy_from_latlon(self, latitude_rad: ArrayLike, longitude_rad: ArrayLike) -> tuple[Array, Array]:
        """Map coordinates x, y (...) [m] of places."""
        lat, lon = np.asarray(latitude_rad, dtype=float), np.asarray(longitude_rad, dtype=float)
        fixed = np.stack(np.broadcast_arrays(np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)), -1)
        v = fixed @ self.R_projection_fixed.T
        size = self.radius_m * self.scale
        if self.kind == EQUIRECTANGULAR:
            x = size * np.arctan2(v[..., 1], v[..., 0])
            y = self.radius_m * self.scale_y * np.arctan2(v[..., 2], np.hypot(v[..., 0], v[..., 1]))
        else:
            k = 2 * size / (1 + v[..., 2]) if self.kind == STEREOGRAPHIC else size
            x, y = k * v[..., 0], k * v[..., 1]
        return x + self.false_x_m, y + self.false_y_m

    def latlon_from_xy(self, x_m: ArrayLike, y_m: ArrayLike) -> tuple[Array, Array]:
        """Latitude and longitude (...) [rad] of map coordinates; inverse of xy_from_latlon."""
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


def polar_stereographic(
    south: bool = True, longitude_rad: float = 0.0, true_scale_latitude_rad: float | None = None
) -> Projection:
    """About a pole. rho = 2 R tan((90 - |latitude|) / 2) where the scale is true at the pole (the LOLA polar maps)."""
    pole = -np.pi / 2 if south else np.pi / 2
    at = pole if true_scale_latitude_rad is None else true_scale_latitude_rad
    return Projection(
        kind=STEREOGRAPHIC, latitude_rad=pole, longitude_rad=longitude_rad, scale=float((1 + np.sin(abs(at))) / 2)
    )
