"""The chain on the Earth: pictures rendered below its air are located, and not without the air."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from typing import Any

import numpy as np
import pytest

from startrack.camera import REFRACTION_CONTAINED, camera_from_dict, camera_to_dict, load_camera
from startrack.catalog import load_catalog, sun_elevation_rad
from startrack.chain import Located, Outcome, Refused, Settings, locate
from startrack.core.types import Array, BadInput
from startrack.frames import LOWEST_PREDICTED_RAD, Air, Site
from startrack.rendering import Scene, Series, render
from startrack.simulation import simulate_rays
from startrack.terrain import Cylinder, terrain_from_dict

SITE = Site("earth", np.radians(-30.24), np.radians(-70.75), 2200.0)
NO_AIR = Air(pressure_hpa=0.0, temperature_c=0.0)
CRATER = Cylinder(name="crater", site=SITE, diameter_m=20e3, depth_m=2000.0, camera_height_m=1.5, search_radius_m=10e3)
SETTINGS = Settings(deep_stars=False)
EVERY_CHI2_2DOF = 18.4  # 99.99 %


def picture(seed: int, terrain: Cylinder = CRATER, **given: Any) -> tuple[Scene, Any]:
    series = Series(camera=load_camera("fisheye-2048"), terrain=terrain, catalog=load_catalog(), seed=seed, **given)
    scene, rng = series.scene(0)
    return scene, render(scene, rng=rng)[0]


def solve(exposure: Any, terrain: Cylinder) -> Outcome:
    return locate(exposure, load_camera("fisheye-2048"), terrain, load_catalog(), SETTINGS)


def miss_m(outcome: Outcome, scene: Scene) -> Array:
    assert isinstance(outcome, Located), outcome.message
    return np.asarray(outcome.fix.position_enu_m[:2] - scene.position_enu_m[:2])


def nees(outcome: Any, error_m: Array) -> float:
    return float(error_m @ np.linalg.solve(outcome.fix.covariance_m2, error_m))


def test_a_picture_below_the_air_is_located_with_the_air_alone() -> None:
    scene, exposure = picture(100)
    outcome = solve(exposure, CRATER)
    error = miss_m(outcome, scene)
    assert np.linalg.norm(error) < 15.0
    assert nees(outcome, error) < EVERY_CHI2_2DOF
    assert outcome.warnings == []
    without = solve(exposure, replace(CRATER, site=replace(SITE, stated_air=NO_AIR)))
    if without.status == "ok":  # the light, which shows the air too, does not count
        assert without.sky_at_skyline is None and np.linalg.norm(miss_m(without, scene)) < without.fix.radius999_m
    else:
        assert without.reason == "inconsistent_evidence"


def test_pictures_are_drawn_at_night_and_times_of_the_moon_as_before() -> None:
    def times(terrain: Cylinder) -> list[datetime]:
        series = Series(camera=load_camera("fisheye-2048"), terrain=terrain, catalog=load_catalog(), seed=5)
        return [series.pose(number).time_utc for number in range(12)]

    assert max(sun_elevation_rad(SITE, time) for time in times(CRATER)) < np.radians(-18.0)
    on_moon = times(replace(CRATER, site=Site("moon", 0.3, 0.5)))
    assert on_moon != times(CRATER)
    dark = [sun_elevation_rad(SITE, time) < np.radians(-18.0) for time in on_moon]
    assert [time in times(CRATER) for time in on_moon] == dark


def test_the_sidecars_air_replaces_the_terrains() -> None:
    cold = {"pressure_hpa": 800.0, "temperature_c": -30.0}  # 13 % more refraction than in the standard atmosphere
    scene, exposure = picture(101, replace(CRATER, site=SITE.with_air(cold)))
    stated = solve(replace(exposure, air=cold), CRATER)
    error = miss_m(stated, scene)
    assert np.linalg.norm(error) < 15.0
    assert nees(stated, error) < EVERY_CHI2_2DOF
    assert stated.terrain.air == SITE.with_air(cold).air
    moon = replace(CRATER, site=Site("moon", -1.5, 0.0))
    assert solve(replace(exposure, air=cold), moon).reason == "bad_terrain"


def test_a_terrain_file_states_the_air() -> None:
    file = {
        "body": "earth", "origin": {"latitude_deg": 40.0, "longitude_deg": 10.0, "height_m": 1000.0},
        "cylinder": {"diameter_m": 2e4, "depth_m": 2e3}, "air": {"pressure_hpa": 890.0, "temperature_c": 4.0},
    }  # fmt: skip
    air = terrain_from_dict(file).air
    assert air is not None
    assert (air.pressure_hpa, air.temperature_c, air.refraction_sigma_1) == (890.0, 4.0, 0.005)
    assert terrain_from_dict(file | {"air": {"pressure_hpa": 0.0}}).air is None
    with pytest.raises(BadInput, match="pressure_hpa"):
        terrain_from_dict(file | {"air": {"pressure_hpa": -3.0}})
    with pytest.raises(BadInput, match="Moon"):
        terrain_from_dict(file | {"body": "moon"})


@pytest.mark.slow
def test_stars_low_in_the_air_are_no_evidence() -> None:
    flat = replace(CRATER, depth_m=150.0, diameter_m=2e4)  # the rim stands 0.85 degrees high
    _, exposure = picture(102, flat, east_m=0.0, north_m=0.0)
    outcome = solve(exposure, flat)
    light = (outcome if isinstance(outcome, Located) else outcome.reached).photometry  # type: ignore[union-attr]
    low = light.elevation_rad < LOWEST_PREDICTED_RAD
    assert low.sum() > 20
    assert not light.usable[low].any()


def test_stars_that_the_air_dims_are_not_hidden() -> None:
    hazy = SITE.with_air({"extinction_mag": 0.5})  # beyond clear air: at 12 degrees 2.3 magnitudes
    scene, exposure = picture(103, replace(CRATER, site=hazy))
    outcome = solve(exposure, CRATER)
    assert isinstance(outcome, Located), outcome.message
    assert nees(outcome, miss_m(outcome, scene)) < EVERY_CHI2_2DOF
    light = outcome.photometry
    above = light.elevation_rad - scene.horizon_rad(light.azimuth_rad)
    low = light.usable & (above > np.radians(0.5)) & (light.elevation_rad < np.radians(20.0))
    assert low.sum() > 100
    assert np.count_nonzero(light.llr[low] < -3.0) <= 0.01 * low.sum()  # would be a skyline where there is none
    clear, _ = picture(103)
    dimmed = scene.dimmed_mag(np.zeros(1), np.array([[0.0, 0.0, 1.0]])), clear.dimmed_mag(np.zeros(1), np.eye(3)[2:])
    assert (dimmed[0][0], dimmed[1][0]) == pytest.approx((0.5, 0.2), rel=1e-3)


@pytest.mark.slow
def test_simulated_stars_are_dimmed_as_those_of_a_picture() -> None:
    scene, exposure = picture(104)
    outcome = solve(exposure, CRATER)
    assert isinstance(outcome, Located), outcome.message
    rays = simulate_rays(scene, load_catalog(), CRATER, rng=np.random.default_rng(1))
    shown = {int(star): k for k, star in enumerate(outcome.photometry.star)}
    pairs = np.array([(shown[int(s)], k) for k, s in enumerate(rays.photometry.star) if int(s) in shown])
    bright = outcome.photometry.expected_e[pairs[:, 0]] > 50 * np.median(outcome.photometry.sigma_e)
    ratio = np.log(rays.photometry.expected_e[pairs[bright, 1]] / outcome.photometry.expected_e[pairs[bright, 0]])
    assert np.abs(ratio).max() < 0.25
    assert abs(np.median(ratio)) < 0.05


@pytest.mark.slow
def test_errors_on_the_earth_agree_with_their_covariance() -> None:
    found = []
    for seed in range(200, 220):
        scene, exposure = picture(seed)
        outcome = solve(exposure, CRATER)
        error = miss_m(outcome, scene)
        found.append((float(np.linalg.norm(error)), nees(outcome, error)))
    errors, all_nees = np.array(found).T
    assert errors.mean() < 5.0  # the Moon's frames: 2.5
    assert 0.8 < all_nees.mean() < 3.5  # of 40 degrees of freedom: but for one in a thousand on either side


def test_a_lens_that_contains_the_refraction_is_refused_below_air() -> None:
    _, exposure = picture(105)
    camera = replace(load_camera("fisheye-2048"), refraction=REFRACTION_CONTAINED)
    assert camera_from_dict(camera_to_dict(camera)).refraction == REFRACTION_CONTAINED
    outcome = locate(exposure, camera, CRATER, load_catalog(), SETTINGS)
    assert isinstance(outcome, Refused)
    assert outcome.reason == "bad_calibration"
    assert "calibrate with --site" in outcome.message
