"""The sky over a site: apparent directions of stars, Sun, planets, Moon and Earth, on the Earth through its air.

No library gives the magnitudes of all bodies: Skyfield has the planets, but not the Earth and the Moon.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np
from numpy.polynomial.polynomial import polyval

from startrack.catalog.stars import JULIAN_YEAR_S, StarCatalog
from startrack.core.types import Array, Body, Bools, Stars
from startrack.frames import (
    LOWEST_PREDICTED_RAD,
    MOON_RADIUS_M,
    SPEED_OF_LIGHT_M_S,
    R_enu_icrs,
    Site,
    aberrate,
    airmass,
    angle_between_rad,
    azel_from_rays,
    barycentric_state,
    et_s,
    format_utc,
    observer_state,
    observer_velocity_m_s,
    rays_from_azel,
)

NIGHT_RAD = float(np.radians(-18.0))  # elevation of the Sun below which the sky has no light of it
LOWEST_STAR_RAD = np.radians(-3.0)  # apparent elevation, as seen from a mountain
MOST_BELOW_PART = 0.01  # of the identified stars; right sites: 0; a wrong sign of latitude or longitude: 0.3 to 0.5
DEFAULT_SITE = Site("moon", 0.0, 0.0)  # without a site; at most 0.7 arcsec of aberration off
EQUATOR_M = {"earth": 6_378_137.0, "moon": MOON_RADIUS_M}  # radius: WGS 84, and the sphere of the Moon's maps
ASTRONOMICAL_UNIT_M = 149_597_870_700.0  # IAU 2012, resolution B2


@dataclass(frozen=True, kw_only=True)
class Sky:
    """Catalogue stars in their apparent directions, refraction included where there is air; brightest first."""

    stars: Stars
    b_v: Array  # (n,)
    elevation_rad: Array | None = None  # (n,) apparent elevation; None where no site on the Earth is given
    R_enu_icrs: Array | None = None  # (3, 3) None without a site

    @property
    def includes_refraction(self) -> bool:
        """Whether the directions of the stars include refraction."""
        return self.elevation_rad is not None


def sky_at(
    catalog: StarCatalog, time_utc: datetime, site: Site | None, lowest_rad: float = LOWEST_PREDICTED_RAD
) -> Sky:
    """Sky of the `catalog` at `time_utc` over a `site`, with aberration.

    On the Earth the directions have refraction, and stars are above `lowest_rad` of elevation.

    Without a site there is no refraction: on the Earth a lens fitted to these directions then contains it.
    """
    stars = apparent_stars(catalog, time_utc, site)
    if site is None:
        return Sky(stars=stars, b_v=catalog.b_v)
    R = R_enu_icrs(site, time_utc)
    if site.body != "earth":
        return Sky(stars=stars, b_v=catalog.b_v, R_enu_icrs=R)
    elevation = azel_from_rays(stars.rays_icrs @ R.T)[1]
    up = elevation > lowest_rad
    return Sky(stars=stars.take(up), b_v=catalog.b_v[up], elevation_rad=elevation[up], R_enu_icrs=R)


def apparent_stars(catalog: StarCatalog, time_utc: datetime | None, site: Site | None) -> Stars:
    """Stars of the whole `catalog` as seen at `time_utc` from a `site`, with aberration and the refraction of its air.

    Stars below the horizon are there too. Without a time (None) at J2000.0 without both; without a site (None) as from
    the Moon.
    """
    if time_utc is None:
        return catalog.at(None, None)
    stars = catalog.at(time_utc, observer_velocity_m_s(site or DEFAULT_SITE, time_utc))
    if site is None or site.air is None:
        return stars
    return replace(stars, rays_icrs=site.air.refract(stars.rays_icrs, R_enu_icrs(site, time_utc)))


def catalog_rays(apparent_icrs: Array, time_utc: datetime | None, site: Site | None) -> Array:
    """Directions (n, 3) in the catalogue of what appears in `apparent_icrs` (n, 3): no refraction, no aberration.

    The inverse of `apparent_stars` at the same `time_utc` and `site`; without a time the directions as they are.
    """
    if time_utc is None:
        return apparent_icrs  # the catalogue was taken without aberration
    if site is not None and site.air is not None:
        apparent_icrs = site.air.straighten(apparent_icrs, R_enu_icrs(site, time_utc))
    return aberrate(apparent_icrs, -observer_velocity_m_s(site or DEFAULT_SITE, time_utc))


def apparent_bodies(site: Site, time_utc: datetime) -> tuple[Body, ...]:
    """Planets, Sun, Earth and Moon in apparent directions at `time_utc` over a `site`, refraction included."""
    found, air = bodies(site, time_utc), site.air
    if air is None:
        return tuple(found)
    R = R_enu_icrs(site, time_utc)
    return tuple(replace(body, ray_icrs=air.refract(body.ray_icrs, R)) for body in found)


def bodies_from_centre(of: str, time_utc: datetime) -> tuple[Body, ...]:
    """Planets, Sun, and Earth or Moon at `time_utc` as seen from the centre `of` the body "earth" or "moon"."""
    return tuple(bodies(Site(of, 0.0, 0.0, -EQUATOR_M[of]), time_utc))


def sun_elevation_rad(site: Site, time_utc: datetime) -> float:
    """Elevation [rad] of the Sun's centre above the horizon of a `site` at `time_utc`, refraction included."""
    sun = next(body for body in apparent_bodies(site, time_utc) if body.name == "Sun")
    return float(azel_from_rays(R_enu_icrs(site, time_utc) @ sun.ray_icrs)[1])


