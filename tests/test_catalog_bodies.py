"""Sun, planets, Earth and Moon in the sky of a site, against DE440 through another program, and against Skyfield."""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from sky_helpers import skyfield_moon

from startrack.catalog import bodies, daylight_warnings
from startrack.core.types import BadInput
from startrack.frames import R_enu_icrs, Site, angle_between_rad, parse_utc, rays_from_azel

ARCSEC_RAD = np.radians(1 / 3600)
DATA = Path(__file__).parent / "data"
MOON_SITES = [Site("moon", np.radians(-89.66), np.radians(129.78)), Site("moon", 0.3, 1.1)]
EARTH_SITES = [Site("earth", np.radians(48.2), np.radians(16.3), 300.0), Site("earth", -1.2, -2.0)]
# 2025-03-23 has Venus at inferior conjunction, 166 degrees of phase; 2009-09-04 the rings of Saturn edge-on.
TIMES = [parse_utc(t) for t in ("2009-09-04T00:00", "2020-07-20T12:00", "2025-03-23T01:00", "2031-11-05T06:00")]
THEIR_NAMES = {
    "Sun": "sun", "Mercury": "mercury", "Venus": "venus", "Earth": "earth", "Moon": "moon", "Mars": "mars",
    "Jupiter": "jupiter barycenter", "Saturn": "saturn barycenter", "Uranus": "uranus barycenter",
    "Neptune": "neptune barycenter",
}  # fmt: skip


def skyfield_position(site: Site, time: datetime, name: str):
    """Skyfield's astrometric position of the body from the site."""
    from skyfield.api import load, wgs84

    (ephemeris, constants), timescale = skyfield_moon(), load.timescale(builtin=True)
    latitude, longitude = np.degrees([site.latitude_rad, site.longitude_rad])
    if site.body == "earth":
        place = ephemeris["earth"] + wgs84.latlon(latitude, longitude, site.height_m)
    else:
        frame = constants.build_frame_named("MOON_ME_DE421")
        place = ephemeris["moon"] + constants.build_latlon_degrees(frame, latitude, longitude, site.height_m)
    return place.at(timescale.from_datetime(time)).observe(ephemeris[THEIR_NAMES[name]])


def test_sun_and_earth_agree_with_de440_at_lunar_sites() -> None:
    for row in json.loads((DATA / "sun_earth_topocentric_de440.json").read_text())["rows"]:
        time = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(milliseconds=row["ms"])
        site = Site("moon", np.radians(row["lat"]), np.radians(row["lon"]))
        sky = {body.name: body for body in bodies(site, time)}
        for name in ("Sun", "Earth"):
            ours = R_enu_icrs(site, time) @ sky[name].ray_icrs
            theirs = rays_from_azel(*np.radians(row[name.lower()]))
            assert angle_between_rad(ours, theirs) < 0.15 * ARCSEC_RAD


@pytest.mark.parametrize("time", TIMES)
@pytest.mark.parametrize("site", MOON_SITES + EARTH_SITES)
def test_apparent_directions_agree_with_skyfield(site: Site, time: datetime) -> None:
    sky = bodies(site, time)
    sun_ray = sky[0].ray_icrs
    for body in sky:
        theirs_m = skyfield_position(site, time, body.name).apparent().position.m
        # The Sun bends light by 1.8 arcsec at its edge and 0.1 at five degrees; that is left out.
        near_sun = 0 < angle_between_rad(body.ray_icrs, sun_ray) < np.radians(10)
        assert angle_between_rad(body.ray_icrs, theirs_m) < (2 if near_sun else 0.05) * ARCSEC_RAD, body.name


@pytest.mark.parametrize("time", TIMES)
@pytest.mark.parametrize("site", [MOON_SITES[0], EARTH_SITES[0]])
def test_azimuth_and_elevation_agree_with_skyfield(site: Site, time: datetime) -> None:
    R = R_enu_icrs(site, time)
    for body in bodies(site, time)[3:]:
        elevation, azimuth, _ = skyfield_position(site, time, body.name).apparent().altaz()
        theirs = rays_from_azel(azimuth.radians, elevation.radians)
        # With another table of UT1 and no polar motion, Skyfield's Earth rotation differs by up to 0.3 s from ours.
        limit_arcsec = 0.2 if site.body == "moon" else 5
        assert angle_between_rad(R @ body.ray_icrs, theirs) < limit_arcsec * ARCSEC_RAD, body.name


