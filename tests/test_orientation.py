"""Orientation and motion of Moon and Earth, against an independent program, Skyfield, astropy and physical laws."""

from __future__ import annotations

import json
import multiprocessing
import os
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from sky_helpers import skyfield_moon

from startrack.core.types import BadInput
from startrack.frames import (
    R_enu_fixed,
    R_enu_icrs,
    R_from_quat_xyzw,
    R_mcmf_icrs,
    Site,
    aberrate,
    angle_between_rad,
    et_s,
    observer_state,
    observer_velocity_m_s,
    orientation,
    parse_utc,
    rays_from_azel,
)
from startrack.frames.orientation import R_itrs_icrs

ARCSEC_RAD = np.radians(1 / 3600)
DATA = Path(__file__).parent / "data"
SHACKLETON = Site("moon", np.radians(-89.66), np.radians(129.78))
KUFFNER = Site("earth", np.radians(48.2128), np.radians(16.2914), 300.0)
TIMES = [
    parse_utc(t) for t in ("1985-03-04T05:06:07", "2016-12-31T23:59:59", "2024-06-01T00:00:00.5", "2026-02-03T20:00")
]


def rotation_angle_rad(R: np.ndarray, S: np.ndarray) -> float:
    """Angle of the rotation that leads from S to R."""
    D = R @ S.T
    return float(np.arctan2(np.linalg.norm([D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1]]), np.trace(D) - 1))


# --- the Moon -------------------------------------------------------------------------------------------------------


def test_moon_orientation_agrees_with_an_independent_renderer() -> None:
    record = json.loads((DATA / "independent_orientation.json").read_text())
    site = Site("moon", *np.radians([record["site"]["latitude_deg"], record["site"]["longitude_deg"]]))
    for frame in record["frames"]:
        R_enu_cam = np.array(frame["R_cam_enu"]).T
        theirs = R_enu_cam @ R_from_quat_xyzw(frame["quat_xyzw_cam_icrs"])
        assert rotation_angle_rad(R_enu_icrs(site, parse_utc(frame["time_utc"])), theirs) < 1e-3 * ARCSEC_RAD


@pytest.mark.parametrize("time", TIMES)
def test_moon_orientation_agrees_with_skyfield(time: datetime) -> None:
    from skyfield.api import load

    frame = skyfield_moon()[1].build_frame_named("MOON_ME_DE421")
    theirs = frame.rotation_at(load.timescale(builtin=True).from_datetime(time))
    assert rotation_angle_rad(R_mcmf_icrs(time), theirs) < 1e-3 * ARCSEC_RAD


def test_zenith_of_shackleton_is_near_the_south_ecliptic_pole() -> None:
    obliquity_rad = np.radians(23.4393)
    south_ecliptic_pole = [0, np.sin(obliquity_rad), -np.cos(obliquity_rad)]
    months = [datetime(2024, 1, 1, tzinfo=UTC) + timedelta(days=d) for d in range(0, 3650, 61)]
    zeniths = np.array([R_enu_icrs(SHACKLETON, t)[2] for t in months])
    assert np.degrees(angle_between_rad(zeniths, south_ecliptic_pole)).max() < 1.95


@pytest.mark.parametrize("time", TIMES)
def test_moon_velocity_agrees_with_skyfield(time: datetime) -> None:
    from skyfield.api import load

    ephemeris, constants = skyfield_moon()
    frame = constants.build_frame_named("MOON_ME_DE421")
    site = Site("moon", 0.3, 1.1)
    place = constants.build_latlon_degrees(frame, np.degrees(0.3), np.degrees(1.1))
    theirs = (ephemeris["moon"] + place).at(load.timescale(builtin=True).from_datetime(time))
    position_m, velocity_m_s = observer_state(site, time)
    assert np.linalg.norm(velocity_m_s - theirs.velocity.km_per_s * 1e3) < 1e-2
    assert np.linalg.norm(position_m - theirs.position.m) < 100  # both clocks are good to a millisecond at 30 km/s