def daylight_warnings(site: Site, time_utc: datetime) -> list[str]:
    """A warning where the Sun's centre is above the horizon of a `site` on the Earth at `time_utc`."""
    elevation_deg = np.degrees(sun_elevation_rad(site, time_utc)) if site.body == "earth" else -90.0
    text = f"at {format_utc(time_utc)} the Sun stands {elevation_deg:.0f} degrees above the horizon of the site"
    return [f"{text}, when no stars are seen: is the time UTC, and the site right?"] if elevation_deg > 0.0 else []


def airmass_at(rays_enu: Array, site: Site | None) -> Array | None:
    """Airmass (n,) of lines of sight in apparent directions `rays_enu` (n, 3) from a `site`; None without air."""
    return None if site is None or site.air is None else airmass(azel_from_rays(rays_enu)[1])


def is_below_horizon(rays_icrs: Array, site: Site, time_utc: datetime) -> Bools:
    """Whether stars in the directions `rays_icrs` (n, 3) are below the horizon of a `site` at `time_utc`."""
    return np.asarray(azel_from_rays(rays_icrs @ R_enu_icrs(site, time_utc).T)[1] < LOWEST_STAR_RAD)


def bodies(site: Site, time: datetime) -> list[Body]:
    """Sun, Mercury to Neptune, and Earth or Moon, as seen from the site: apparent directions and V magnitudes.

    Always all of them, from the Sun outwards, above the horizon or below, except the site's own body.
    The direction is to the body's centre from the site itself (not from its body's centre), with light time and
    aberration, without refraction and without the Sun's bending of light. Mars and the outer planets are their
    systems' barycentres (within 0.1 arcsec of the planet, for Jupiter and Saturn); their satellites are not listed.
    Magnitudes are good to 0.05, for Mars to 0.15 (rotation), for the Earth (weather) and the Moon to about 0.3, and
    less as thin crescents.

    Raises:
        BadInput: "no_time" outside the years that the ephemeris covers (1900 to 2050).
        RuntimeError: a package that carries the ephemeris is missing.

    Source: Mallama and Hilton (2018), Astronomy and Computing 25, 10 (arXiv 1808.01973), whose equation numbers
    are given below; for Sun and Moon see there.
    """
    observer_m, velocity_m_s = observer_state(site, time)
    et = et_s(time)
    sources = (source for source in _SOURCES if source.name.lower() != site.body.lower())
    return [_apparent_body(source, observer_m, velocity_m_s, et) for source in sources]


@dataclass(frozen=True)
class _View:
    """The triangle of Sun, body and observer as the light left the body."""

    from_sun_au: Array  # (3,) ICRS axes
    from_observer_au: Array  # (3,) ICRS axes
    year: float

    @property
    def phase_deg(self) -> float:
        """Angle Sun - body - observer [degrees]: 0 when full."""
        return float(np.degrees(angle_between_rad(self.from_sun_au, self.from_observer_au)))

    def latitudes_deg(self, pole: Array) -> tuple[float, float]:
        """Latitudes on the body, with a `pole` (3,), of the points below the Sun and below the observer."""
        sun, observer = (angle_between_rad(pole, v) for v in (self.from_sun_au, self.from_observer_au))
        return float(np.degrees(sun)) - 90, float(np.degrees(observer)) - 90


def _apparent_body(source: _Source, observer_m: Array, velocity_m_s: Array, et: float) -> Body:
    """Body of a `source` as seen from `observer_m` (3,) [m] at the time `et` [s], with light time and aberration."""
    light_time_s = 0.0
    for _ in range(3):  # each round shrinks the error by v / c = 1e-4
        body_m, _ = barycentric_state(source.naif, et - light_time_s)
        light_time_s = float(np.linalg.norm(body_m - observer_m)) / SPEED_OF_LIGHT_M_S
    sun_m, _ = barycentric_state(_SUN.naif, et - light_time_s)
    to_body_m = body_m - observer_m
    view = _View(
        from_sun_au=(body_m - sun_m) / ASTRONOMICAL_UNIT_M,
        from_observer_au=to_body_m / ASTRONOMICAL_UNIT_M,
        year=2000 + et / JULIAN_YEAR_S,
    )
    ray = aberrate(to_body_m / np.linalg.norm(to_body_m), velocity_m_s)
    return Body(name=source.name, ray_icrs=ray, v_mag=source.v_mag(view))


