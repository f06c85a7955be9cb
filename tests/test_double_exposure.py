"""Two exposures in one frame are refused; reflections of the sky and of bright stars are not."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from startrack.camera import Camera, load_camera
from startrack.catalog import StarCatalog, load_catalog
from startrack.chain import Oriented, pipeline
from startrack.chain.second_field import find_second_field
from startrack.core.types import Array, Exposure, NotLocated
from startrack.evidence import StarPhotometry
from startrack.evidence.double_exposure import DECISIVE, check_single_skyline, find_double_exposure
from startrack.frames import R_from_rotvec
from startrack.rendering import Scene, Series
from startrack.rendering.compose import ADC_MAX_ADU, light_e, read_out
from startrack.simulation import simulate_rays
from startrack.terrain import load_terrain

PLACE_M = (3000.0, -2500.0)


@pytest.fixture(scope="module")
def catalog() -> StarCatalog:
    return load_catalog().brighter_than(7.5)


@pytest.fixture(scope="module")
def camera() -> Camera:
    return replace(load_camera("fisheye-2048"), size_px=(1024, 1024), focal_px=(326.0, 326.0), centre_px=(511.5, 511.5))


@pytest.fixture(scope="module")
def scene(camera: Camera, catalog: StarCatalog) -> Scene:
    east, north = PLACE_M
    crater = load_terrain("shackleton-thesis")
    return Series(
        camera=camera, terrain=crater, catalog=catalog, seed=31, east_m=east, north_m=north, faint_v_mag=None
    ).scene(0)[0]  # fmt: skip


@pytest.fixture(scope="module")
def sky_e(scene: Scene) -> Array:
    return light_e(scene)


def expose(scene: Scene, electrons: Array) -> Exposure:
    pixels = read_out(electrons, scene.sensor, rng=np.random.default_rng(1))
    return Exposure(
        pixels_adu=pixels, name="double", time_utc=scene.time_utc, exposure_s=scene.exposure_s,
        saturation_adu=ADC_MAX_ADU,
    )  # fmt: skip


def moved(scene: Scene, east_m: float) -> Scene:
    return replace(scene, position_enu_m=scene.position_enu_m + np.array([east_m, 0.0, 0.0]))


def turned(scene: Scene, degrees: float) -> Scene:
    return replace(scene, R_cam_enu=scene.R_cam_enu @ R_from_rotvec(np.radians([0.0, 0.0, degrees])))


def locate(scene: Scene, electrons: Array, catalog: StarCatalog) -> Any:
    assert scene.terrain is not None
    return pipeline.locate(expose(scene, electrons), scene.camera, scene.terrain, catalog)


def photometry(scene: Scene, catalog: StarCatalog, rng: np.random.Generator) -> StarPhotometry:
    return simulate_rays(scene, catalog, rng=rng).photometry


def mix(first: StarPhotometry, second: StarPhotometry, part: float, rng: np.random.Generator) -> StarPhotometry:
    """Both in one exposure, the `part` of it in the first; the noise is that of one."""
    noise = np.sqrt(1.0 - part**2 - (1.0 - part) ** 2) * first.sigma_e * rng.standard_normal(len(first.star))
    return replace(first, flux_e=part * first.flux_e + (1.0 - part) * second.flux_e + noise)


def test_a_rover_that_moved_within_the_exposure_is_refused(scene: Scene, sky_e: Array, catalog: StarCatalog) -> None:
    result = locate(scene, 0.5 * (sky_e + light_e(moved(scene, 400.0))), catalog)
    assert (result.status, result.reason) == ("refused", "inconsistent_evidence")
    assert "two skylines" in result.message


@pytest.mark.parametrize("degrees", [2.0, 40.0])
def test_a_camera_that_turned_within_the_exposure_is_refused(
    scene: Scene, sky_e: Array, catalog: StarCatalog, degrees: float
) -> None:
    result = locate(scene, 0.6 * sky_e + 0.4 * light_e(turned(scene, degrees)), catalog)
    assert (result.status, result.reason) == ("refused", "inconsistent_evidence")
    assert f"turned by {degrees:.1f} degrees" in result.message


def test_a_ghost_of_the_whole_sky_changes_no_position(scene: Scene, sky_e: Array, catalog: StarCatalog) -> None:
    ghost = 0.02 * np.roll(sky_e, (9, -14), axis=(0, 1))
    clean, seen = (locate(scene, light, catalog) for light in (sky_e, sky_e + ghost))
    assert seen.status == "ok"
    apart_m = np.linalg.norm(seen.fix.position_enu_m - clean.fix.position_enu_m)
    assert apart_m < clean.fix.radius999_m


def test_a_mirrored_ghost_is_a_second_field_and_no_exposure(scene: Scene, sky_e: Array, catalog: StarCatalog) -> None:
    for brightness, is_exposure in ((0.25, False), (0.6, True)):
        mirrored = np.asarray(sky_e + brightness * sky_e[::-1, ::-1])
        found = pipeline.identify(expose(scene, mirrored), scene.camera, catalog)
        assert isinstance(found, Oriented)
        second = find_second_field(found.detections, found.camera, found.stars, found.identification)
        assert second is not None and second.is_exposure == is_exposure
        assert second.ratio == pytest.approx(brightness, rel=0.25)
        assert np.degrees(second.turn_rad) == pytest.approx(180.0, abs=0.1)


def test_a_strip_of_another_frame_is_no_second_exposure(scene: Scene, sky_e: Array, catalog: StarCatalog) -> None:
    light = sky_e.copy()
    light[500:700] = sky_e[::-1, ::-1][500:700]
    found = pipeline.identify(expose(scene, light), scene.camera, catalog)
    assert isinstance(found, Oriented)
    second = find_second_field(found.detections, found.camera, found.stars, found.identification)
    assert second is not None and second.stars > 20 and not second.is_exposure


def test_a_frame_without_unexplained_sources_is_not_searched(scene: Scene, sky_e: Array, catalog: StarCatalog) -> None:
    found = pipeline.identify(expose(scene, sky_e), scene.camera, catalog)
    assert isinstance(found, Oriented) and found.identification.unexplained < 8
    assert find_second_field(found.detections, found.camera, found.stars, found.identification) is None


@pytest.mark.slow
def test_moves_are_found_in_photometry_and_single_skylines_pass(scene: Scene, catalog: StarCatalog) -> None:
    assert scene.terrain is not None
    rng = np.random.default_rng(5)
    for _ in range(2):
        first, second = (photometry(place, catalog, rng) for place in (scene, moved(scene, 500.0)))
        check_single_skyline(first, scene.terrain, scene.position_enu_m[:2])
        for part in (0.5, 0.3):
            both = mix(first, second, part, rng)
            found = find_double_exposure(both, scene.terrain, scene.position_enu_m[:2])
            assert found is not None and found.log_odds > np.log(DECISIVE)
            apart_m = float(np.linalg.norm(found.positions_m[1] - found.positions_m[0]))
            assert apart_m == pytest.approx(500.0, rel=0.3)
            assert min(found.part, 1.0 - found.part) == pytest.approx(part, abs=0.11)
            with pytest.raises(NotLocated, match="two skylines") as refusal:
                check_single_skyline(both, scene.terrain, scene.position_enu_m[:2])
            assert refusal.value.reason == "inconsistent_evidence"


def test_missing_stars_beside_the_skyline_are_no_second_skyline(scene: Scene, catalog: StarCatalog) -> None:
    """An obstacle hides stars, but dims none: the skyline of 60 degrees of azimuth stands 1.5 degrees too high."""
    assert scene.terrain is not None
    rng = np.random.default_rng(6)
    light, position_m = photometry(scene, catalog, rng), scene.position_enu_m[:2]
    above = light.elevation_rad - scene.terrain.horizon_rad(position_m[None], light.azimuth_rad)
    behind = (above > 0) & (above < np.radians(1.5)) & (light.azimuth_rad < np.radians(60.0))
    hidden = replace(light, flux_e=np.where(behind, light.sigma_e * rng.standard_normal(len(behind)), light.flux_e))
    check_single_skyline(hidden, scene.terrain, position_m)