# --- the Earth ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("time", TIMES)
@pytest.mark.parametrize("site", [KUFFNER, Site("earth", np.radians(-70.0), np.radians(-120.0), 3000.0)])
def test_stars_on_earth_agree_with_astropy(site: Site, time: datetime) -> None:
    from astropy import units as u
    from astropy.coordinates import AltAz, EarthLocation, SkyCoord, get_sun
    from astropy.time import Time
    from astropy.utils import iers

    v = np.random.default_rng(2).normal(size=(40, 3))
    rays = v / np.linalg.norm(v, axis=1, keepdims=True)
    ours = aberrate(rays, observer_velocity_m_s(site, time)) @ R_enu_icrs(site, time).T
    with iers.conf.set_temp("auto_download", False):
        place = EarthLocation.from_geodetic(site.longitude_rad * u.rad, site.latitude_rad * u.rad, site.height_m * u.m)
        when = Time(time.replace(tzinfo=None), scale="utc")
        stars = SkyCoord(rays, representation_type="cartesian", frame="icrs").represent_as("unitspherical")
        seen = SkyCoord(stars, frame="icrs").transform_to(AltAz(obstime=when, location=place, pressure=0 * u.hPa))
        away_from_sun = angle_between_rad(rays, get_sun(when).cartesian.xyz.value) > np.radians(30)
    theirs = rays_from_azel(seen.az.rad, seen.alt.rad)
    assert away_from_sun.sum() > 25
    # The Sun bends light by up to 15 mas at 30 degrees; this is neglected.
    assert angle_between_rad(ours, theirs)[away_from_sun].max() < 0.03 * ARCSEC_RAD


@pytest.mark.parametrize("time", TIMES)
def test_earth_velocity_agrees_with_astropy(time: datetime) -> None:
    from astropy import units as u
    from astropy.coordinates import EarthLocation, get_body_barycentric_posvel
    from astropy.time import Time
    from astropy.utils import iers

    with iers.conf.set_temp("auto_download", False):
        when = Time(time.replace(tzinfo=None), scale="utc")
        place = EarthLocation.from_geodetic(16.2914 * u.deg, 48.2128 * u.deg, 300 * u.m)
        theirs = get_body_barycentric_posvel("earth", when)[1].xyz + place.get_gcrs_posvel(when)[1].xyz
    assert np.linalg.norm(observer_velocity_m_s(KUFFNER, time) - theirs.to_value(u.m / u.s)) < 0.05


def test_earth_orientation_crosses_a_leap_second_with_astropy() -> None:
    import erfa
    from astropy.time import Time
    from astropy.utils import iers

    for hours in (-13, -1, 1, 13):
        time = datetime(2017, 1, 1, tzinfo=UTC) + timedelta(hours=hours)
        with iers.conf.set_temp("auto_download", False):
            when = Time(time.replace(tzinfo=None), scale="utc")
            x, y = (float(angle.to_value("rad")) for angle in iers.earth_orientation_table.get().pm_xy(when))
            theirs = erfa.c2t06a(when.tt.jd1, when.tt.jd2, when.ut1.jd1, when.ut1.jd2, x, y)
        assert rotation_angle_rad(R_itrs_icrs(time), theirs) < 5e-3 * ARCSEC_RAD


@pytest.mark.parametrize("time", [datetime(1965, 5, 6, tzinfo=UTC), datetime(2045, 5, 6, tzinfo=UTC)])
def test_earth_beyond_the_table_degrades_but_answers(time: datetime) -> None:
    import erfa

    days = (time - datetime(2000, 1, 1, 12, tzinfo=UTC)) / timedelta(days=1)
    ut1_as_utc = erfa.c2t06a(2451545.0, days, 2451545.0, days, 0.0, 0.0)
    assert rotation_angle_rad(R_itrs_icrs(time), ut1_as_utc) < 15 * ARCSEC_RAD


# --- laws on both bodies --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("time", TIMES)
@pytest.mark.parametrize("site", [SHACKLETON, KUFFNER, Site("moon", np.pi / 2, 0.0), Site("earth", 0.0, 7.0)])
def test_orientation_is_a_proper_rotation(site: Site, time: datetime) -> None:
    R = R_enu_icrs(site, time)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(R) == pytest.approx(1, abs=1e-14)


