"""Directions: unit vectors, their angles, aberration and refraction. Components are on the last axis."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from startrack.core.types import Array

SPEED_OF_LIGHT_M_S = 299_792_458.0  # exact, SI


def rays_from_azel(azimuth_rad: ArrayLike, elevation_rad: ArrayLike) -> Array:
    """Unit vectors (..., 3) in enu: (sin a cos e, cos a cos e, sin e), a = `azimuth_rad`, e = `elevation_rad` (...).

    The azimuth is counted from north through east.
    """
    a, e = np.broadcast_arrays(np.asarray(azimuth_rad, dtype=float), np.asarray(elevation_rad, dtype=float))
    return np.stack([np.sin(a) * np.cos(e), np.cos(a) * np.cos(e), np.sin(e)], axis=-1)


def length_xy(x: Array, y: Array) -> Array:
    """sqrt(x^2 + y^2) of two components (...), for numbers far from overflow: np.hypot takes seven times as long."""
    return np.sqrt(x * x + y * y)


def azel_from_rays(rays_enu: ArrayLike) -> tuple[Array, Array]:
    """Azimuth in [0, 2 pi) from north through east, and elevation above the horizontal, of `rays_enu` (..., 3) [rad].

    Vectors need not be of unit length. At the zenith the azimuth is not defined.
    """
    east, north, up = np.moveaxis(np.asarray(rays_enu, dtype=float), -1, 0)
    azimuth_rad = np.arctan2(east, north)
    azimuth_rad = azimuth_rad + np.where(azimuth_rad < 0.0, 2 * np.pi, 0.0)
    # A tiny negative angle becomes 2 pi itself.
    azimuth_rad = np.where(azimuth_rad >= 2 * np.pi, 0.0, azimuth_rad)
    return azimuth_rad, np.arctan2(up, length_xy(east, north))


def off_axis_rad(rays: ArrayLike) -> Array:
    """Angle (...) between the vectors `rays` (..., 3) and their frame's z axis [rad], exact at 0 and at pi."""
    x, y, z = np.moveaxis(np.asarray(rays, dtype=float), -1, 0)
    return np.arctan2(length_xy(x, y), z)


def angle_between_rad(a: ArrayLike, b: ArrayLike) -> Array:
    """Angle (...) between vectors a and b (..., 3) [rad]: atan2(|a x b|, a . b), exact at 0 and at pi."""
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))


def aberrate(rays_icrs: ArrayLike, velocity_m_s: ArrayLike) -> Array:
    """Directions (..., 3) for an observer with `velocity_m_s` (3,), from the directions `rays_icrs` (..., 3) at rest.

    With n at rest, b = v / c and g = (1 - b^2)^(-1/2):  (n / g + (1 + n.b / (1 + 1/g)) b) / (1 + n.b).
    Exact for any speed below light's (Explanatory Supplement to the Astronomical Almanac, 3rd ed. 2013, eq. 7.40).
    The bending of light by the Sun is neglected: 4 mas at 90 degrees from it, 0.1 arcsec at 5 degrees.
    """
    rays = np.asarray(rays_icrs, dtype=float)
    beta = np.asarray(velocity_m_s, dtype=float) / SPEED_OF_LIGHT_M_S
    inverse_gamma = np.sqrt(1.0 - beta @ beta)
    factor = 1.0 + (rays @ beta) / (1.0 + inverse_gamma)
    # One component after the other: numpy is slow over axes of three.
    x, y, z = (inverse_gamma * rays[..., axis] + factor * beta[axis] for axis in range(3))
    # Normalised instead of divided by 1 + n.b: rounding in the catalogue's rays must not accumulate.
    length = np.sqrt(x * x + y * y + z * z)
    return np.stack([x / length, y / length, z / length], axis=-1)


def turn_azel(azimuth_rad: Array, elevation_rad: Array, R: Array) -> tuple[Array, Array]:
    """Azimuth and elevation (n,), (n,) of the directions `azimuth_rad`, `elevation_rad` (n,) turned by `R` (3, 3)."""
    return azel_from_rays(rays_from_azel(azimuth_rad, elevation_rad) @ R.T)


def refract_rad(elevation_rad: ArrayLike, pressure_hpa: float = 1010.0, temperature_c: float = 10.0) -> Array:
    """Apparent elevation (...) in the Earth's air of a source at true elevation `elevation_rad` [rad].

    With lift(h) in arcminutes for the apparent elevation h in degrees, r = cot(h + 7.31 / (h + 4.4)):
    apparent = true + lift(apparent),  lift = r - 0.06 sin(14.7 r + 13), the sine's argument in degrees,
    scaled to `pressure_hpa` and `temperature_c`. Good to 2 arcsec in average air, down to the horizon, where the
    weather is worth a tenth of the 34 arcmin. Below -1 degree the lift keeps its value there.

    Source: Bennett (1982), J. Navigation 35, 255, with his correction; as in Meeus (1998), chapter 16.
    """
    true_rad = np.asarray(elevation_rad, dtype=float)
    air = pressure_hpa / 1010.0 * 283.0 / (273.0 + temperature_c)
    start_deg = np.degrees(np.maximum(true_rad, np.radians(-1.0)))
    lift_arcmin = np.zeros_like(start_deg)
    for _ in range(12):  # the lift falls by at most 0.2 arcmin per arcmin: twelve rounds converge
        h = start_deg + lift_arcmin / 60.0
        r = 1.0 / np.tan(np.radians(h + 7.31 / (h + 4.4)))
        lift_arcmin = air * (r - 0.06 * np.sin(np.radians(14.7 * r + 13.0)))
    return true_rad + np.radians(lift_arcmin / 60.0)
