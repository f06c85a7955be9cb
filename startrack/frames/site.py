"""A site on the Moon or the Earth: its local frame, and its orientation, position and velocity at a time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from functools import cached_property
from math import isfinite, pi
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from startrack.core.types import Array, BadInput
from startrack.frames import orientation
from startrack.frames.air import Air

MOON_RADIUS_M = 1_737_400.0  # sphere of the LOLA maps, IAU 2015


@dataclass(frozen=True)
class Site:
    """The origin of a local frame `enu` (east, north, up), on the Moon or the Earth.

    Moon: planetocentric on the 1737.4 km sphere, mean Earth / polar axis (MOON_ME). Earth: geodetic, WGS 84.
    """

    body: str  # "moon" or "earth"
    latitude_rad: float  # north positive
    longitude_rad: float  # east positive; any multiple of 2 pi may be added
    height_m: float = 0.0  # above the sphere or the ellipsoid
    stated_air: Air | None = None  # None: on the Earth that of the standard atmosphere

    def __post_init__(self) -> None:
        if self.body not in ("moon", "earth"):
            raise BadInput("bad_terrain", f"unknown body {self.body!r}: moon and earth are known")
        if not all(map(isfinite, (self.latitude_rad, self.longitude_rad, self.height_m))):
            raise BadInput("bad_terrain", "the origin's latitude, longitude and height must be finite numbers")
        if abs(self.latitude_rad) > pi / 2:
            raise BadInput("bad_terrain", f"latitude {np.degrees(self.latitude_rad):.6g} degrees is beyond a pole")
        if self.body != "earth" and self.stated_air is not None:
            raise BadInput("bad_terrain", f"[air] is for the Earth, and the body is the {self.body.title()}")

    @cached_property
    def air(self) -> Air | None:
        """The air that refracts and dims the stars; None where there is none."""
        if self.body != "earth":
            return None
        air = self.stated_air or Air.at(self.height_m)
        return None if air.is_none else air

    def with_air(self, stated: Mapping[str, Any] | None) -> Site:
        """Copy of this site under the air that is `stated` (keys of `AIR_KEYS`), the rest of it its own; None: itself.

        Raises BadInput (bad_terrain) for impossible air, and off the Earth.
        """
        if stated is None:
            return self
        return replace(self, stated_air=(self.stated_air or Air.at(self.height_m)).with_stated(stated))


def R_enu_fixed(site: Site) -> Array:
    """Rotation (3, 3) from the body-fixed frame (`mcmf` on the Moon, ITRS on the Earth) to `enu` at the site."""
    sin_lat, cos_lat = np.sin(site.latitude_rad), np.cos(site.latitude_rad)
    sin_lon, cos_lon = np.sin(site.longitude_rad), np.cos(site.longitude_rad)
    east = [-sin_lon, cos_lon, 0.0]
    north = [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat]
    up = [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat]
    return np.array([east, north, up])


def position_fixed_m(site: Site) -> Array:
    """Position (3,) of the site in the body-fixed frame, from the body's centre [m]."""
    return _fixed_from_latlon(site.body, site.latitude_rad, site.longitude_rad, site.height_m)


def sphere_radius_m(site: Site) -> float:
    """Radius [m] of the sphere through the site with its centre on the site's vertical that fits the body's surface.

    On the Moon the radius of its maps plus the site's height. On the Earth the Gaussian radius of curvature,
    sqrt(M N) of the ellipsoid, of the surface that is parallel to it at the site's height.
    """
    if site.body == "moon":
        return MOON_RADIUS_M + site.height_m
    import erfa

    a, f = erfa.eform(erfa.WGS84)
    e2 = float(f * (2.0 - f))
    w2 = 1.0 - e2 * np.sin(site.latitude_rad) ** 2
    meridian, normal = a * (1.0 - e2) / w2**1.5, a / np.sqrt(w2)
    return float(np.sqrt((meridian + site.height_m) * (normal + site.height_m)))


def enu_from_latlon(site: Site, latitude_rad: ArrayLike, longitude_rad: ArrayLike, height_m: ArrayLike = 0.0) -> Array:
    """Points (..., 3) in the site's enu [m] of `latitude_rad`, `longitude_rad`, `height_m` (...) on the site's body.

    Heights are above the sphere (Moon) or the ellipsoid (Earth). The points are true 3-D points: distant ones lie below
    the horizontal plane.
    """
    points_m = _fixed_from_latlon(site.body, latitude_rad, longitude_rad, height_m)
    return (points_m - position_fixed_m(site)) @ R_enu_fixed(site).T


