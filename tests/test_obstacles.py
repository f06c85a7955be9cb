"""Obstacles that were scanned: their files, and images in which they hide the skyline."""

from __future__ import annotations

import json
import shutil
import tomllib
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import startrack
from startrack.camera import camera_from_dict, camera_text, load_camera
from startrack.chain import input_hashes
from startrack.core.obstacles import Obstacles, read_obstacles
from startrack.core.types import BadInput
from startrack.evidence import add_obstacles
from startrack.exposure import read_exposure
from startrack.frames import azel_from_rays
from startrack.terrain import TerrainFile, load_terrain

ROOT = Path(__file__).parents[1]
IMAGE = ROOT / "sample_images" / "near-wall.png"
FROM_DEG, TO_DEG = 80.0, 150.0  # what something hides up to 30 degrees above the horizon
ROWS = "azimuth_deg,elevation_deg\n" + "".join(f"{a},30\n" for a in range(int(FROM_DEG), int(TO_DEG) + 1, 5))
HEAD = "azimuth_deg,elevation_deg\n"


def in_degrees(*rows: tuple[float, float]) -> Obstacles:
    return Obstacles(*np.radians(rows).T)


def hides(obstacles: Obstacles, azimuth_deg: float, elevation_deg: float) -> bool:
    return bool(obstacles.hides(np.radians(azimuth_deg), np.radians(elevation_deg)))


@cache
def located():
    return startrack.locate(str(IMAGE))


@cache
def hidden_exposure():
    """The sample with a dark obstacle before the sky, that hides the skyline."""
    exposure, result = read_exposure(str(IMAGE)), located().result
    mask = add_obstacles(
        None, result.camera, result.R_cam_enu.T, replace(result.terrain, file=TerrainFile(obstacles=wall()))
    )
    pixels = exposure.pixels_adu.copy()
    pixels[mask.masked] = np.round(np.random.default_rng(1).normal(110.0, 6.0, np.count_nonzero(mask.masked)))
    return replace(exposure, pixels_adu=pixels)


def wall() -> Obstacles:
    return in_degrees(*((a, 30.0) for a in np.arange(FROM_DEG, TO_DEG + 1, 5.0)))


def true_m() -> np.ndarray:
    return np.array(json.loads(IMAGE.with_suffix(".truth.json").read_text())["position_enu_m"][:2])


def test_a_profile_is_straight_between_its_points_and_around_the_compass():
    profile = in_degrees((2.0, 10.0), (4.0, 20.0), (8.0, 20.0), (8.0, 0.0), (356.0, 5.0))
    for azimuth, top in ((2, 10), (3, 15), (6, 20), (356, 5), (359, 7.5), (-1, 7.5), (361, 9.1667)):
        assert hides(profile, azimuth, top - 0.01)
        assert not hides(profile, azimuth, top + 0.01)
    assert hides(profile, 7.99, 19.0) and not hides(profile, 8.01, 1.0)  # a vertical edge
    assert not hides(profile, 180.0, -80.0)  # rows farther apart than ten degrees are no obstacle


def test_rows_without_an_elevation_are_gaps(tmp_path):
    (tmp_path / "deck.csv").write_text(HEAD + "0,10\n5,10\n10,\n15,\n20,10\n-5,10\n")
    found = read_obstacles(tmp_path / "deck.csv", "bad_image")
    assert np.degrees(found.azimuth_rad) == pytest.approx([0, 5, 20, 355])
    assert [hides(found, a, 0.0) for a in (-3, 3, 12, 22)] == [True, True, False, False]


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ("", "columns azimuth_deg and elevation_deg"), ("azimuth,elevation\n1,2\n", "columns azimuth_deg"),
        (HEAD, "0 rows with an elevation"), (HEAD + "1,2\n", "1 rows"), (HEAD + "1,2\n3\n", "line 3: finite"),
        (HEAD + "1,2\nnorth,2\n", "line 3"), (HEAD + "1,2\n3,nan\n", "line 3"), (HEAD + "1,2\n3,91\n", "elevation 91"),
        (HEAD + "1,2\n1e5,3\n", "azimuth 100000"), (HEAD + "1,2\n,3\n", "line 3"),
    ],
)  # fmt: skip
def test_a_file_that_is_no_profile_is_refused_with_its_cause(tmp_path, text, cause):
    (tmp_path / "deck.csv").write_text(text)
    with pytest.raises(BadInput, match=cause) as refusal:
        read_obstacles(tmp_path / "deck.csv", "bad_terrain")
    assert refusal.value.reason == "bad_terrain" and "deck.csv" in str(refusal.value)


def test_the_pixels_of_hidden_directions_do_not_count():
    result = located().result
    mask = add_obstacles(
        None, result.camera, result.R_cam_enu.T, replace(result.terrain, file=TerrainFile(obstacles=wall()))
    )
    rng = np.random.default_rng(2)
    x, y = rng.integers(0, 2048, (2, 4000))
    azimuth, elevation = azel_from_rays(result.camera.unproject(np.stack([x, y], axis=1)) @ result.R_cam_enu)
    azimuth, elevation = np.degrees(azimuth), np.degrees(elevation)
    within = (azimuth > FROM_DEG + 1) & (azimuth < TO_DEG - 1) & (elevation < 29.5)
    beyond = (azimuth < FROM_DEG - 3) | (azimuth > TO_DEG + 3) | (elevation > 31.5)
    inside = np.hypot(x - 1023.5, y - 1023.5) < 1000.0
    assert mask.masked[y, x][within & inside].all() and not mask.masked[y, x][beyond & inside].any()


