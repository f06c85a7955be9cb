"""The whole chain on one rendered exposure, and on disturbed versions of it."""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from startrack.catalog import StarCatalog, load_catalog
from startrack.chain import Located, Outcome, pipeline
from startrack.core.types import Exposure
from startrack.frames import R_enu_icrs, azel_from_rays

ARCSEC = np.pi / 648_000
EVERY_CHI2_2DOF = 18.4  # 99.99 %


@pytest.fixture(scope="module")
def catalog() -> StarCatalog:
    return load_catalog().brighter_than(7.0)


def locate_again(located: Any, catalog: StarCatalog, pixels: np.ndarray | None = None, **terrain: float) -> Outcome:
    """The same exposure located once more, with other pixels or in another crater."""
    known = located.result
    exposure = known.exposure if pixels is None else replace(known.exposure, pixels_adu=pixels.astype(np.float32))
    return pipeline.locate(exposure, known.camera, replace(known.terrain, **terrain), catalog)


def miss(result: Outcome, located: Any) -> np.ndarray:
    """East and north error [m]; the status must be ok."""
    assert isinstance(result, Located) and result.status == "ok", result.message
    return result.fix.position_enu_m[:2] - located.truth.position_enu_m[:2]


def covers_truth(result: Outcome, located: Any) -> bool:
    """Whether the stated covariance and the 99.9 % circle hold the truth."""
    error, fix = miss(result, located), result.fix
    nees = error @ np.linalg.solve(fix.covariance_m2, error)
    return bool(nees < EVERY_CHI2_2DOF and np.linalg.norm(error) < fix.radius999_m)


def directions(located: Any) -> tuple[np.ndarray, np.ndarray]:
    """Azimuth and elevation [rad] of every pixel (H, W)."""
    known = located.result
    width, height = known.camera.size_px
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    rays = known.camera.unproject(np.stack([x, y], axis=-1).astype(float))
    return azel_from_rays(rays @ (known.attitude.R_cam_icrs @ known.R_enu_icrs.T))


def test_position_and_attitude_are_within_the_stated_errors(located: Any) -> None:
    result, truth = located.result, located.truth
    assert covers_truth(result, located)
    assert np.linalg.norm(miss(result, located)) < 12.0  # m; a perfect list of magnitude 6 allows 18 on average
    assert result.fix.radius95_m < 25.0
    assert result.fix.position_enu_m[2] == truth.position_enu_m[2]
    w = Rotation.from_matrix(truth.R_cam_icrs @ result.attitude.R_cam_icrs.T).as_rotvec()
    assert np.linalg.norm(w) < 8 * ARCSEC
    assert w @ np.linalg.solve(result.attitude.covariance_rad2, w) < 21.1  # 99.99 % of chi^2 with 3
    assert result.attitude_fit.rms_px < 0.3
    assert result.identification.false_alarm_probability < 1e-100
    assert len(result.identification) > 200
    assert set(result.timing_ms) == {"detect", "identify", "attitude", "evidence", "locate"}
    assert result.message == ""
    assert result.reason is None


def test_the_same_input_gives_the_same_answer(located: Any, catalog: StarCatalog) -> None:
    once, twice = locate_again(located, catalog), located.result
    assert np.array_equal(once.fix.position_enu_m, twice.fix.position_enu_m)
    assert np.array_equal(once.fix.covariance_m2, twice.fix.covariance_m2)
    assert np.array_equal(once.attitude.R_cam_icrs, twice.attitude.R_cam_icrs)


def test_rotating_the_camera_rotates_the_attitude_and_keeps_the_position(located: Any, catalog: StarCatalog) -> None:
    turned = locate_again(located, catalog, np.rot90(located.result.exposure.pixels_adu))
    assert covers_truth(turned, located)
    assert np.linalg.norm(miss(turned, located) - miss(located.result, located)) < 3.0
    # The picture rotated counter-clockwise by 90 degrees: the right side, cam x, is now at the top, -cam y.
    quarter = Rotation.from_euler("z", -90, degrees=True).as_matrix()
    off = quarter @ located.result.attitude.R_cam_icrs @ turned.attitude.R_cam_icrs.T
    assert Rotation.from_matrix(off).magnitude() < 5 * ARCSEC