@pytest.mark.parametrize("time", TIMES)
@pytest.mark.parametrize("site", [MOON_SITES[0], EARTH_SITES[0]])
def test_magnitudes_agree_with_skyfield(site: Site, time: datetime) -> None:
    from skyfield.magnitudelib import planetary_magnitude

    for body in bodies(site, time):
        if body.name in ("Sun", "Moon"):
            continue
        position = skyfield_position(site, time, body.name)
        # Skyfield takes the barycentre for the Sun, worth 0.1 mag of Mercury: give it the Sun for a barycentre.
        position.center_barycentric = position.center_barycentric - skyfield_moon()[0]["sun"].at(position.t)
        assert body.v_mag == pytest.approx(planetary_magnitude(position), abs=0.005), body.name


def test_magnitudes_of_sun_and_moon_are_the_known_ones() -> None:
    # Full on 2024-04-23 23:49 UTC, last quarter on 2024-05-01 11:27 UTC; V of the mean full Moon -12.7, and 2.6
    # less at a quarter (Allen, Astrophysical Quantities); V of the Sun -26.74 to -26.76 at 1 au.
    full = {b.name: b.v_mag for b in bodies(EARTH_SITES[0], parse_utc("2024-04-23T23:49"))}
    quarter = {b.name: b.v_mag for b in bodies(EARTH_SITES[0], parse_utc("2024-05-01T11:27"))}
    assert full["Moon"] == pytest.approx(-12.7, abs=0.25)
    assert quarter["Moon"] - full["Moon"] == pytest.approx(2.6, abs=0.4)
    assert full["Sun"] == pytest.approx(-26.75, abs=0.05)


def test_earthlight_at_the_lunar_pole_is_as_bright_as_it_should_be() -> None:
    # New Moon on 2024-05-08 03:22 UTC is full Earth, about -17 from the Moon.
    sky = {b.name: b.v_mag for b in bodies(MOON_SITES[0], parse_utc("2024-05-08T03:22"))}
    assert sky["Earth"] == pytest.approx(-16.9, abs=0.2)


@pytest.mark.parametrize("site", MOON_SITES + EARTH_SITES)
def test_a_sites_own_body_is_not_listed(site: Site) -> None:
    names = [body.name for body in bodies(site, TIMES[0])]
    assert len(names) == len(set(names)) == 9
    assert site.body.capitalize() not in names
    assert names[0] == "Sun"


@pytest.mark.parametrize("year", range(1901, 2051, 15))
def test_every_body_is_there_throughout_the_ephemeris(year: int) -> None:
    for site in (MOON_SITES[0], EARTH_SITES[0]):
        for body in bodies(site, datetime(year, 1, 1, tzinfo=UTC)):
            assert np.linalg.norm(body.ray_icrs) == pytest.approx(1, abs=1e-14)
            assert -30 < body.v_mag < 9


def test_bodies_outside_the_ephemeris_are_refused() -> None:
    with pytest.raises(BadInput, match="outside 1900 to 2051"):
        bodies(MOON_SITES[0], datetime(1850, 1, 1, tzinfo=UTC))


def test_the_sun_above_a_horizon_of_the_earth_is_named():
    """Its elevation by astropy, every two hours of a day."""
    from astropy.coordinates import AltAz, EarthLocation, get_sun
    from astropy.time import Time

    site = Site("earth", np.radians(36.6), np.radians(-84.2), 300.0)
    place = EarthLocation.from_geodetic(-84.2, 36.6, 300.0)
    by_day = 0
    for hour in range(0, 24, 2):
        time = datetime(2026, 7, 10, hour, tzinfo=UTC)
        elevation = float(get_sun(Time(time)).transform_to(AltAz(obstime=Time(time), location=place)).alt.deg)
        warnings = daylight_warnings(site, time)
        assert len(warnings) == (elevation > 0.0)
        if warnings:
            assert abs(float(warnings[0].split("Sun stands ")[1].split()[0]) - elevation) < 0.6
            by_day += 1
    assert by_day == 7
    moon = Site("moon", -1.5, 0.0)
    assert daylight_warnings(moon, datetime(2026, 7, 10, 17, tzinfo=UTC)) == []