def test_the_ground_behind_an_obstacle_says_nothing():
    exposure = replace(hidden_exposure(), terrain=located().result.terrain)
    without = startrack.locate(exposure)
    told = startrack.locate(replace(exposure, obstacles=wall()))
    assert told.result.status == "ok" and without.result.fix.blocked  # found as something on no map
    assert not told.result.fix.blocked
    off = told.result.fix.position_enu_m[:2] - true_m()
    assert np.linalg.norm(off) < told.result.fix.radius999_m < 3.0 * located().result.fix.radius999_m
    light = told.result.photometry
    azimuth, elevation = np.degrees(light.azimuth_rad), np.degrees(light.elevation_rad)
    behind = (azimuth > FROM_DEG + 1) & (azimuth < TO_DEG - 1) & (elevation < 29.0)
    assert behind.sum() > 100
    assert not light.llr[behind].any()


def test_obstacles_that_are_scanned_anew_count(tmp_path):
    text = (ROOT / "terrain" / "shackleton-thesis.toml").read_text(encoding="utf-8")
    (tmp_path / "ground.toml").write_text('obstacles = "deck.csv"\n' + text)
    for elevation_deg in (30.0, 40.0):
        (tmp_path / "deck.csv").write_text(f"azimuth_deg,elevation_deg\n0,{elevation_deg}\n10,{elevation_deg}\n")
        found = load_terrain(tmp_path / "ground.toml").file.obstacles
        assert hides(found, 5.0, elevation_deg - 1.0) and not hides(found, 5.0, elevation_deg + 1.0)


def test_terrain_sidecar_and_camera_name_the_same_obstacles(tmp_path):
    shutil.copy(IMAGE, tmp_path / "image.png")
    sidecar = json.loads(IMAGE.with_suffix(".json").read_text()) if IMAGE.with_suffix(".json").exists() else {}
    (tmp_path / "deck.csv").write_text(ROWS)
    text = (ROOT / "terrain" / "shackleton-thesis.toml").read_text()
    (tmp_path / "ground.toml").write_text('obstacles = "deck.csv"\n' + text)
    terrain = load_terrain(tmp_path / "ground.toml")
    assert terrain.file.obstacles.hides(np.radians(100.0), np.radians(29.0)) and terrain.file.paths == (
        tmp_path / "deck.csv",
    )
    (tmp_path / "image.json").write_text(json.dumps({**sidecar, "obstacles": "deck.csv"}))
    exposure = read_exposure(str(tmp_path / "image.png"))
    assert exposure.obstacles == str(tmp_path / "deck.csv")
    by_sidecar = startrack.locate(exposure)
    by_terrain = startrack.locate(replace(exposure, obstacles=None, terrain=str(tmp_path / "ground.toml")))
    assert by_sidecar.result.fix.position_enu_m.tolist() == by_terrain.result.fix.position_enu_m.tolist()
    camera = load_camera("fisheye-2048")
    from_nose = wall().azimuth_rad - float(located().heading.to_value("rad"))  # the rover stands level
    about_body = Obstacles(np.sort(np.mod(from_nose, 2 * np.pi)), wall().elevation_rad)
    by_camera = startrack.locate(replace(exposure, obstacles=None), camera=replace(camera, obstacles=about_body))
    for mask in (by_camera.result.detections.mask, by_sidecar.result.detections.mask):
        assert mask is not None
    different = by_camera.result.detections.mask.masked ^ by_sidecar.result.detections.mask.masked
    assert different.mean() < 0.05 * by_sidecar.result.detections.mask.masked.mean()
    hashes = input_hashes(str(tmp_path / "image.png"), [None], str(tmp_path / "ground.toml"), exposure.obstacles)
    assert {Path(one).name for one in hashes} == {"ground.toml", "deck.csv"}


def test_a_camera_file_keeps_its_obstacles(tmp_path):
    camera = replace(load_camera("fisheye-2048"), obstacles=str(tmp_path / "deck.csv"))
    text = camera_text(camera, tmp_path)
    assert 'obstacles = "deck.csv"' in text
    assert camera_from_dict(tomllib.loads(text), folder=tmp_path).obstacles == str(tmp_path / "deck.csv")
    (tmp_path / "camera.toml").write_text(text)
    hashes = input_hashes(str(tmp_path / "image.png"), [str(tmp_path / "camera.toml")], None)
    assert {Path(one).name for one in hashes} == {"camera.toml", "deck.csv"}
    with pytest.raises(BadInput, match=r"deck\.csv") as refusal:  # it is missing
        startrack.locate(str(IMAGE), camera=str(tmp_path / "camera.toml"))
    assert refusal.value.reason == "bad_calibration"
