"""The sky over a site: apparent directions of the stars, on the Earth through its air."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np

from startrack.catalog.solar_system import bodies
from startrack.catalog.stars import StarCatalog
from startrack.core.types import Array, Body, Bools, Stars
from startrack.frames import R_enu_icrs, Site, azel_from_rays, observer_velocity_m_s, rays_from_azel, refract_rad

LOWEST_PREDICTED_RAD = np.radians(3.0)  # below it refraction is not predictable
LOWEST_STAR_RAD = np.radians(-3.0)  # true elevation; refraction lifts a star at -0.5 degrees to the horizon
MOST_BELOW_PART = 0.01  # of the identified stars; right sites: 0; a wrong sign of latitude or longitude: 0.3 to 0.5
SEA_LEVEL_HPA, SCALE_HEIGHT_M = 1010.0, 8430.0  # average air
DEFAULT_SITE = Site("moon", 0.0, 0.0)  # without a site; at most 0.7 arcsec of aberration off


@dataclass(frozen=True, kw_only=True)
class Sky:
    """Catalogue stars in their apparent directions, refraction included where there is air; brightest first."""

    stars: Stars
    b_v: Array  # (n,)
    elevation_rad: Array | None = None  # (n,) true elevation; None where no site on the Earth is given
    R_enu_icrs: Array | None = None  # (3, 3) None without a site

    @property
    def includes_refraction(self) -> bool:
        """Whether refraction is in the directions."""
        return self.elevation_rad is not None


def sky_at(
    catalog: StarCatalog, time_utc: datetime, site: Site | None, lowest_rad: float = LOWEST_PREDICTED_RAD
) -> Sky:
    """The `catalog` at `time_utc` and a `site`, with aberration.

    On the Earth the directions have refraction, and stars are above `lowest_rad` of elevation.

    Without a site there is no refraction: on the Earth a lens fitted to these directions then contains it.
    """
    stars = catalog.at(time_utc, observer_velocity_m_s(site or DEFAULT_SITE, time_utc))
    if site is None:
        return Sky(stars=stars, b_v=catalog.b_v)
    R = R_enu_icrs(site, time_utc)
    if site.body != "earth":
        return Sky(stars=stars, b_v=catalog.b_v, R_enu_icrs=R)
    azimuth, elevation = azel_from_rays(stars.rays_icrs @ R.T)
    up = elevation > lowest_rad
    shown = rays_from_azel(azimuth[up], apparent_elevation_rad(elevation[up], site)) @ R
    return Sky(
        stars=replace(stars.take(up), rays_icrs=shown), b_v=catalog.b_v[up], elevation_rad=elevation[up], R_enu_icrs=R
    )


def apparent_elevation_rad(elevation_rad: Array, site: Site) -> Array:
    """Apparent elevations [rad] of sources at true `elevation_rad` (...) over a `site` on the Earth, in average air."""
    return refract_rad(elevation_rad, float(SEA_LEVEL_HPA * np.exp(-site.height_m / SCALE_HEIGHT_M)))


def apparent_bodies(site: Site, time_utc: datetime) -> tuple[Body, ...]:
    """Planets, Sun and Moon in apparent directions at `time_utc` over a `site` on the Earth, refraction included."""
    R, found = R_enu_icrs(site, time_utc), []
    for body in bodies(site, time_utc):
        azimuth, elevation = azel_from_rays(R @ body.ray_icrs)
        found.append(replace(body, ray_icrs=rays_from_azel(azimuth, apparent_elevation_rad(elevation, site)) @ R))
    return tuple(found)


def airmass(elevation_rad: Array) -> Array:
    """Airmass (...) of lines of sight at `elevation_rad` (...), zenith = 1. Rozenberg 1966, Twilight, p. 160."""
    s = np.sin(elevation_rad)
    return 1.0 / (s + 0.025 * np.exp(-11.0 * s))


def is_below_horizon(rays_icrs: Array, site: Site, time_utc: datetime) -> Bools:
    """Whether stars in the directions `rays_icrs` (n, 3) are below the horizon of a `site` at `time_utc`."""
    return np.asarray(azel_from_rays(rays_icrs @ R_enu_icrs(site, time_utc).T)[1] < LOWEST_STAR_RAD)
