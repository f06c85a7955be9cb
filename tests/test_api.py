"""The library's front door: paths, arrays and astropy's types in, a solution that prints itself out."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from astropy import units as u
from astropy.time import Time

import startrack
import startrack.api
from startrack.errors import BadInput
from startrack.exposure import read_exposure
from startrack.given import given_exposure

IMAGE = "sample_images/near-wall.png"
LOWELL = "sample_images/lowell-2018-08-06.fits.bz2"
TRUTH_M = np.array([-6900.0, 4700.0])


@pytest.fixture(scope="module")
def solution():
    return startrack.locate(IMAGE)


def test_a_path_is_enough(solution):
    assert solution
    assert np.linalg.norm(solution.position_m[:2] - TRUTH_M) < 3 * solution.radius95_m
    assert solution.covariance_m2.shape == (2, 2)


def test_an_array_with_camera_terrain_and_astropy_time_gives_the_same(solution):
    exposure = read_exposure(IMAGE)
    pixels = exposure.pixels_adu.astype(np.uint16)
    again = startrack.locate(pixels, camera=exposure.camera, terrain=exposure.terrain, time=solution.time.tai)
    np.testing.assert_allclose(again.position_m, solution.position_m, atol=1e-6)


def test_astropy_types_at_the_edge(solution):
    assert isinstance(solution.time, Time)
    assert abs((solution.time - Time("2029-09-08T03:12:45")).sec) < 1e-6
    axis = solution.result.attitude.R_cam_icrs[2]
    np.testing.assert_allclose(solution.boresight.cartesian.xyz.value, axis, atol=1e-12)
    assert solution.stars["x_px"].unit == u.pix
    assert len(solution.stars) > 5000
    assert solution.modes["east"].unit == u.m


def test_it_prints_itself(solution, tmp_path):
    assert repr(solution).startswith("near-wall.png  ok  E -690")
    assert "<pre>" in solution._repr_html_()
    path = solution.write(tmp_path, plots=False)
    assert path.name == "near-wall.fix.json"
    assert solution.to_dict()["position"]["frame"] == "enu"


def test_a_picture_without_stars_says_why():
    flat = startrack.locate(
        np.full((2048, 2048), 300, np.uint16), camera="fisheye-2048", terrain="shackleton-thesis",
        time="2030-01-01T00:00:00Z",
    )  # fmt: skip
    assert not flat
    assert flat.reason == "no_stars"
    assert flat.position_m is None


def test_what_is_missing_is_asked_for():
    pixels = np.zeros((64, 64), np.uint16)
    with pytest.raises(BadInput, match="camera="):
        startrack.locate(pixels)
    with pytest.raises(BadInput, match="terrain="):
        startrack.locate(pixels, camera="fisheye-2048")


def test_importing_startrack_loads_nothing_heavy():
    code = "import startrack, sys; print('numpy' in sys.modules, startrack.__version__)"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.startswith("False")


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ({"image": np.zeros((64, 64, 4), np.uint8)}, "bad_image"),
        ({"image": np.zeros((64, 64), complex)}, "bad_image"),
        ({"image": np.full((64, 64), np.nan)}, "bad_image"),
        ({"image": 7}, "bad_image"),
        ({"image": [["a"]]}, "bad_image"),
        ({"image": IMAGE, "time": 2461000.5}, "no_time"),
        ({"image": IMAGE, "time": Time(["2030-01-01", "2030-01-02"])}, "no_time"),
        ({"image": IMAGE, "camera": 5}, "bad_calibration"),
        ({"image": IMAGE, "terrain": 5}, "bad_terrain"),
    ],
)
def test_odd_things_are_refused_with_a_reason(given, reason):
    with pytest.raises(BadInput) as caught:
        startrack.locate(**given)
    assert caught.value.reason == reason


def test_colours_lists_and_paths_are_pictures():
    pixels = np.full((64, 64, 3), 300, np.uint16)
    assert "mean of its three channels" in given_exposure(pixels, None).warnings[0]
    assert given_exposure(pixels[..., 0].tolist(), None).size_px == (64, 64)
    assert given_exposure(Path(IMAGE), None).name == "near-wall"


def test_a_field_of_view_stands_in_for_a_camera():
    found = startrack.api.identify(LOWELL, fov=180 * u.deg)
    assert found
    assert found.result.camera is not None
    assert len(found.result.identification.star) > 1000
    with pytest.raises(BadInput, match="no field of view"):
        startrack.api.identify(IMAGE, fov="wide")