def latlon_from_enu(site: Site, east_m: ArrayLike, north_m: ArrayLike, up_m: ArrayLike) -> tuple[Array, Array]:
    """Latitude and longitude, each (...) [rad], of the points `east_m`, `north_m`, `up_m` (...) in the site's enu.

    Inverse of enu_from_latlon: planetocentric on the Moon, geodetic (WGS 84) on the Earth; longitude in (-pi, pi], not
    defined at a pole.
    """
    points_enu_m = np.stack(np.broadcast_arrays(*(np.asarray(c, dtype=float) for c in (east_m, north_m, up_m))), -1)
    points_m = points_enu_m @ R_enu_fixed(site) + position_fixed_m(site)
    if site.body == "earth":
        import erfa

        longitude_rad, latitude_rad, _ = erfa.gc2gd(erfa.WGS84, points_m)
        return latitude_rad, longitude_rad
    x, y, z = np.moveaxis(points_m, -1, 0)
    return np.arctan2(z, np.hypot(x, y)), np.arctan2(y, x)


def R_enu_icrs(site: Site, time: datetime) -> Array:
    """Rotation (3, 3) from ICRS axes to east, north, up at the site and `time`: rays_enu = rays_icrs @ R_enu_icrs.T.

    Apparent directions give apparent directions: see `aberrate` and `Air.refract` for aberration and refraction.
    Moon: SPICE with the DE421 orientation, MOON_ME. Earth: see R_itrs_icrs.

    Raises:
        BadInput: "no_time" outside the years that the ephemeris covers (1900 to 2050).
        RuntimeError: a package that carries the ephemeris is missing.
    """
    R_fixed_icrs = orientation.R_mcmf_icrs(time) if site.body == "moon" else orientation.R_itrs_icrs(time)
    return R_enu_fixed(site) @ R_fixed_icrs


def sky_rotvec_rad(site: Site, time: datetime, seconds: float) -> Array:
    """Rotation vector (3,) in enu of the stars at a `site` over an interval of `seconds` about `time`.

    R_enu_icrs(end) = exp([rotvec]x) R_enu_icrs(start); for intervals under half a rotation of the sky.

    Raises: as R_enu_icrs.
    """
    from scipy.spatial.transform import Rotation

    half = timedelta(seconds=seconds / 2)
    turn = R_enu_icrs(site, time + half) @ R_enu_icrs(site, time - half).T
    return Rotation.from_matrix(turn).as_rotvec()


def observer_velocity_m_s(site: Site, time: datetime) -> Array:
    """Velocity (3,) of the site at `time`, from the solar system's barycentre, ICRS axes [m/s], for `aberrate`.

    The body's motion (about 30 km/s) and its spin (Earth 465 m/s, Moon 4.6 m/s at the equator).

    Raises: as R_enu_icrs.
    """
    return observer_state(site, time)[1]


def observer_state(site: Site, time: datetime) -> tuple[Array, Array]:
    """Position (3,) [m] and velocity (3,) [m/s] of the site at `time` from the solar system's barycentre, ICRS axes.

    Raises: as R_enu_icrs.
    """
    r_fixed_m = position_fixed_m(site)
    centre_m, velocity_m_s = orientation.barycentric_state(orientation.NAIF[site.body], orientation.et_s(time))
    if site.body == "moon":
        R_fixed_icrs, spin_m_s = orientation.R_mcmf_icrs(time), r_fixed_m @ orientation.R_mcmf_icrs_rate_1_s(time)
    else:
        R_fixed_icrs = orientation.R_itrs_icrs(time)
        spin_m_s = np.cross([0.0, 0.0, orientation.EARTH_SPIN_RAD_S], r_fixed_m) @ R_fixed_icrs
    return centre_m + r_fixed_m @ R_fixed_icrs, velocity_m_s + spin_m_s


def _fixed_from_latlon(body: str, latitude_rad: ArrayLike, longitude_rad: ArrayLike, height_m: ArrayLike) -> Array:
    """Positions (..., 3) [m] in the body-fixed frame of latitudes, longitudes [rad] and heights [m] (...)."""
    lat, lon, h = np.broadcast_arrays(*(np.asarray(v, dtype=float) for v in (latitude_rad, longitude_rad, height_m)))
    if body == "earth":
        import erfa

        return np.asarray(erfa.gd2gc(erfa.WGS84, lon, lat, h))
    level_m = (MOON_RADIUS_M + h) * np.cos(lat)
    return np.stack([level_m * np.cos(lon), level_m * np.sin(lon), (MOON_RADIUS_M + h) * np.sin(lat)], axis=-1)
