"""Skylines of ground whose posts err, against skylines traced over many drawn grounds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from map_helpers import POST_M, POSTS, SIGMA_M, basin

from startrack.terrain import NO_POST, ExpectedCrests, HeightMap

AZIMUTHS = np.linspace(0.02, 2 * np.pi, 90, endpoint=False)
CAMERA_M = np.array([11.0, -17.0])
GROUNDS = 400
pytestmark = pytest.mark.usefixtures("own_cache")


@pytest.fixture(scope="module")
def drawn() -> tuple[np.ndarray, np.ndarray]:
    """Errors (GROUNDS, posts) of posts, and horizons (GROUNDS, n) over them."""
    ground, rng = basin(), np.random.default_rng(3)
    errors = rng.normal(0.0, SIGMA_M, (GROUNDS, POSTS * POSTS))
    horizons = []
    for error in errors:
        raster = ground.maps[0]
        heights = (raster.heights_m.ravel() + error).astype(np.float32).reshape(raster.heights_m.shape)
        risen = replace(ground, maps=(replace(raster, heights_m=heights),), height_sigma_m=0.0)
        horizons.append(risen.horizon_rad(CAMERA_M[None], AZIMUTHS))
    return errors, np.array(horizons)


def responses(ground: HeightMap, found: ExpectedCrests) -> np.ndarray:
    """Rise (n, posts) of the skyline by a metre of each post, with the ground below the camera."""
    response = np.zeros((len(AZIMUTHS), POSTS * POSTS))
    for post, rad_per_m in ((found.post, found.rad_per_m), ground.errors.ground_posts(CAMERA_M, AZIMUTHS)):
        ray = np.nonzero(post != NO_POST)[0]
        np.add.at(response, (ray, post[post != NO_POST]), rad_per_m[post != NO_POST])
    return response


def test_moments_of_the_skyline_are_those_of_drawn_grounds(drawn):
    ground = basin()
    _, horizons = drawn
    found = ground.errors.expected_crests(CAMERA_M, AZIMUTHS)
    of_map, sigma = ground.horizon_rad(CAMERA_M[None], AZIMUTHS), horizons.std(axis=0)
    off = (horizons.mean(axis=0) - of_map - found.rise_rad) / sigma
    before = (horizons.mean(axis=0) - of_map) / sigma
    assert before.mean() > 0.05  # the map's own skyline is too low: the highest of many places is seen
    assert abs(off.mean()) < 0.05 and np.abs(off).max() < 0.25
    by_posts = SIGMA_M**2 * np.square(responses(ground, found)).sum(axis=1)
    ratio = np.sqrt(by_posts + found.own_sigma_rad**2) / sigma
    assert np.median(ratio) == pytest.approx(1.0, abs=0.06)
    low, high = np.percentile(ratio, [5, 95])  # where near ground seldom stands highest, the skyline is not normal
    assert low > 0.75 and high < 1.2


def test_the_skyline_follows_a_post_as_in_drawn_grounds(drawn):
    errors, horizons = drawn
    found = basin().errors.expected_crests(CAMERA_M, AZIMUTHS)
    response = responses(basin(), found)
    for k in range(0, len(AZIMUTHS), 9):
        strongest = int(np.argmax(response[k]))
        assert np.linalg.norm(basin().errors.post_positions_m(np.array([strongest]))[0, :2] - CAMERA_M) > 3 * POST_M
        error = errors[:, strongest]
        slope = error @ (horizons[:, k] - horizons[:, k].mean()) / (error @ error)
        noise = horizons[:, k].std() / np.sqrt(GROUNDS) / SIGMA_M
        assert slope == pytest.approx(response[k, strongest], abs=4 * noise)


def test_small_errors_leave_the_skyline_of_the_map():
    ground = basin(0.01)
    found = ground.errors.expected_crests(CAMERA_M, AZIMUTHS)
    assert np.abs(found.rise_rad).max() < 1e-4
    strongest = found.post[np.arange(len(AZIMUTHS)), found.rad_per_m.argmax(axis=1)]
    _, distance, _ = ground.horizons(CAMERA_M, AZIMUTHS)
    away = np.linalg.norm(ground.errors.post_positions_m(strongest)[:, :2] - CAMERA_M, axis=1)
    assert away == pytest.approx(distance, abs=2 * POST_M)
    assert (found.post[found.rad_per_m > 0.0] != NO_POST).all()


def test_exact_ground_has_no_such_moments():
    assert basin(0.0).errors.expected_crests(CAMERA_M, AZIMUTHS) is None


def test_the_skyline_depends_on_nothing_that_was_computed_before():
    """Old memory that was read made positions on a map with errors of posts impossible, mostly at the first use."""
    ground = basin()
    first = ground.errors.expected_crests(CAMERA_M, AZIMUTHS)
    basin(40.0).errors.expected_crests(CAMERA_M + 90.0, AZIMUTHS + 0.4)
    for one, other in zip(first, ground.errors.expected_crests(CAMERA_M, AZIMUTHS), strict=True):
        np.testing.assert_array_equal(one, other)
