"""The Earth's air: refraction against astropy and a ray trace of our own kind, and its keys in files."""

from __future__ import annotations

import warnings
from dataclasses import replace
from datetime import timedelta

import erfa
import numpy as np
import pytest

from startrack.catalog import apparent_bodies, apparent_stars, bodies, load_catalog
from startrack.core.types import BadInput
from startrack.frames import (
    Air,
    R_enu_icrs,
    R_from_rotvec,
    Site,
    airmass,
    angle_between_rad,
    azel_from_rays,
    parse_utc,
    rays_from_azel,
    turn_azel,
    turn_sky,
)

ARCSEC_RAD = np.pi / 648_000
KUFFNER = Site("earth", np.radians(48.2128), np.radians(16.2914), 302.0)
TIME = parse_utc("2024-10-05T21:00:00Z")
AIRS = [  # sea level, warm and wet, a cold night, a mountain, near-infrared
    Air(pressure_hpa=1013.25, temperature_c=15.0, humidity_1=0.0),
    Air(pressure_hpa=1000.0, temperature_c=30.0, humidity_1=0.9),
    Air(pressure_hpa=1030.0, temperature_c=-25.0, humidity_1=0.7),
    Air(pressure_hpa=620.0, temperature_c=2.0, humidity_1=0.2, height_m=4000.0),
    Air(pressure_hpa=1010.0, temperature_c=10.0, humidity_1=0.5, wavelength_um=0.9),
]


def traced_lift_rad(apparent_rad: float, hpa: float, celsius: float, height_m: float, refractivity: float) -> float:
    """Refraction by Snell's law through 40,000 spherical shells, for dry air whose index at the site is given."""
    gravity, gas = 9.784 * (1 - 2.8e-7 * height_m) * 28.9644 / 8314.32, 0.0065
    edges = height_m + np.concatenate([np.linspace(0, 30e3, 30_001), np.linspace(30e3, 90e3, 10_001)[1:]])
    middle = 0.5 * (edges[1:] + edges[:-1])
    kelvin = celsius + 273.15 - gas * (np.minimum(middle, 11e3) - height_m)
    # Hydrostatic equilibrium, integrated numerically: d ln p / dh = -g M / (R T).
    log_p = np.concatenate([[0.0], -np.cumsum(gravity / kelvin * np.diff(edges))])
    log_p = 0.5 * (log_p[1:] + log_p[:-1])
    index = 1 + refractivity * np.exp(log_p) * (celsius + 273.15) / kelvin
    index = np.concatenate([[1 + refractivity], index, [1.0]])
    radius = 6_371_008.8 + edges
    sine, bent = np.cos(apparent_rad), 0.0  # of the zenith angle, at the bottom of a shell
    for k in range(len(radius)):
        refracted = index[k] * sine / index[k + 1]  # across the boundary at radius[k]
        bent += np.arcsin(refracted) - np.arcsin(sine)
        sine = refracted * radius[k] / radius[min(k + 1, len(radius) - 1)]
    return float(bent)


@pytest.mark.parametrize("air", AIRS)
def test_refraction_is_erfas_above_10_degrees(air: Air) -> None:
    a, b = erfa.refco(air.pressure_hpa, air.temperature_c, air.humidity_1, air.wavelength_um)
    apparent = np.radians(np.arange(10, 91, 1.0))
    tangent = np.tan(np.pi / 2 - apparent)
    assert np.abs(air.lift_rad(apparent) - (a * tangent + b * tangent**3)).max() < 1.0 * ARCSEC_RAD


def test_refraction_is_that_of_astropys_altaz_above_10_degrees() -> None:
    from astropy import units as u
    from astropy.coordinates import AltAz, EarthLocation, SkyCoord
    from astropy.time import Time
    from astropy.utils import iers

    place = EarthLocation.from_geodetic(16.2914 * u.deg, 48.2128 * u.deg, 302 * u.m)
    air = AIRS[1]
    site = replace(KUFFNER, stated_air=air)
    with iers.conf.set_temp("auto_download", False), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        catalog = load_catalog().brighter_than(4.0)
        still = catalog.at(TIME, None).rays_icrs
        there = SkyCoord(*(still.T), representation_type="cartesian", frame="icrs").transform_to(
            AltAz(
                obstime=Time(TIME), location=place, pressure=air.pressure_hpa * u.hPa,
                temperature=air.temperature_c * u.deg_C, relative_humidity=air.humidity_1, obswl=0.55 * u.um,
            )
        )  # fmt: skip
    ours = azel_from_rays(apparent_stars(catalog, TIME, site).rays_icrs @ R_enu_icrs(site, TIME).T)
    theirs = there.az.rad, there.alt.rad
    high = theirs[1] > np.radians(10.0)
    assert high.sum() > 100
    off = angle_between_rad(rays_from_azel(*ours), rays_from_azel(*theirs))[high]
    assert off.max() < 2.0 * ARCSEC_RAD


@pytest.mark.parametrize("height_m", [0.0, 2500.0])
@pytest.mark.parametrize("elevation_deg", [5.0, 7.0, 10.0, 20.0])
def test_refraction_is_that_of_a_ray_through_shells(elevation_deg: float, height_m: float) -> None:
    hpa, celsius = 900.0, 5.0
    air = Air(pressure_hpa=hpa, temperature_c=celsius, humidity_1=0.0, height_m=height_m)
    refractivity = (287.6155 + 1.62887 / 0.55**2 + 0.01360 / 0.55**4) * 1e-6 * hpa / 1013.25 * 273.15 / 278.15
    theirs = traced_lift_rad(np.radians(elevation_deg), hpa, celsius, height_m, refractivity)
    assert abs(float(air.lift_rad(np.radians(elevation_deg))) - theirs) < 0.5 * ARCSEC_RAD


