"""Sun, planets, Earth and Moon in the sky of a site: sources that are no catalogue stars.

No library gives the magnitudes of all of them: Skyfield has the planets, but not the Earth and the Moon.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime

import numpy as np
from numpy.polynomial.polynomial import polyval

from startrack.core.types import Array, Body
from startrack.frames import (
    SPEED_OF_LIGHT_M_S,
    Site,
    aberrate,
    angle_between_rad,
    barycentric_state,
    et_s,
    observer_state,
)

ASTRONOMICAL_UNIT_M = 149_597_870_700.0  # IAU 2012, resolution B2
_NAIF_SUN = 10


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
    """The triangle of Sun, body and observer as the light left the body; angles in degrees, as in the source."""

    from_sun_au: Array  # (3,) ICRS axes
    from_observer_au: Array  # (3,) ICRS axes
    year: float

    @property
    def distances_mag(self) -> float:
        return float(5 * np.log10(np.linalg.norm(self.from_sun_au) * np.linalg.norm(self.from_observer_au)))

    @property
    def phase_deg(self) -> float:
        """Sun - body - observer: 0 when full."""
        return float(np.degrees(angle_between_rad(self.from_sun_au, self.from_observer_au)))

    def latitudes_deg(self, pole: Array) -> tuple[float, float]:
        """Latitudes on the body of the points below the Sun and below the observer."""
        sun, observer = (angle_between_rad(pole, v) for v in (self.from_sun_au, self.from_observer_au))
        return float(np.degrees(sun)) - 90, float(np.degrees(observer)) - 90


@dataclass(frozen=True)
class _Source:
    name: str
    naif: int
    v_mag: Callable[[_View], float]


def _apparent_body(source: _Source, observer_m: Array, velocity_m_s: Array, et: float) -> Body:
    light_time_s = 0.0
    for _ in range(3):  # each round shrinks the error by v / c = 1e-4
        body_m, _ = barycentric_state(source.naif, et - light_time_s)
        light_time_s = float(np.linalg.norm(body_m - observer_m)) / SPEED_OF_LIGHT_M_S
    sun_m, _ = barycentric_state(_NAIF_SUN, et - light_time_s)
    to_body_m = body_m - observer_m
    view = _View(
        from_sun_au=(body_m - sun_m) / ASTRONOMICAL_UNIT_M,
        from_observer_au=to_body_m / ASTRONOMICAL_UNIT_M,
        year=2000 + et / 31_557_600.0,
    )
    ray = aberrate(to_body_m / np.linalg.norm(to_body_m), velocity_m_s)
    return Body(name=source.name, ray_icrs=ray, v_mag=source.v_mag(view))


def _sun(view: _View) -> float:
    """V -26.76 at 1 au: Willmer (2018), ApJS 236, 47."""
    return float(-26.76 + 5 * np.log10(np.linalg.norm(view.from_observer_au)))


def _mercury(view: _View) -> float:
    """Equation 2."""
    phase = polyval(view.phase_deg, [0, 6.3280e-2, -1.6336e-3, 3.3644e-5, -3.4265e-7, 1.6893e-9, -3.0334e-12])
    return float(-0.613 + view.distances_mag + phase)


def _venus(view: _View) -> float:
    """Equations 3 (to 163.7 degrees) and 4 (beyond, where the atmosphere dominates)."""
    if view.phase_deg < 163.7:
        return float(
            -4.384 + view.distances_mag + polyval(view.phase_deg, [0, -1.044e-3, 3.687e-4, -2.814e-6, 8.938e-9])
        )
    return float(view.distances_mag + polyval(view.phase_deg, [236.05828, -2.81914, 8.39034e-3]))


def _earth(view: _View) -> float:
    """Equation 5: the mean over rotation and weather."""
    return float(-3.99 + view.distances_mag + polyval(view.phase_deg, [0, -1.060e-3, 2.054e-4]))


def _moon(view: _View) -> float:
    """Krisciunas and Schaefer (1991), PASP 103, 1033, eq. 9, after Allen (1976), Astrophysical Quantities.

    Their -12.73 at the mean distance of 384 400 km is +0.22 at 1 au from both. No opposition surge.
    """
    return float(0.22 + view.distances_mag + polyval(view.phase_deg, [0, 0.026, 0, 0, 4.0e-9]))


def _mars(view: _View) -> float:
    """Equations 6 and 7 without their terms for rotation and season, at most 0.15 mag together."""
    if view.phase_deg <= 50:
        return float(-1.601 + view.distances_mag + polyval(view.phase_deg, [0, 2.267e-2, -1.302e-4]))
    return float(-0.367 + view.distances_mag + polyval(view.phase_deg, [0, -0.02573, 3.445e-4]))


def _jupiter(view: _View) -> float:
    """Equation 8; its phase never exceeds 12 degrees from Earth or Moon."""
    return float(-9.395 + view.distances_mag + polyval(view.phase_deg, [0, -3.7e-4, 6.16e-4]))


def _saturn(view: _View) -> float:
    """Equation 10, globe and rings; the rings show their dark side when Sun and observer are on opposite sides."""
    sun, observer = view.latitudes_deg(_SATURN_POLE)
    tilt = np.sin(np.radians(np.sqrt(max(sun * observer, 0.0))))
    phase = view.phase_deg
    return float(-8.914 + view.distances_mag - 1.825 * tilt + 0.026 * phase - 0.378 * tilt * np.exp(-2.25 * phase))


def _uranus(view: _View) -> float:
    """Equation 13; the poles are brighter than the equator. Its phase never exceeds 3.1 degrees from Earth or Moon."""
    sun, observer = view.latitudes_deg(_URANUS_POLE)
    return -7.110 + view.distances_mag - 0.00084 * (abs(sun) + abs(observer)) / 2


def _neptune(view: _View) -> float:
    """Equation 16: it grew brighter from 1980 to 2000. Its phase never exceeds 1.9 degrees from Earth or Moon."""
    return float(np.clip(-6.89 - 0.0054 * (view.year - 1980), -7.00, -6.89)) + view.distances_mag


def _pole(ra_deg: float, dec_deg: float) -> Array:
    ra, dec = np.radians([ra_deg, dec_deg])
    return np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])


# Archinal et al. (2018), Celestial Mechanics and Dynamical Astronomy 130, 22, at J2000.
_SATURN_POLE = _pole(40.589, 83.537)
_URANUS_POLE = _pole(257.311, -15.175)

_SOURCES = (
    _Source("Sun", _NAIF_SUN, _sun),
    _Source("Mercury", 199, _mercury),
    _Source("Venus", 299, _venus),
    _Source("Earth", 399, _earth),
    _Source("Moon", 301, _moon),
    _Source("Mars", 4, _mars),
    _Source("Jupiter", 5, _jupiter),
    _Source("Saturn", 6, _saturn),
    _Source("Uranus", 7, _uranus),
    _Source("Neptune", 8, _neptune),
)
