"""The samples in the repository: their metadata, and their truth."""

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest

from startrack.exposure import read_exposure
from startrack.exposure.png import decode as decode_png
from startrack.frames import R_enu_icrs, R_from_quat_xyzw, parse_utc
from startrack.output.html.details import read_ecsv
from startrack.terrain import load_terrain

SAMPLES = Path(__file__).parent.parent / "sample_images"
NAMES = ("near-centre", "near-wall", "tilted")


def script():
    spec = importlib.util.spec_from_file_location("make_samples", SAMPLES / "make_samples.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def truth(name):
    return json.loads((SAMPLES / f"{name}.truth.json").read_text())


def test_the_script_makes_the_samples_that_are_here():
    assert tuple(script().SAMPLES) == NAMES
    assert {path.stem for path in SAMPLES.glob("*.png")} == set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_truth_and_facts_are_those_of_the_script(name):
    words = script().SAMPLES[name].split()
    flags = dict(zip(words[::2], words[1::2], strict=True))
    known = truth(name)
    assert known["seed"] == int(flags["--seed"])
    for key, flag in {"heading_deg": "heading", "pitch_deg": "pitch", "roll_body_deg": "roll"}.items():
        assert known[key] == pytest.approx(float(flags[f"--{flag}"]), abs=1e-9)
    assert known["position_enu_m"] == [float(flags["--east"]), float(flags["--north"]), 1.5]
    exposure = read_exposure(SAMPLES / f"{name}.png")
    assert exposure.time_utc == parse_utc(flags["--time"]) == parse_utc(known["time_utc"])
    assert (exposure.camera, exposure.terrain) == ("fisheye-2048", "shackleton-thesis")
    R_cam_enu = np.array(known["R_cam_enu"])
    R_cam_icrs = R_cam_enu @ R_enu_icrs(load_terrain("shackleton-thesis").site, exposure.time_utc)
    np.testing.assert_allclose(R_from_quat_xyzw(known["quat_xyzw_cam_icrs"]), R_cam_icrs, atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_the_image_carries_its_facts_inside_too(name):
    inside = decode_png((SAMPLES / f"{name}.png").read_bytes()).header
    beside = json.loads((SAMPLES / f"{name}.json").read_text())
    assert parse_utc(inside["DATE-AVG"]) == parse_utc(beside["time_utc"])
    assert float(inside["EXPTIME"]) == pytest.approx(beside["exposure_s"])
    assert float(inside["STTSIG"]) == beside["time_sigma_s"] == 0.0
    assert (inside["STCAMERA"], inside["STTERRAI"]) == (beside["camera"], beside["terrain"])


def test_the_tilted_sample_lost_part_of_the_rim():
    """Somewhere on the rim the direction is more than the image circle's 92.5 degrees off the axis."""
    known = truth("tilted")
    terrain = load_terrain("shackleton-thesis")
    azimuth = np.radians(np.arange(360))
    elevation = terrain.horizon_rad(np.array(known["position_enu_m"][:2])[None, :], azimuth)
    rays_enu = np.stack(
        [np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)], axis=1
    )
    off_axis = np.degrees(np.arccos(rays_enu @ np.array(known["R_cam_enu"])[2]))
    assert np.degrees(np.arccos(known["R_cam_enu"][2][2])) == pytest.approx(12, abs=0.1)
    assert np.count_nonzero(off_axis > 92.5) >= 45  # of 360 directions


def test_the_folder_stays_small():
    size = sum(path.stat().st_size for path in SAMPLES.iterdir() if path.is_file())
    assert size < 30e6


@pytest.mark.parametrize("name", NAMES)
def test_the_table_of_the_truth_has_the_stars(name):
    _, rows = read_ecsv(SAMPLES / f"{name}.truth.ecsv")
    assert sum(row["hidden"] == "False" for row in rows) > 500
    assert {row["catalog_id"].split()[0] for row in rows} >= {"HIP"}
    assert max(float(row["v_mag"]) for row in rows) <= 6.0
