"""Celestial navigation: attitude by stars and the local vertical give latitude and longitude.

The vertical on a sphere: its direction at a position, its measurement with a tilt, the position that it gives. With an
inclinometer it is the method of Kua 2008, section 2.1 (its reference [7], Sigel and Wettergreen), built from that
description, not from the paper. The thesis has its "theoretical worst case error of 1.2 km", which the measurement of
the vertical dominates. On the Moon's sphere that is a tilt of 142 arcseconds; here the mean length of the drawn tilts
is that.
"""

from __future__ import annotations

import numpy as np

from startrack.core.types import Array
from startrack.frames import R_enu_fixed, R_from_rotvec, Site, enu_from_latlon, sphere_radius_m
from startrack.output import ARCSEC_PER_RAD

INCLINOMETER_ARCSEC = 142.0  # mean error of the vertical: 1.2 km on the Moon (8.42 m per arcsecond)
AXIS_BY_MEAN = float(np.sqrt(2.0 / np.pi))  # standard deviation of an axis over the mean length of two (Rayleigh)


def vertical_at(position_m: Array, site: Site) -> Array:
    """Direction (3,) of the vertical at `position_m` (2,) on the sphere of a `site`, in the site's enu."""
    level = np.asarray(position_m) / sphere_radius_m(site)
    return np.append(level, np.sqrt(1.0 - level @ level))


def position_of_vertical(vertical: Array, site: Site) -> Array:
    """Position (2,) [m] in the enu of a `site` where the vertical has the direction `vertical` (3,) in that enu.

    The stars and the clock give the attitude in the frame of the Moon; there a vertical is a latitude and a longitude.
    """
    x, y, z = vertical @ R_enu_fixed(site)
    latitude, longitude = np.arctan2(z, np.hypot(x, y)), np.arctan2(y, x)
    return np.asarray(enu_from_latlon(site, latitude, longitude, site.height_m)[:2])


def tilt_vertical(vertical: Array, tilt_rad: Array) -> Array:
    """The `vertical` (3,) turned by `tilt_rad` (2,) about east and north, as an inclinometer with that error has it."""
    return np.asarray(R_from_rotvec(np.append(tilt_rad, 0.0)) @ vertical)


def draw_tilt_rad(mean_arcsec: float, *, rng: np.random.Generator) -> Array:
    """A tilt (2,) [rad] about east and north with normal components; its length is `mean_arcsec` in the mean."""
    return rng.standard_normal(2) * (mean_arcsec * AXIS_BY_MEAN / ARCSEC_PER_RAD)


def locate_by_inclinometer(truth_m: Array, site: Site, *, rng: np.random.Generator) -> tuple[Array, Array]:
    """Position (2,) [m] by one reading of the vertical at `truth_m` (2,), and the tilt (2,) [rad] that is drawn.

    Attitude and clock are taken as exact: they are good to arcseconds, and the Moon turns by half of one a second.
    """
    tilt = draw_tilt_rad(INCLINOMETER_ARCSEC, rng=rng)
    return position_of_vertical(tilt_vertical(vertical_at(truth_m, site), tilt), site), tilt