@pytest.mark.parametrize("air", AIRS)
def test_apparent_and_true_elevations_are_inverse_and_increase(air: Air) -> None:
    true = np.radians(np.linspace(-90.0, 90.0, 36_001))
    apparent = air.apparent_rad(true)
    assert np.all(np.diff(apparent) > 0)
    np.testing.assert_allclose(air.true_rad(apparent), true, atol=1e-3 * ARCSEC_RAD)
    lift = apparent - true
    assert np.abs(np.diff(lift)).max() < 2.0 * 60 * ARCSEC_RAD  # no step: 0.005 degrees of elevation each
    assert lift[-1] < 1e-6 * ARCSEC_RAD


def test_refraction_at_the_horizon_is_half_a_degree() -> None:
    # Meeus (1998), Astronomical Algorithms, example 16.a: at apparent 0.5 degrees the lift is 28.754'.
    air = Air(pressure_hpa=1010.0, temperature_c=10.0, humidity_1=0.0)
    assert np.degrees(air.lift_rad(np.radians(0.5))) * 60 == pytest.approx(28.754, abs=0.6)  # weather: a tenth
    assert np.degrees(air.lift_rad(0.0)) * 60 == pytest.approx(34.0, abs=1.0)


def test_no_pressure_is_no_air() -> None:
    site = replace(KUFFNER, stated_air=Air(pressure_hpa=0.0, temperature_c=0.0))
    assert site.air is None
    catalog = load_catalog().brighter_than(3.0)
    plain, R = apparent_stars(catalog, TIME, site), R_enu_icrs(KUFFNER, TIME)
    refracted = apparent_stars(catalog, TIME, KUFFNER)
    assert KUFFNER.air is not None
    np.testing.assert_allclose(KUFFNER.air.straighten(refracted.rays_icrs, R), plain.rays_icrs, atol=1e-12)
    vacuum = Air(pressure_hpa=0.0, temperature_c=0.0)
    np.testing.assert_allclose(vacuum.apparent_rad([0.0, 0.5]), [0.0, 0.5], atol=1e-15)


@pytest.mark.parametrize(
    "wrong",
    [
        {"pressure_hpa": -1.0}, {"pressure_hpa": 2000.0}, {"temperature_c": -300.0}, {"temperature_c": 90.0},
        {"humidity_1": -0.1}, {"humidity_1": 1.1}, {"wavelength_um": 10.0}, {"pressure_hpa": float("nan")},
    ],
)  # fmt: skip
def test_impossible_air_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(BadInput, match=next(iter(wrong))):
        KUFFNER.with_air(wrong)


def test_the_moon_has_no_air_and_takes_none() -> None:
    moon = Site("moon", 0.0, 0.0)
    assert moon.air is None
    with pytest.raises(BadInput, match="Moon"):
        moon.with_air({"pressure_hpa": 1000.0})


def test_air_that_is_not_stated_is_that_of_the_height() -> None:
    low, high = Site("earth", 0.5, 0.0, 0.0).air, Site("earth", 0.5, 0.0, 2000.0).air
    assert low is not None and high is not None
    assert (low.pressure_hpa, low.temperature_c) == (1013.25, 15.0)
    # US Standard Atmosphere 1976, table I, at 2000 m.
    assert high.pressure_hpa == pytest.approx(794.95, rel=2e-3)
    assert high.temperature_c == pytest.approx(2.0, abs=0.01)
    stated = KUFFNER.with_air({"pressure_hpa": 980.0, "temperature_c": 3.0}).air
    assert stated is not None
    assert (stated.pressure_hpa, stated.temperature_c, stated.humidity_1) == (980.0, 3.0, 0.5)
    assert stated.refraction_sigma_1 < low.refraction_sigma_1


def test_planets_are_raised_as_the_stars_are() -> None:
    air, R = KUFFNER.air, R_enu_icrs(KUFFNER, TIME)
    assert air is not None
    for plain, shown in zip(bodies(KUFFNER, TIME), apparent_bodies(KUFFNER, TIME), strict=True):
        azimuth, elevation = azel_from_rays(R @ plain.ray_icrs)
        np.testing.assert_allclose(
            azel_from_rays(R @ shown.ray_icrs), (azimuth, air.apparent_rad(elevation)), atol=1e-12
        )


def test_refraction_follows_a_sky_that_turns() -> None:
    later = TIME + timedelta(hours=2)
    R_then, R_later = (R_enu_icrs(KUFFNER, when) for when in (TIME, later))
    air, rays = KUFFNER.air, apparent_stars(load_catalog().brighter_than(3.0), TIME, KUFFNER).rays_icrs
    assert air is not None
    turned = turn_sky(*azel_from_rays(rays @ R_then.T), R_later @ R_then.T, air)
    theirs = azel_from_rays(air.refract(air.straighten(rays, R_then), R_later) @ R_later.T)
    assert angle_between_rad(rays_from_azel(*turned), rays_from_azel(*theirs)).max() < 1e-9
    R = R_from_rotvec([0.0, 0.0, 0.3])
    np.testing.assert_array_equal(turn_sky(*theirs, R, None), turn_azel(*theirs, R))


def test_airmass_is_one_overhead_and_forty_at_the_horizon() -> None:
    np.testing.assert_allclose(airmass(np.radians([90, 30, 10])), [1.0, 1.995, 5.6], rtol=0.02)
    assert airmass(0.0) == airmass(-0.1) == pytest.approx(40, rel=0.01)