def test_a_mirrored_picture_is_refused_as_such(located: Any, catalog: StarCatalog) -> None:
    result = locate_again(located, catalog, located.result.exposure.pixels_adu[:, ::-1])
    assert (result.status, result.reason) == ("refused", "mirrored")
    assert "set mirrored = true" in result.message
    upside_down = replace(located.result.exposure, pixels_adu=located.result.exposure.pixels_adu[::-1])
    result = pipeline.identify(replace(upside_down, row_order="BOTTOM-UP"), located.result.camera, catalog)
    assert result.reason == "mirrored"
    assert "ROWORDER in its header is BOTTOM-UP" in result.message and "Flip the rows" in result.message


@pytest.mark.parametrize(
    "terrain", [{"depth_m": 1800.0}, {"depth_m": 2200.0}, {"diameter_m": 23e3, "search_radius_m": 11.5e3}], ids=str
)
def test_the_wrong_crater_is_refused(located: Any, catalog: StarCatalog, terrain: dict[str, float]) -> None:
    result = locate_again(located, catalog, **terrain)
    assert (result.status, result.reason) == ("refused", "inconsistent_evidence")


@pytest.mark.parametrize("error", [-0.003, 0.0, 0.003])
def test_a_depth_that_is_not_stated_is_estimated(located: Any, catalog: StarCatalog, error: float) -> None:
    depth_m = located.result.terrain.depth_m
    found = locate_again(located, catalog, depth_m=depth_m * (1 + error), depth_sigma_m=None)
    assert isinstance(found, Located), found.message
    assert covers_truth(found, located)
    assert [one.value for one in found.fix.shown] == ([pytest.approx(-error, abs=0.0015)] if error else [])
    assert any("depth" in warning for warning in found.warnings) == bool(error)


@pytest.mark.parametrize("error", [-0.006, -0.003, 0.003, 0.006])
def test_a_stated_depth_that_the_light_of_the_sky_contradicts_is_refused(
    located: Any, catalog: StarCatalog, error: float
) -> None:
    """What a file denies is answered where it matters little, or where the light is taken to end beside the skyline."""
    depth_m = located.result.terrain.depth_m
    result = locate_again(located, catalog, depth_m=depth_m * (1 + error), depth_sigma_m=0.0)
    if isinstance(result, Located):
        away = np.linalg.norm(result.fix.position_enu_m[:2] - located.truth.position_enu_m[:2])
        assert (abs(error) < 0.005 or result.sky_at_skyline is None) and away < 2 * result.fix.radius999_m
    else:
        assert result.reason == "inconsistent_evidence"


def test_a_position_beyond_the_search_area_is_refused(located: Any, catalog: StarCatalog) -> None:
    result = locate_again(located, catalog, search_radius_m=4000.0)  # the camera is 6.5 km from the middle
    assert (result.status, result.reason) == ("refused", "outside_search_area")
    assert "4000 m" in result.message


def test_hot_pixels_do_not_shift_the_position(located: Any, catalog: StarCatalog) -> None:
    rng = np.random.default_rng(1)
    pixels = located.result.exposure.pixels_adu.copy()
    x, y = rng.integers(0, 1024, (2, 600))
    pixels[y, x] += rng.uniform(500, 50_000, 600)
    result = locate_again(located, catalog, np.minimum(pixels, 65535))
    assert covers_truth(result, located)
    assert np.linalg.norm(miss(result, located) - miss(located.result, located)) < 3.0


@pytest.mark.parametrize("width_deg", [5, 20])
def test_a_boulder_does_not_shift_the_position(located: Any, catalog: StarCatalog, width_deg: float) -> None:
    rng = np.random.default_rng(2)
    azimuth, elevation = directions(located)
    pixels = located.result.exposure.pixels_adu.copy()
    wall = pixels[(elevation > 0) & (elevation < np.radians(3))]
    boulder = (np.degrees(azimuth) < width_deg) & (elevation < np.radians(35))
    pixels[boulder] = rng.choice(wall, boulder.sum())
    result = locate_again(located, catalog, pixels)
    assert covers_truth(result, located)
    assert np.linalg.norm(miss(result, located) - miss(located.result, located)) < 6.0


def test_glow_over_a_part_of_the_picture_only_increases_the_uncertainty(located: Any, catalog: StarCatalog) -> None:
    y, x = np.mgrid[:1024, :1024]
    glow = 2000.0 * np.exp(-((x - 300) ** 2 + (y - 700) ** 2) / 2 / 150.0**2)
    rng = np.random.default_rng(3)
    result = locate_again(located, catalog, located.result.exposure.pixels_adu + rng.poisson(glow))
    assert covers_truth(result, located)