# Archinal et al. (2018), Celestial Mechanics and Dynamical Astronomy 130, 22, at J2000: 90 degrees less the right
# ascension, and the declination.
_SATURN_POLE, _URANUS_POLE = (rays_from_azel(*np.radians(at)) for at in ((49.411, 83.537), (-167.311, -15.175)))


def _saturns_rings(view: _View) -> float:
    """Magnitudes that Saturn's rings add: 0 where Sun and observer are on opposite sides, so that they are dark."""
    sun, observer = view.latitudes_deg(_SATURN_POLE)
    tilt = np.sin(np.radians(np.sqrt(max(sun * observer, 0.0))))
    return float(-1.825 * tilt - 0.378 * tilt * np.exp(-2.25 * view.phase_deg))


def _uranus_poles(view: _View) -> float:
    """Magnitudes that Uranus's bright poles add. The phase never exceeds 3.1 degrees from Earth or Moon."""
    return -0.00084 * sum(map(abs, view.latitudes_deg(_URANUS_POLE))) / 2


def _neptunes_rise(view: _View) -> float:
    """Magnitude of Neptune at 1 au; it fell from 1980 to 2000. The phase stays below 1.9 degrees from Earth or Moon."""
    return float(np.clip(-6.89 - 0.0054 * (view.year - 1980), -7.00, -6.89))


@dataclass(frozen=True)
class _Source:
    """A body with its magnitude at 1 au from Sun and observer: by the phase, up to an angle, and the rest."""

    name: str
    naif: int
    by_phase: tuple[tuple[float, tuple[float, ...]], ...]  # largest phase angle [deg], coefficients
    rest: Callable[[_View], float] = lambda view: 0.0

    def v_mag(self, view: _View) -> float:
        """Apparent V magnitude of the body in a `view` of it."""
        far_au = np.linalg.norm(view.from_observer_au)
        if self is not _SUN:
            far_au = far_au * np.linalg.norm(view.from_sun_au)
        phase_deg = 0.0 if self is _SUN else view.phase_deg
        coefficients = next(one for most_deg, one in self.by_phase if phase_deg <= most_deg)
        return float(5 * np.log10(far_au) + polyval(phase_deg, coefficients) + self.rest(view))


_SUN = _Source("Sun", 10, ((180, (-26.76,)),))  # Willmer (2018), ApJS 236, 47
_SOURCES = (
    _SUN,
    _Source(  # equation 2
        "Mercury", 199, ((180, (-0.613, 6.3280e-2, -1.6336e-3, 3.3644e-5, -3.4265e-7, 1.6893e-9, -3.0334e-12)),)
    ),
    _Source(  # equations 3, and 4 where the atmosphere dominates
        "Venus", 299,
        ((163.7, (-4.384, -1.044e-3, 3.687e-4, -2.814e-6, 8.938e-9)), (180, (236.05828, -2.81914, 8.39034e-3))),
    ),
    _Source("Earth", 399, ((180, (-3.99, -1.060e-3, 2.054e-4)),)),  # equation 5: the mean over rotation and weather
    # Krisciunas and Schaefer (1991), PASP 103, 1033, eq. 9, after Allen (1976), Astrophysical Quantities. Their -12.73
    # at the mean distance of 384 400 km is +0.22 at 1 au from both. No opposition surge.
    _Source("Moon", 301, ((180, (0.22, 0.026, 0, 0, 4.0e-9)),)),
    # Equations 6 and 7 without their terms for rotation and season, at most 0.15 mag together.
    _Source("Mars", 4, ((50, (-1.601, 2.267e-2, -1.302e-4)), (180, (-0.367, -0.02573, 3.445e-4)))),
    _Source("Jupiter", 5, ((180, (-9.395, -3.7e-4, 6.16e-4)),)),  # equation 8; its phase never exceeds 12 degrees
    _Source("Saturn", 6, ((180, (-8.914, 0.026)),), _saturns_rings),  # equation 10, globe and rings
    _Source("Uranus", 7, ((180, (-7.110,)),), _uranus_poles),  # equation 13
    _Source("Neptune", 8, ((180, (0.0,)),), _neptunes_rise),  # equation 16
)  # fmt: skip
