"""Errors of a terrain's shape: what files state, the horizon's slopes, and ground that has the errors."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_terrain_files import HILL, hill, terrain_file

from startrack.core.files import data_dir
from startrack.core.types import MIDDLES_RAD, BadInput
from startrack.frames import Site
from startrack.localization.likelihood.shared_errors import SharedErrors
from startrack.simulation import draw_ground
from startrack.simulation.ground_errors import ErringGround
from startrack.terrain import (
    Cylinder,
    ForwardingTerrain,
    GroundErrors,
    HeightMap,
    Terrain,
    load_terrain,
    terrain_from_dict,
)
from startrack.terrain.cylinder import DeformedCrater
from startrack.terrain.shape import WAVES

CRATER = {
    "format": 1, "name": "pit", "body": "moon", "origin": {"latitude_deg": -89.0, "longitude_deg": 0.0},
    "cylinder": {"diameter_m": 9000.0, "depth_m": 1600.0},
}  # fmt: skip
NAMES = (
    "depth_1", "diameter_1", "ellipse_cos_1", "ellipse_sin_1", "rim_tilt_east_rad", "rim_tilt_north_rad",
    "camera_height_m",
)  # fmt: skip
AZIMUTHS = np.linspace(0.02, 2 * np.pi, 40, endpoint=False)
PLACES = np.array([[0.0, 0.0], [3000.0, -2000.0], [-1200.0, 4100.0]])
pytestmark = pytest.mark.usefixtures("own_cache")


def crater_file(rover: dict[str, Any] | None = None, **keys: Any) -> Terrain:
    return terrain_from_dict({**CRATER, "cylinder": {**CRATER["cylinder"], **keys}, "rover": rover or {}})


def uncertain() -> Cylinder:
    """A crater with every error."""
    return Cylinder(
        diameter_m=9000.0, depth_m=1600.0, camera_height_m=2.0, depth_sigma_m=1.0, diameter_sigma_m=3.0,
        ellipse_sigma_1=1e-3, rim_tilt_sigma_rad=1e-4, camera_height_sigma_m=0.1,
    )  # fmt: skip


def test_a_silent_crater_has_defaults_and_gross_parts():
    errors = {error.name: error for error in crater_file().errors.shape}
    assert tuple(errors) == NAMES[:-1]
    assert not any(error.is_stated for error in errors.values())
    found = {name: (e.fact, e.sigma, e.gross_probability, e.gross_sigma) for name, e in errors.items()}
    assert found["depth_1"] == ("depth_sigma_m", 1e-3, 0.01, 0.01)
    assert found["diameter_1"] == ("diameter_sigma_m", 1e-3, 0.01, 0.01)
    assert found["ellipse_cos_1"] == found["ellipse_sin_1"] == ("ellipse_sigma_1", 5e-4, 0.01, 5e-3)
    assert found["rim_tilt_east_rad"] == found["rim_tilt_north_rad"]
    tilt = errors["rim_tilt_east_rad"]
    assert tilt.fact == "rim_tilt_sigma_deg" and tilt.gross_probability == 0.005
    assert np.degrees([tilt.sigma, tilt.gross_sigma]) == pytest.approx([0.002, 0.1])


def test_stated_errors_of_a_crater_are_trusted():
    stated = crater_file(depth_sigma_m=3.2, diameter_sigma_m=0, ellipse_sigma_1=0.001, rim_tilt_sigma_deg=0.01)
    errors = {error.name: error for error in stated.errors.shape}
    assert tuple(errors) == NAMES[:6]
    assert all(error.is_stated for error in errors.values())
    assert (errors["depth_1"].sigma, errors["diameter_1"].sigma) == (pytest.approx(0.002), 0.0)
    assert errors["rim_tilt_north_rad"].sigma == pytest.approx(np.radians(0.01))
    partly = crater_file(depth_sigma_m=0.0, rover={"camera_height_sigma_m": 0.1}).errors.shape
    assert [error.name for error in partly] == list(NAMES)
    assert [error.is_stated for error in partly] == [True] + 5 * [False] + [True]


def test_exact_craters_have_no_errors():
    exact = (crater_file(exact=True), crater_file(exact=True, depth_sigma_m=0), Cylinder(diameter_m=9e3, depth_m=1.6e3))
    for one in exact:
        assert all(error.sigma == 0.0 and error.is_stated for error in one.errors.shape)
        assert len(SharedErrors.of(one, None)) == 0
    assert len(SharedErrors.of(crater_file(exact=False), None)) == 6
    for key in ("depth_sigma_m", "diameter_sigma_m", "ellipse_sigma_1", "rim_tilt_sigma_deg"):
        with pytest.raises(BadInput, match=rf"exact is true, but {key} is not 0") as caught:
            crater_file(exact=True, **{key: 0.01})
        assert caught.value.reason == "bad_terrain"


@pytest.mark.parametrize(
    ("keys", "named"), [({"exact": 1}, "exact"), ({"ellipse_sigma_1": 0.5}, "ellipse"), ({"exakt": True}, "exact"),
                        ({"rim_tilt_sigma_deg": -1.0}, "rim_tilt")],
)  # fmt: skip
def test_unusable_errors_of_a_crater_are_refused(keys, named):
    with pytest.raises(BadInput, match=named):
        crater_file(**keys)


@pytest.mark.parametrize("path", sorted(data_dir("terrain").glob("*.toml")), ids=lambda path: path.stem)
def test_shipped_terrains_state_everything(path):
    terrain = load_terrain(path)
    assert terrain.errors.warnings() == []
    if isinstance(terrain, Cylinder):
        assert all(error.is_stated and error.sigma == 0.0 for error in terrain.errors.shape)
    else:
        sigmas = terrain.stretch_sigma_1, terrain.vertical_sigma_rad, terrain.camera_height_sigma_m
        assert None not in (*sigmas, terrain.horizon_sigma_common_rad)
        assert any(sigmas) != path.stem.endswith("-rendered")


def test_slopes_of_a_crater_are_the_differences_of_its_horizon():
    terrain = uncertain()
    assert tuple(error.name for error in terrain.errors.shape) == NAMES
    slopes = terrain.errors.slopes_rad(PLACES[:, None], AZIMUTHS)
    assert slopes.shape == (7, 3, 40)
    for k, name in enumerate(NAMES):
        step = np.where(np.arange(7) == k, 0.01 if name == "camera_height_m" else 1e-6, 0.0)
        up, down = (terrain.with_shape(sign * step).horizon_rad(PLACES[:, None], AZIMUTHS) for sign in (1, -1))
        difference = (up - down) / (2 * step[k])
        assert slopes[k] == pytest.approx(difference, rel=1e-3, abs=1e-3 * np.abs(difference).max()), name


def test_slopes_vanish_inside_the_wall():
    assert not uncertain().errors.slopes_rad(np.array([[9000.0, 0.0]]), AZIMUTHS).any()


def test_a_crater_without_deformation_is_the_cylinder():
    terrain = uncertain()
    same = terrain.with_shape(np.zeros(7))
    outside = np.vstack([PLACES, [[4600.0, 100.0]]])
    assert same.horizon_rad(outside[:, None], AZIMUTHS) == pytest.approx(
        terrain.horizon_rad(outside[:, None], AZIMUTHS), abs=1e-13
    )
    low, high = same.horizon_bounds_rad(PLACES[:, None], np.array(50.0), AZIMUTHS, 0.02)
    own = terrain.horizon_bounds_rad(PLACES[:, None], np.array(50.0), AZIMUTHS, 0.02)
    assert np.array_equal([low, high], own)
    assert same.errors.shape == () and same.with_shape(np.zeros(0)) is same
    for wrong in (np.zeros(6), np.zeros(8)):
        with pytest.raises(ValueError, match="zip"):
            terrain.with_shape(wrong)


@cache
def deformed() -> DeformedCrater:
    return DeformedCrater(
        diameter_m=9000.0, depth_m=1600.0, camera_height_m=2.0, ellipse_cos_1=0.03, ellipse_sin_1=-0.05,
        rim_tilt_east_rad=0.02, rim_tilt_north_rad=-0.03,
    )  # fmt: skip


@pytest.mark.parametrize("place", PLACES, ids=str)
def test_a_deformed_crater_shows_its_rim(place):
    crater = deformed()
    phi = np.linspace(0.0, 2 * np.pi, 400_000, endpoint=False)
    radius = 4500.0 * (1.0 + 0.03 * np.cos(2 * phi) - 0.05 * np.sin(2 * phi))
    height = 1600.0 + 4500.0 * (0.02 * np.sin(phi) - 0.03 * np.cos(phi)) - 2.0
    east, north = radius * np.sin(phi) - place[0], radius * np.cos(phi) - place[1]
    azimuth = np.arctan2(east, north) % (2 * np.pi)
    order = np.argsort(azimuth)
    assert np.all(np.diff(np.unwrap(np.arctan2(east, north))) > 0)  # one point of the rim for each azimuth
    slow = np.interp(AZIMUTHS, azimuth[order], np.arctan2(height, np.hypot(east, north))[order], period=2 * np.pi)
    assert crater.horizon_rad(place, AZIMUTHS) == pytest.approx(slow, abs=1e-9)


@pytest.mark.parametrize(("half_m", "turn_rad"), [(0.0, 0.0), (40.0, 0.0), (20.0, 0.02), (150.0, 0.7)])
def test_bounds_of_a_deformed_crater_hold(half_m, turn_rad):
    crater, rng = deformed(), np.random.default_rng(1)
    centres, azimuths = rng.uniform(-2500, 2500, (30, 2)), rng.uniform(0, 2 * np.pi, 30)
    low, high = crater.horizon_bounds_rad(centres, np.array(half_m), azimuths, turn_rad)
    points = centres[:, None] + half_m * rng.uniform(-1, 1, (30, 50, 2))
    found = crater.horizon_rad(points, azimuths[:, None] + turn_rad * rng.uniform(-1, 1, (30, 50)))
    assert crater.allowed(points).all()
    assert np.all(low[:, None] <= found) and np.all(found <= high[:, None])


def map_with(**changes: Any) -> HeightMap:
    values = {
        "height_sigma_m": 0.0, "horizon_sigma_common_rad": 1e-3, "stretch_sigma_1": 1e-3, "vertical_sigma_rad": 1e-4,
        "camera_height_sigma_m": 0.1,
    } | changes  # fmt: skip
    return replace(hill_terrain(), **values)


def hill_terrain() -> HeightMap:
    return HeightMap(
        site=terrain_from_dict(CRATER | {"origin": HILL["origin"]}).site, maps=(hill(),), search_radius_m=800.0
    )


def test_errors_of_a_map_by_file(tmp_path: Path):
    path = terrain_file(tmp_path, dem={"height_sigma_m": 0.0, "horizon_sigma_deg": 0.1})
    errors = {error.name: error for error in load_terrain(path).errors.shape}
    assert list(errors) == [
        "bias_rad",
        "stretch_1",
        "vertical_east_rad",
        "vertical_north_rad",
        *WAVES.errors,
        "camera_height_m",
    ]
    bias, stretch, vertical, _, *waves, camera = errors.values()
    assert (bias.fact, bias.sigma, bias.is_stated) == ("horizon_sigma_deg", pytest.approx(np.radians(0.1)), True)
    assert (stretch.fact, stretch.sigma, stretch.gross_probability, stretch.gross_sigma) == (
        "stretch_sigma_1", 0.0, 0.005, 0.005,
    )  # fmt: skip
    assert (vertical.fact, vertical.gross_probability) == ("vertical_sigma_deg", 0.005)
    assert np.degrees([vertical.sigma, vertical.gross_sigma]) == pytest.approx([0.0005, 0.02])
    assert [wave.wave for wave in waves] == [m for m in range(1, 9) for _ in range(2)]
    assert {wave.fact for wave in waves} == {"horizon_waves_sigma_deg"} and not any(wave.is_stated for wave in waves)
    assert (waves[0].sigma, waves[0].gross_probability) == (0.0, 0.03)
    assert (camera.fact, camera.sigma, camera.is_stated) == ("camera_height_sigma_m", 0.02, True)
    stated = {"height_sigma_m": 0.0, "horizon_sigma_deg": 0.0, "stretch_sigma_1": 0.0, "vertical_sigma_deg": 0.01}
    stated["horizon_waves_sigma_deg"] = [0.01 * k for k in range(8)]
    path = terrain_file(tmp_path, dem=stated, rover={"camera_height_sigma_m": 0.0})
    errors = load_terrain(path).errors.shape
    waves = [0.01 * k for k in range(8) for _ in range(2)]
    assert [error.sigma for error in errors] == pytest.approx([0.0, 0.0, *np.radians([0.01, 0.01, *waves])])
    assert all(error.is_stated for error in errors)
    path = terrain_file(tmp_path, dem=stated | {"horizon_waves_sigma_deg": 0.02}, rover={"camera_height_sigma_m": 0.0})
    assert np.degrees([error.sigma for error in load_terrain(path).errors.shape if error.wave == 4]) == pytest.approx(
        0.01
    )


def test_slopes_of_a_map_are_the_differences_of_its_horizon():
    terrain, points = map_with(), np.array([[100.0, -200.0], [400.0, 350.0]])
    slopes = terrain.errors.slopes_rad(points[:, None], AZIMUTHS)
    assert slopes.shape == (21, 2, 40)
    plain = terrain.horizon_rad(points[:, None], AZIMUTHS)
    steps = (1e-5, 1e-4, 1e-5, 1e-5, *np.full(16, 1e-5), 0.01)
    for k, (error, step) in enumerate(zip(terrain.errors.shape, steps, strict=True)):
        change = step * (np.arange(21) == k)
        found = terrain.with_shape(change).horizon_rad(points[:, None], AZIMUTHS)
        left_out = 0.3 if error.fact == "vertical_sigma_deg" else 2e-3  # tan H times the slope of the skyline
        assert (found - plain) / step == pytest.approx(slopes[k], abs=left_out * np.abs(slopes[k]).max()), error.name
        if error.fact == "vertical_sigma_deg":
            assert np.median(np.abs((found - plain) / step - slopes[k])) < 0.05


def test_crests_share_the_bias_as_a_height():
    """The crest at the distance d rises by cos^2 H / d, and the median one seen from the origin by one radian."""
    terrain, points = map_with(), np.array([[100.0, -200.0], [400.0, 350.0], [0.0, 0.0]])
    names = [error.name for error in terrain.errors.shape]
    tan, distance_m, _ = terrain.horizons(points[:, None], MIDDLES_RAD)
    slopes = terrain.errors.slopes_rad(points[:, None], MIDDLES_RAD)
    bias, wave = slopes[names.index("bias_rad")], slopes[names.index("wave_2_sin_rad")]
    far = distance_m > terrain.maps[0].post_m
    height = bias * distance_m * (1.0 + tan**2)
    assert far.mean() > 0.5 and height[far] == pytest.approx(np.full(far.sum(), 1.0 / terrain.crest_rad_per_m))
    assert np.median(bias[2]) == pytest.approx(1.0)
    assert wave == pytest.approx(bias * np.sin(2 * MIDDLES_RAD))


def test_a_tilt_turns_the_skyline_exactly():
    terrain = map_with(horizon_sigma_common_rad=0.0, stretch_sigma_1=0.0, camera_height_sigma_m=0.0)
    east, north = 3e-3, -2e-3
    point, fine = np.array([100.0, -200.0]), np.linspace(0, 2 * np.pi, 20_001)
    h = terrain.horizon_rad(point, fine)
    rays = np.stack([np.cos(h) * np.sin(fine), np.cos(h) * np.cos(fine), np.sin(h)], axis=-1)
    angle = np.hypot(east, north)
    axis = np.array([north, -east, 0.0]) / angle
    turned = (
        rays * np.cos(angle) + np.cross(axis, rays) * np.sin(angle)
        + axis * (rays @ axis)[:, None] * (1.0 - np.cos(angle))
    )  # fmt: skip
    slow = np.interp(
        AZIMUTHS, np.arctan2(turned[:, 0], turned[:, 1]) % (2 * np.pi), np.arcsin(turned[:, 2]), period=2 * np.pi
    )
    ground = terrain.with_shape(np.array([0.0, 0.0, east, north, *np.zeros(16)]))
    assert ground.horizon_rad(point, AZIMUTHS) == pytest.approx(slow, abs=2e-6)


def test_bounds_of_a_deformed_map_hold():
    ground, rng = (
        map_with().with_shape(np.array([1e-3, 0.01, 2e-3, -1e-3, *np.linspace(-1e-3, 1e-3, 16), 0.2])),
        np.random.default_rng(2),
    )
    assert ground.camera_height_m == pytest.approx(1.7) and ground.errors.shape == ()
    centres, azimuths = rng.uniform(-400, 400, (20, 2)), rng.uniform(0, 2 * np.pi, 20)
    for half_m, turn_rad in ((5.0, 0.0), (100.0, 0.05)):
        low, high = ground.horizon_bounds_rad(centres, np.array(half_m), azimuths, turn_rad)
        points = centres[:, None] + half_m * rng.uniform(-1, 1, (20, 20, 2))
        found = ground.horizon_rad(points, azimuths[:, None] + turn_rad * rng.uniform(-1, 1, (20, 20)))
        assert np.all(low[:, None] - 3e-6 <= found) and np.all(found <= high[:, None] + 3e-6)
    assert ground.near(centres[0], 20.0, AZIMUTHS) is ground


def test_an_interpolator_has_the_slopes_of_its_map():
    terrain = map_with()
    near = terrain.near(np.array([100.0, -200.0]), 30.0, AZIMUTHS)
    point = np.array([110.0, -190.0])
    assert near.errors.shape == terrain.errors.shape
    found, own = near.errors.slopes_rad(point, AZIMUTHS), terrain.errors.slopes_rad(point, AZIMUTHS)
    scale = np.abs(own).max(axis=1, keepdims=True)
    assert np.abs(found - own).max(axis=1) == pytest.approx(np.zeros(21), abs=0.05 * scale.max())
    assert np.abs(near.errors.slopes_rad(point, AZIMUTHS + 0.01) - terrain.errors.slopes_rad(point, AZIMUTHS + 0.01)
                  ).max() == 0.0  # fmt: skip


def test_a_wrapper_passes_the_errors_on():
    terrain = uncertain()
    wrapped = ForwardingTerrain(terrain)
    assert wrapped.errors.shape == terrain.errors.shape
    assert np.array_equal(wrapped.errors.slopes_rad(PLACES, 1.0), terrain.errors.slopes_rad(PLACES, 1.0))
    assert wrapped.with_shape(np.ones(7) * 1e-3) == terrain.with_shape(np.ones(7) * 1e-3)

    class Silent(ForwardingTerrain):
        name = "silent"
        errors = GroundErrors()

        def near(self, *_: Any) -> Terrain:
            return self

    assert (Silent(terrain).name, Silent(terrain).errors.shape) == ("silent", ())
    assert isinstance(Silent(terrain).near(), Silent)


def test_drawn_ground_errs_as_the_file_states():
    rng, truth = np.random.default_rng(3), uncertain()
    drawn = [draw_ground(truth, rng=rng) for _ in range(300)]
    assert np.std([one.depth_m for one in drawn]) == pytest.approx(1.0, rel=0.15)
    assert np.std([one.diameter_m for one in drawn]) == pytest.approx(3.0, rel=0.15)
    assert np.std([one.ellipse_sin_1 for one in drawn]) == pytest.approx(1e-3, rel=0.15)
    silent = crater_file()
    assert np.std([draw_ground(silent, rng=rng).depth_m for _ in range(300)]) == pytest.approx(1.6, rel=0.15)
    exact = crater_file(exact=True)
    assert draw_ground(exact, rng=rng) is exact


@pytest.mark.slow
def test_drawn_ground_of_a_map_has_one_bias():
    truth, rng, point = (
        map_with(stretch_sigma_1=0.0, vertical_sigma_rad=0.0),
        np.random.default_rng(4),
        np.zeros((1, 2)),
    )
    plain = truth.horizon_rad(point, AZIMUTHS)
    risen = [(draw_ground(truth, rng=rng).horizon_rad(point, AZIMUTHS) - plain).mean() for _ in range(200)]
    assert np.std(risen) == pytest.approx(1e-3, rel=0.15)
    rough = draw_ground(replace(truth, height_sigma_m=1.0), rng=rng)
    assert isinstance(rough, ErringGround) and np.isfinite(rough.horizon_rad(point, AZIMUTHS)).all()


def on_earth(**air: float) -> Cylinder:
    site = Site("earth", 0.7, 0.2, 1500.0)
    return Cylinder(diameter_m=9000.0, depth_m=900.0, camera_height_m=2.0, site=site.with_air(air or None))


def test_the_error_of_refraction_is_one_of_every_ground_below_air():
    (error,) = (one for one in on_earth().errors.shape if one.sigma > 0.0)
    assert (error.name, error.fact, error.sigma, error.is_stated) == ("refraction_1", "refraction_sigma_1", 0.035, True)
    assert "refraction_1" not in [one.name for one in uncertain().errors.shape]
    assert on_earth(pressure_hpa=840.0, temperature_c=3.0).errors.shape[-1].sigma == 0.005
    assert on_earth(refraction_sigma_1=0.02).errors.shape[-1].sigma == 0.02
    assert "refraction_1" not in [one.name for one in on_earth(pressure_hpa=0.0).errors.shape]


def test_stars_that_are_raised_more_are_a_skyline_that_is_lower():
    crater = on_earth()
    values = np.array([0.04 if one.name == "refraction_1" else 0.0 for one in crater.errors.shape])
    ground, air = crater.with_shape(values), crater.air
    points = PLACES[:, None]
    horizon = crater.horizon_rad(points, AZIMUTHS)
    slopes = crater.errors.slopes_rad(points, AZIMUTHS)[values > 0][0]
    # 4 % more pressure raise the stars by 4 % more: a star at the skyline of the map is seen above it.
    denser = replace(air, pressure_hpa=1.04 * air.pressure_hpa)
    raised = denser.apparent_rad(air.true_rad(horizon)) - horizon
    np.testing.assert_allclose(ground.horizon_rad(points, AZIMUTHS), horizon - raised, atol=np.radians(1.0 / 3600))
    np.testing.assert_allclose(0.04 * slopes, -raised, atol=np.radians(1.0 / 3600))
    low, high = ground.horizon_bounds_rad(points, np.full((3, 1), 30.0), AZIMUTHS)
    assert np.all((low <= ground.horizon_rad(points, AZIMUTHS)) & (ground.horizon_rad(points, AZIMUTHS) <= high))
    assert ground.near(points[0, 0], 10.0, AZIMUTHS) is ground
    assert ground.errors.shape == ()