def test_a_lens_cap_and_a_foreign_picture_are_refused(located: Any, catalog: StarCatalog) -> None:
    rng = np.random.default_rng(4)
    dark = np.rint(rng.normal(103, 3, (1024, 1024)))
    capped = locate_again(located, catalog, dark)
    assert (capped.status, capped.reason) in {("refused", "no_stars"), ("refused", "not_identified")}
    lamps = dark.copy()
    for x, y in rng.integers(40, 980, (60, 2)):
        lamps[y - 1 : y + 2, x - 1 : x + 2] += [[60, 200, 60], [200, 700, 200], [60, 200, 60]]
    strange = locate_again(located, catalog, lamps)
    assert (strange.status, strange.reason) == ("refused", "not_identified")


def test_what_is_missing_or_does_not_fit_is_named(located: Any, catalog: StarCatalog) -> None:
    known = located.result
    timeless = pipeline.locate(replace(known.exposure, time_utc=None), known.camera, known.terrain, catalog)
    assert (timeless.status, timeless.reason) == ("refused", "no_time")
    small = Exposure(pixels_adu=known.exposure.pixels_adu[:-1], time_utc=known.exposure.time_utc)
    cut = pipeline.locate(small, known.camera, known.terrain, catalog)
    assert (cut.status, cut.reason) == ("refused", "size_mismatch")
    assert "1024 x 1023" in cut.message


def test_identify_without_a_time_states_a_larger_sigma(located: Any, catalog: StarCatalog) -> None:
    known = located.result
    result = pipeline.identify(replace(known.exposure, time_utc=None), known.camera, catalog)
    assert result.status == "ok"
    sigma = np.sqrt(np.diag(result.attitude.covariance_rad2)) / ARCSEC
    assert sigma == pytest.approx([60.0] * 3, abs=2.0)
    w = Rotation.from_matrix(located.truth.R_cam_icrs @ result.attitude.R_cam_icrs.T).as_rotvec()
    assert 1 * ARCSEC < np.linalg.norm(w) < 60 * ARCSEC  # aberration is left out


def test_detect_needs_no_camera(located: Any) -> None:
    result = pipeline.detect(located.result.exposure, None)
    assert result.status == "ok"
    assert len(result.detections) == pytest.approx(len(located.result.detections), rel=0.1)
    assert result.detections.psf_sigma_px == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("shift_px", [(0.0, 0.0), (0.9, -0.6), (-2.5, 1.5)])
def test_a_sensor_that_has_moved_is_noticed_and_does_not_move_the_fix(located, catalog, shift_px):
    known = located.result
    stated = replace(known.camera, centre_px=tuple(np.add(known.camera.centre_px, shift_px).tolist()))
    result = pipeline.locate(known.exposure, stated, known.terrain, catalog)
    assert result.status == "ok"
    off = result.fix.position_enu_m[:2] - located.truth.position_enu_m[:2]
    assert np.hypot(*off) < result.fix.radius999_m
    np.testing.assert_allclose(result.camera.centre_px, known.camera.centre_px, atol=0.15)
    assert (result.lens_change_px > 0.0) == any(shift_px)
    assert any("differs from the camera file" in text for text in result.warnings) == any(shift_px)


def test_a_value_at_a_later_time_has_the_sky_of_that_time(located):
    known, seconds = located.result, 3600.0
    later = known.later(seconds, 60.0)
    R = R_enu_icrs(known.site, known.exposure.time_utc + timedelta(seconds=seconds))
    np.testing.assert_allclose(later.R_enu_icrs, R, atol=1e-6)
    azimuth, elevation = azel_from_rays(known.stars.rays_icrs[known.photometry.star] @ R.T)
    np.testing.assert_allclose(later.photometry.elevation_rad, elevation, atol=1e-6)
    np.testing.assert_allclose(np.cos(later.photometry.azimuth_rad - azimuth), 1.0, atol=1e-9)
    assert (later.clock.offset_s, later.clock.reach_s) == (seconds, 60.0)


def test_a_clock_of_ten_minutes_widens_the_circle_along_the_wall(located, catalog):
    known = located.result
    exposure = replace(known.exposure, time_sigma_s=600.0)
    result = pipeline.locate(exposure, known.camera, known.terrain, catalog)
    off = result.fix.position_enu_m[:2] - located.truth.position_enu_m[:2]
    assert np.hypot(*off) < result.fix.radius95_m
    assert result.fix.radius95_m > 3 * known.fix.radius95_m
    assert result.fix.clock.sigma_s == pytest.approx(600.0, rel=0.02)
