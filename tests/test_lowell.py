"""A real photograph: trees, the Moon's glow, hot pixels, trailed stars, and a lens that is not equidistant."""

import csv
import importlib.util
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from startrack.camera import load_camera
from startrack.catalog import load_catalog
from startrack.chain import identify
from startrack.exposure import read_exposure
from startrack.frames import parse_utc

ROOT = Path(__file__).parent.parent
PHOTO = ROOT / "sample_images/lowell-2018-08-06.fits.bz2"
STARS = Path(__file__).parent / "data/lowell-2018-08-06-stars.csv"
SAME_LIGHT_PX = 1.5


@pytest.fixture(scope="module")
def exposure():
    return read_exposure(PHOTO)


@pytest.fixture(scope="module")
def result(exposure):
    return identify(exposure, load_camera("lowell-ldt"), load_catalog())


@pytest.fixture(scope="module")
def reference():
    """Hipparcos numbers (n,), Hp (n,) and pixels (n, 2) of stars matched without startrack."""
    with STARS.open() as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    px = np.array([[float(row["x_px"]), float(row["y_px"])] for row in rows])
    return np.array([int(row["hip"]) for row in rows]), np.array([float(row["hp_mag"]) for row in rows]), px


def test_the_photograph_brings_its_facts(exposure):
    assert exposure.size_px == (1392, 1040)
    assert exposure.time_utc == parse_utc("2018-08-06T05:17:34.752Z")
    assert exposure.exposure_s == 60.0
    assert exposure.camera == "lowell-ldt"
    assert exposure.sha256 == "1be8319194fb753e4c966e41459f4e223d33961b5c9150a57478f15264488d06"


def test_its_stars_are_identified(result):
    assert result.status == "ok", result.message
    assert len(result.identification) >= 1500
    assert result.attitude_fit.rms_px < 0.35
    assert result.identification.false_alarm_probability < 1e-100


def test_identities_agree_with_those_found_without_startrack(result, reference):
    hip, _, px = reference
    found = result.identification
    distance, nearest = cKDTree(px).query(result.detections.xy_px[found.detection])
    both = distance < SAME_LIGHT_PX
    same = result.stars.hip[found.star][both] == hip[nearest[both]]
    assert both.sum() >= 400
    assert same.mean() >= 0.99


def test_most_stars_of_the_reference_are_detected_the_bright_ones_too(result, reference):
    _, hp_mag, px = reference
    distance, _ = cKDTree(result.detections.xy_px).query(px)
    seen = distance < SAME_LIGHT_PX
    assert seen.mean() >= 0.95
    assert seen[hp_mag < 3.0].mean() >= 0.95


def test_its_mirror_image_is_refused_as_such(exposure):
    flipped = replace(exposure, pixels_adu=exposure.pixels_adu[:, ::-1].copy())
    camera = load_camera("lowell-ldt")
    camera = replace(camera, centre_px=(camera.size_px[0] - 1 - camera.centre_px[0], camera.centre_px[1]))
    result = identify(flipped, camera, load_catalog())
    assert (result.status, result.reason) == ("refused", "mirrored")


def test_the_camera_file_is_what_its_script_fits():
    spec = importlib.util.spec_from_file_location("fit_lowell_camera", ROOT / "sample_images/fit_lowell_camera.py")
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    rays_enu, px = script.read_stars(STARS)
    fitted, distance = script.fit(rays_enu, px)
    shipped = load_camera("lowell-ldt")
    assert np.sqrt(np.mean(distance[distance < 2] ** 2) / 2) < 0.34
    angle = np.radians(np.arange(1, 83))
    np.testing.assert_allclose(
        fitted.focal_px[0] * fitted.lens.rho(angle), shipped.focal_px[0] * shipped.lens.rho(angle), atol=1e-3
    )
    np.testing.assert_allclose(fitted.centre_px, shipped.centre_px, atol=1e-3)
