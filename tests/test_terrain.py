"""One contract for every terrain; the cylinder against rays traced to a polygonal wall; terrain files key by key."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from hypothesis import given, settings
from hypothesis import strategies as st
from schema_helpers import change_key

from startrack.core.files import data_dir
from startrack.core.types import BadInput
from startrack.frames import Site
from startrack.terrain import Cylinder, Terrain, load_terrain, terrain_from_dict

SITE = Site("moon", np.radians(-89.66), np.radians(129.78))


def cylinder(name: str, diameter_m: float, depth_m: float, height_m: float, search_m: float) -> Cylinder:
    return Cylinder(
        name=name, site=SITE, diameter_m=diameter_m, depth_m=depth_m, camera_height_m=height_m, search_radius_m=search_m
    )


SHACKLETON = replace(load_terrain("shackleton"), search_radius_m=500.0)
EXACT = {SHACKLETON.name: 3e-6}  # [rad] to which traced horizons and their bounds meet; closed forms do so exactly
COMMON_SIGMA_RAD = {SHACKLETON.name: np.hypot(np.radians(0.08), 4.7e-4)}  # its file, and 5.4 m of the ground below


TERRAINS: dict[str, Terrain] = {
    t.name: t
    for t in (
        cylinder("thesis", 20_000.0, 2000.0, 1.5, 10_000.0),
        cylinder("small search area", 20_000.0, 4000.0, 0.0, 3000.0),
        cylinder("pit", 100.0, 40.0, 1.0, 50.0),
        SHACKLETON,
    )
}
every_terrain = pytest.mark.parametrize("terrain", TERRAINS.values(), ids=TERRAINS)


def allowed_positions(terrain: Terrain, n: int, seed: int) -> np.ndarray:
    places = np.random.default_rng(seed).uniform(-terrain.reach_m, terrain.reach_m, (8 * n, 2))
    return places[np.asarray(terrain.allowed(places))][:n]


@every_terrain
@settings(max_examples=150, deadline=None)
@given(
    st.floats(-1, 1), st.floats(-1, 1), st.floats(-4, 0), st.floats(-0.5, 6.8),
    st.sampled_from([0.0, 1e-3, 0.03, 0.5, 4]), st.integers(0, 2**32 - 1),
)  # fmt: skip
def test_bounds_hold_the_horizon_of_every_allowed_point(
    terrain: Terrain, x: float, y: float, log_half: float, azimuth: float, azimuth_half: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    centre, half = terrain.reach_m * np.array([x, y]), terrain.reach_m * 10**log_half
    points = centre + half * np.concatenate([rng.uniform(-1, 1, (300, 2)), rng.choice([-1.0, 1.0], (20, 2))])
    turns = azimuth + azimuth_half * np.concatenate([rng.uniform(-1, 1, 300), rng.choice([-1.0, 1.0], 20)])
    ok = np.asarray(terrain.allowed(points))
    low, high = terrain.horizon_bounds_rad(centre[None], np.array([half]), np.array([azimuth]), azimuth_half)
    horizon = terrain.horizon_rad(points[ok], turns[ok])
    rounding = max(1e-12, EXACT.get(terrain.name, 0.0))
    assert np.all(low - rounding <= horizon)
    assert np.all(horizon <= high + rounding)


@every_terrain
def test_bounds_close_in_on_the_horizon(terrain: Terrain) -> None:
    places = allowed_positions(terrain, 200, 1)
    azimuth = np.random.default_rng(2).uniform(0, 2 * np.pi, 200)
    horizon = terrain.horizon_rad(places, azimuth)
    widths = []
    for half in terrain.reach_m * np.array([1e-3, 1e-4, 1e-5]):
        low, high = terrain.horizon_bounds_rad(places, np.full(200, half), azimuth)
        widths.append(np.median(high - low))
    exact = EXACT.get(terrain.name, 0.0)
    assert widths[1] < 0.15 * widths[0]
    assert widths[2] < max(0.15 * widths[1], exact)
    low, high = terrain.horizon_bounds_rad(places, np.zeros(200), azimuth)
    assert low == pytest.approx(horizon, abs=max(1e-12, exact))
    assert high == pytest.approx(horizon, abs=max(1e-12, exact))
    over = terrain.horizon_bounds_rad(places, np.zeros(200), azimuth, np.full(200, 1e-12))
    assert over[0] == pytest.approx(horizon, abs=max(1e-9, exact))
    assert over[1] == pytest.approx(horizon, abs=max(1e-9, exact))


@every_terrain
def test_methods_are_elementwise_and_broadcast(terrain: Terrain) -> None:
    places = allowed_positions(terrain, 7, 3)
    azimuth = np.linspace(0, 6, 7)
    whole = terrain.horizon_rad(places, azimuth)
    assert whole.shape == (7,)
    each = [terrain.horizon_rad(p[None], a[None])[0] for p, a in zip(places, azimuth, strict=True)]
    assert np.array_equal(whole, each)
    one_place = terrain.horizon_rad(places[0], azimuth)
    assert np.array_equal(one_place, terrain.horizon_rad(np.tile(places[0], (7, 1)), azimuth))
    assert terrain.horizon_rad(places, azimuth + 2 * np.pi) == pytest.approx(
        whole, abs=max(1e-12, EXACT.get(terrain.name, 0.0))
    )
    assert np.shape(terrain.ground_m(places)) == (7,)
    assert np.shape(terrain.allowed(places.reshape(7, 1, 2))) == (7, 1)
    assert terrain.is_informative(azimuth, np.full(7, 1.0)).tolist() == 7 * [True]  # nothing stands so high
    assert terrain.errors.common_sigma_rad == pytest.approx(COMMON_SIGMA_RAD.get(terrain.name, 0.0), rel=0.05)
    near = terrain.near(places[0], 1.0, azimuth)
    assert near.horizon_rad(places[0], azimuth) == pytest.approx(one_place, abs=1e-4)
    sigma = terrain.errors.sigma_rad(places, azimuth)
    assert sigma.shape == (7,)
    if terrain.name in COMMON_SIGMA_RAD:  # 5.4 m, 7 to 13 km away and 17 to 24 degrees high
        assert np.all((sigma > 2.7e-4) & (sigma < 7.6e-4))
    else:
        assert not sigma.any()
    assert terrain.horizon_rad(np.zeros((0, 2)), np.zeros(0)).shape == (0,)


@every_terrain
def test_the_search_area_lies_within_the_searched_square(terrain: Terrain) -> None:
    assert terrain.reach_m > 0
    assert np.asarray(terrain.allowed(np.zeros((1, 2)))).all()
    places = allowed_positions(terrain, 1000, 4)
    assert len(places) == 1000
    inside = np.hypot(places[:, 0], places[:, 1]) <= terrain.search_radius_m
    assert inside.mean() > 0.4
    azimuth = np.random.default_rng(5).uniform(0, 2 * np.pi, 1000)
    horizon = terrain.horizon_rad(places, azimuth)
    assert np.all((horizon > -np.pi / 2) & (horizon < np.pi / 2))


@pytest.mark.parametrize("name", [name for name in TERRAINS if name != SHACKLETON.name])
def test_cylinder_agrees_with_rays_traced_to_a_polygonal_wall(name: str) -> None:
    crater = TERRAINS[name]
    assert isinstance(crater, Cylinder)
    places = allowed_positions(crater, 60, 6)
    rng = np.random.default_rng(7)
    for place in places:
        azimuth = rng.uniform(0, 2 * np.pi)
        eye = np.array([*place, crater.camera_height_m])
        hit = _wall_hit(eye[:2], azimuth, crater.diameter_m / 2)
        up = crater.depth_m - eye[2]
        expected = np.arctan2(up, np.hypot(*(hit - eye[:2])))
        assert crater.horizon_rad(place[None], np.array([azimuth]))[0] == pytest.approx(expected, abs=1e-7)


def _wall_hit(start: np.ndarray, azimuth_rad: float, radius_m: float, sides: int = 20_000) -> np.ndarray:
    """Where a horizontal ray meets a wall of `sides` plane panels."""
    turn = np.linspace(0, 2 * np.pi, sides + 1)
    corner = radius_m * np.stack([np.sin(turn), np.cos(turn)], axis=1)
    panel = np.diff(corner, axis=0)
    way = np.array([np.sin(azimuth_rad), np.cos(azimuth_rad)])
    # start + s way = corner + t panel
    determinant = way[1] * panel[:, 0] - way[0] * panel[:, 1]
    away = corner[:-1] - start
    s = (panel[:, 0] * away[:, 1] - panel[:, 1] * away[:, 0]) / determinant
    t = (way[0] * away[:, 1] - way[1] * away[:, 0]) / determinant
    (found,) = np.flatnonzero((s > 0) & (t >= 0) & (t < 1))
    return start + s[found] * way


def test_thesis_figures_from_the_middle_and_from_the_wall() -> None:
    crater = load_terrain("shackleton-thesis")
    a = np.array([0.0])
    assert np.degrees(crater.horizon_rad(np.zeros((1, 2)), a)) == pytest.approx(11.3018, abs=1e-3)  # atan(1998.5 / 1e4)
    near_wall = np.array([[0.0, 9999.0]])  # a metre from the wall, in the north
    assert np.degrees(crater.horizon_rad(near_wall, a)) == pytest.approx(89.971, abs=1e-3)
    assert np.degrees(crater.horizon_rad(near_wall, a + np.pi)) == pytest.approx(5.707, abs=1e-3)
    east = np.array([[5000.0, 0.0]])  # azimuth runs from north through east
    assert np.degrees(crater.horizon_rad(east, np.array([np.pi / 2]))) == pytest.approx(21.787, abs=1e-3)


def test_beyond_the_wall_nothing_is_allowed_or_visible() -> None:
    crater = TERRAINS["thesis"]
    outside = np.array([[10_001.0, 0.0], [0.0, -1e6]])
    assert not np.asarray(crater.allowed(outside)).any()
    assert crater.horizon_rad(outside, np.zeros(2)) == pytest.approx(np.pi / 2)
    assert np.array_equal(crater.ground_m(np.zeros((3, 2))), np.zeros(3))


GOOD: dict[str, Any] = {
    "format": 1, "name": "c", "body": "moon", "origin": {"latitude_deg": -80.0, "longitude_deg": 10},
    "cylinder": {"diameter_m": 2000.0, "depth_m": 300.0}, "rover": {"camera_height_m": 2.0},
    "search": {"radius_m": 900},
}  # fmt: skip


def test_every_key_reaches_the_terrain() -> None:
    crater = terrain_from_dict(GOOD)
    assert crater == Cylinder(
        name="c", site=Site("moon", np.radians(-80.0), np.radians(10.0)), diameter_m=2000.0, depth_m=300.0,
        camera_height_m=2.0, search_radius_m=900.0, depth_sigma_m=None, diameter_sigma_m=None,
        ellipse_sigma_1=None, rim_tilt_sigma_rad=None,
    )  # fmt: skip
    assert crater.reach_m == 1000.0
    earth = terrain_from_dict(change_key(GOOD, "origin.height_m", 120.0) | {"body": "earth"})
    assert (earth.site.body, earth.site.height_m) == ("earth", 120.0)
    least = {key: GOOD[key] for key in ("body", "origin", "cylinder")}
    assert terrain_from_dict(least, "plain").name == "plain"
    assert terrain_from_dict(least).search_radius_m == 1000.0


@pytest.mark.parametrize(
    "path", sorted(p for p in data_dir("terrain").glob("*.toml") if "[cylinder]" in p.read_text()), ids=lambda p: p.stem
)
def test_shipped_terrains_load(path: Path) -> None:
    assert load_terrain(path.stem).name == path.stem
    assert load_terrain(path) == load_terrain(path.stem)


BAD = [
    ("format", 2, "format"), ("body", None, "body"), ("body", "mars", "mars"), ("body", 3, "body"),
    ("origin", None, "origin"), ("origin", 5, "origin"), ("origin.latitude_deg", None, "latitude_deg"),
    ("origin.latitude_deg", -91.0, "latitude_deg"), ("origin.latitude_deg", "south", "latitude_deg"),
    ("origin.longitude_deg", float("nan"), "longitude_deg"), ("origin.height_m", True, "height_m"),
    ("cylinder", None, "cylinder"), ("cylinder", [1.0], "cylinder"), ("cylinder.diameter_m", None, "diameter_m"),
    ("cylinder.diameter_m", -1.0, "diameter_m"), ("cylinder.depth_m", 0, "depth_m"),
    ("cylinder.depth_m", "deep", "depth_m"),
    ("rover", 1.5, "rover"), ("rover.camera_height_m", -1.0, "camera"), ("rover.camera_height_m", 300.0, "camera"),
    ("search", "all", "search"), ("search.radius_m", 0.0, "radius_m"), ("search.radius_m", float("inf"), "radius_m"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"diameter_m": -5.0}, "diameter_m must be a number above 0"), ({"diameter_m": np.nan}, "diameter_m must"),
        ({"depth_m": "a"}, "depth_m must be a number, not 'a'"), ({"depth_m": 0}, "depth_m must"),
        ({"depth_m": True}, "depth_m must be a number"), ({"diameter_m": None}, "diameter_m must be a number"),
        ({"camera_height_m": 300.0}, "the camera must be below the rim"), ({"camera_height_m": -1.0}, "height_m must"),
        ({"depth_sigma_m": -1.0}, "depth_sigma_m must"),
        ({"depth_sigma_m": 150.0}, "depth_sigma_m must be below 150 m"),
        ({"diameter_sigma_m": 1000.0}, "diameter_sigma_m must be below 1000 m"),
        ({"search_radius_m": 0.0}, "search_radius_m must"), ({"search_radius_m": float("nan")}, "search_radius_m must"),
        ({"search_radius_m": -np.inf}, "search_radius_m must"),
    ],
    ids=str,
)  # fmt: skip
def test_an_impossible_cylinder_is_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises(BadInput, match=message) as caught:
        Cylinder(**{"diameter_m": 2000.0, "depth_m": 300.0, **given})
    assert caught.value.reason == "bad_terrain"


def test_a_cylinder_takes_any_real_number_and_an_open_search_area() -> None:
    crater = Cylinder(diameter_m=np.float32(2000), depth_m=300, camera_height_m=np.int64(2))
    assert (crater.diameter_m, crater.depth_m, crater.camera_height_m) == (2000.0, 300.0, 2.0)
    assert isinstance(crater.diameter_m, float) and crater.search_radius_m == np.inf


@pytest.mark.parametrize(("path", "value", "named"), BAD, ids=lambda v: str(v)[:30])
def test_a_wrong_key_is_refused_and_named(path: str, value: Any, named: str, tmp_path: Path) -> None:
    file = tmp_path / "bad.toml"
    file.write_text(tomli_w.dumps(change_key(GOOD, path, value)))
    with pytest.raises(BadInput, match=named) as caught:
        load_terrain(file)
    assert caught.value.reason == "bad_terrain"
    assert str(file) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", [b"body = ", b"\xff\xfe\x00", b""])
def test_what_is_not_toml_is_bad_terrain(text: bytes, tmp_path: Path) -> None:
    (tmp_path / "bad.toml").write_bytes(text)
    with pytest.raises(BadInput) as caught:
        load_terrain(tmp_path / "bad.toml")
    assert caught.value.reason == "bad_terrain"


def test_a_missing_file_is_bad_terrain(tmp_path: Path) -> None:
    for name in (tmp_path / "none.toml", "no-such-crater", "some/where"):
        with pytest.raises(BadInput) as caught:
            load_terrain(name)
        assert caught.value.reason == "bad_terrain"
        assert str(name) in str(caught.value)
