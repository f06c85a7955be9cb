"""Where an observer stands among the stars: orientation, position and velocity of a site at a time."""

from __future__ import annotations

from datetime import datetime

import numpy as np

from startrack.frames.earth import EARTH_SPIN_RAD_S, R_itrs_icrs
from startrack.frames.site import R_enu_fixed, Site, position_fixed_m
from startrack.frames.spice import R_mcmf_icrs, R_mcmf_icrs_rate_1_s, barycentric_state, et_s
from startrack.types import Array

NAIF_EARTH, NAIF_MOON = 399, 301


def R_enu_icrs(site: Site, time: datetime) -> Array:
    """Rotation (3, 3) from ICRS axes to east, north, up at the site: rays_enu = rays_icrs @ R_enu_icrs.T.

    Apparent directions in, apparent directions out: aberration is `aberrate`'s work, refraction `refract_rad`'s.
    Moon: SPICE with the DE421 orientation, MOON_ME. Earth: see R_itrs_icrs.

    Raises:
        BadInput: "no_time" outside the years that the ephemeris covers (1900 to 2050).
        RuntimeError: a package that carries the ephemeris is missing.
    """
    R_fixed_icrs = R_mcmf_icrs(time) if site.body == "moon" else R_itrs_icrs(time)
    return R_enu_fixed(site) @ R_fixed_icrs


def observer_velocity_m_s(site: Site, time: datetime) -> Array:
    """Velocity (3,) of the site relative to the solar system's barycentre, ICRS axes [m/s], for `aberrate`.

    The body's motion (about 30 km/s) and its spin (Earth 465 m/s, Moon 4.6 m/s at the equator).

    Raises: as R_enu_icrs.
    """
    return observer_state(site, time)[1]


def observer_state(site: Site, time: datetime) -> tuple[Array, Array]:
    """Position (3,) [m] and velocity (3,) [m/s] of the site from the solar system's barycentre, ICRS axes.

    Raises: as R_enu_icrs.
    """
    r_fixed_m = position_fixed_m(site)
    if site.body == "moon":
        centre_m, velocity_m_s = barycentric_state(NAIF_MOON, et_s(time))
        return centre_m + r_fixed_m @ R_mcmf_icrs(time), velocity_m_s + r_fixed_m @ R_mcmf_icrs_rate_1_s(time)
    centre_m, velocity_m_s = barycentric_state(NAIF_EARTH, et_s(time))
    R_fixed_icrs = R_itrs_icrs(time)
    spin_fixed_m_s = np.cross([0.0, 0.0, EARTH_SPIN_RAD_S], r_fixed_m)
    return centre_m + r_fixed_m @ R_fixed_icrs, velocity_m_s + spin_fixed_m_s @ R_fixed_icrs