@pytest.mark.parametrize("site", [Site("moon", 0.4, 2.0), Site("earth", 0.4, 2.0, 500.0)])
def test_velocity_is_the_derivative_of_position(site: Site) -> None:
    time, step = TIMES[2], timedelta(seconds=30)
    before_m, after_m = observer_state(site, time - step)[0], observer_state(site, time + step)[0]
    slope_m_s = (after_m - before_m) / 60
    assert np.linalg.norm(slope_m_s - observer_velocity_m_s(site, time)) < 0.01


def test_any_time_zone_names_the_same_instant() -> None:
    from datetime import timezone

    local = TIMES[2].astimezone(timezone(timedelta(hours=-7)))
    np.testing.assert_array_equal(R_enu_icrs(SHACKLETON, local), R_enu_icrs(SHACKLETON, TIMES[2]))


def test_dynamical_time_is_ahead_by_the_leap_seconds() -> None:
    # TT - UTC was 32.184 s + 37 s in 2024 and 32.184 s + 10 s on 1972-01-01; TDB - TT stays below 2 ms.
    noon = datetime(2000, 1, 1, 12, tzinfo=UTC)
    for time, ahead_s in ((datetime(2024, 1, 1, tzinfo=UTC), 69.184), (datetime(1972, 1, 1, tzinfo=UTC), 42.184)):
        assert et_s(time) - (time - noon).total_seconds() == pytest.approx(ahead_s, abs=2e-3)


# --- refusals and the process ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("year", [1, 1899, 2055, 9999])
@pytest.mark.parametrize("site", [SHACKLETON, KUFFNER])
def test_times_outside_the_ephemeris_are_refused(site: Site, year: int) -> None:
    with pytest.raises(BadInput, match="outside 1900 to 2051") as error:
        R_enu_icrs(site, datetime(year, 6, 1, tzinfo=UTC))
    assert error.value.reason == "no_time"


def test_a_time_without_zone_is_refused() -> None:
    with pytest.raises(ValueError, match="no time zone"):
        R_enu_icrs(SHACKLETON, datetime(2026, 6, 1))


def test_a_missing_kernel_names_the_package_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(orientation, "find_spec", lambda name: None if name == "lunarsky" else find_spec(name))
    with pytest.raises(RuntimeError, match=r"moon_080317\.tf is missing: install the package lunarsky"):
        orientation._kernel_paths.__wrapped__()


def test_an_error_inside_spice_leaves_as_one_line() -> None:
    with pytest.raises(RuntimeError, match="SPICE") as error:
        orientation.barycentric_state(-12345, 0.0)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 300


def _orientations(start: int) -> np.ndarray:
    # Years apart, so that every call reads another record of the files.
    times = [datetime(1910 + (start + 7 * i) % 130, 1 + i % 12, 3, tzinfo=UTC) for i in range(60)]
    return np.array([np.append(R_mcmf_icrs(t).ravel(), observer_state(SHACKLETON, t)[0]) for t in times])


def test_threads_share_the_kernels() -> None:
    alone = [_orientations(start) for start in range(6)]
    with ThreadPoolExecutor(6) as pool:
        together = list(pool.map(_orientations, range(6)))
    np.testing.assert_array_equal(together, alone)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the platform has no fork")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_forked_processes_do_not_disturb_each_other() -> None:
    alone = [_orientations(start) for start in range(6)]
    with multiprocessing.get_context("fork").Pool(3) as pool:
        pending = pool.map_async(_orientations, range(6))
        here = [_orientations(start) for start in range(6)]
        there = pending.get(60)
    np.testing.assert_array_equal(here, alone)
    np.testing.assert_array_equal(there, alone)


def test_enu_axes_point_east_north_and_up() -> None:
    # On the equator at longitude 0: up is x, east is y, north is z of the body-fixed frame.
    np.testing.assert_allclose(R_enu_fixed(Site("moon", 0.0, 0.0)), [[0, 1, 0], [0, 0, 1], [1, 0, 0]], atol=1e-15)
