"""Edges of clouds before a skyline: what they are worth, and that no picture takes them for the skyline unawares."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from horizon_helpers import CAMERA, SITE, painted_frame, skyline_deg

from startrack.applications.horizon import measure_skyline
from startrack.applications.horizon.clouds import cloud_density, cloud_probability, cloud_sigma_rad, layer_depth
from startrack.applications.horizon.columns import AZIMUTH_COLUMNS
from startrack.applications.horizon.measure import join_skylines
from startrack.applications.horizon.posterior import sky_likelihood_ratio
from startrack.applications.horizon.skylight import StarLight, Steps
from startrack.catalog import load_catalog
from startrack.core.types import Evidence, MeasuredSkyline


def skyline(elevation_deg: float | np.ndarray, sigma_deg: float = 0.1, cloud: float = 0.0) -> MeasuredSkyline:
    elevation = np.radians(np.broadcast_to(elevation_deg, 360).astype(float))
    known = np.isfinite(elevation)
    return MeasuredSkyline(
        azimuth_rad=np.radians(np.arange(360.0)), elevation_rad=elevation,
        sigma_rad=np.where(known, np.radians(sigma_deg), np.inf), source=np.where(known, "sky light", ""),
        cloud_probability=np.full(360, cloud),
    )  # fmt: skip


def stars(azimuth_deg: float, elevation_deg: np.ndarray, llr: float, missing: float = 0.01) -> StarLight:
    elevation = np.radians(elevation_deg)
    azimuth = np.full(elevation.shape, np.radians(azimuth_deg))
    rays = Evidence(azimuth_rad=azimuth, elevation_rad=elevation, llr=np.full(elevation.shape, llr))
    return StarLight(rays, np.zeros((0, 2)), np.zeros(0), missing)


def steps(column: np.ndarray, elevation_deg: float, log_ratio: float) -> Steps:
    values = np.radians(elevation_deg), 1e-3, -0.3, log_ratio, 0.0, 9.0
    return Steps(column, *(np.full(len(column), value) for value in values))


@pytest.mark.slow
def test_clouds_are_not_taken_for_the_skyline():
    """Of 327 azimuths 232 were at a cloud's edge, up to 9 degrees too high, with sigmas of 0.1 degrees.

    Four of ten expected stars are missing high in the sky too, since none fainter than V 7.5 is painted: it is cloudy.
    """
    found = measure_skyline([painted_frame(1, with_clouds=True)], load_catalog(), SITE, camera=CAMERA).skyline
    true = skyline_deg((np.arange(360.0)[:, None] + np.arange(-0.49, 0.5, 0.02)) % 360).mean(axis=1)
    error = (np.degrees(found.elevation_rad) - true)[found.known]
    assert len(error) > 50  # between the clouds
    assert np.mean(np.abs(error) < 3 * np.degrees(found.sigma_rad[found.known])) > 0.97


def test_a_layer_is_foreshortened():
    grid = np.linspace(0.0, np.radians(40.0), 200_001)
    slant = 1.0 / np.sin(np.maximum(grid, np.radians(8.0))) ** 2
    assert layer_depth(grid[[-1]])[0] == pytest.approx(np.trapezoid(slant, grid), rel=1e-6)
    assert np.all(np.diff(layer_depth(np.radians(np.arange(-5.0, 60.0)))) > 0)


def test_the_sky_above_the_skyline_is_counted():
    count = 300
    column = np.arange(count) * 4 % AZIMUTH_COLUMNS
    edges = steps(column, 12.0, -0.3)
    low, high = np.zeros(AZIMUTH_COLUMNS), np.full(AZIMUTH_COLUMNS, np.radians(12.0))
    found = cloud_density(edges, low)
    sky = layer_depth(np.radians(20.0)) - layer_depth(np.radians(3.0))
    assert found == pytest.approx(count / AZIMUTH_COLUMNS / sky, rel=0.02)
    assert cloud_density(edges, high) < 0.1 * found  # they are the skyline itself
    assert cloud_density(replace(edges, contrast=-edges.contrast), low) < 0.1 * found  # brighter below: no ground


def test_missing_stars_and_darkness_say_that_an_edge_is_the_grounds():
    columns, behind = np.arange(AZIMUTH_COLUMNS), np.arange(6.0, 11.0)

    def probability(light: StarLight, elevation_deg: float = 12.0, log_ratio: float = -0.5) -> np.ndarray:
        edge = np.radians(elevation_deg)
        found = steps(columns, elevation_deg, log_ratio)
        return cloud_probability(found, light, np.full(len(columns), edge), np.full(360, edge), 0.0)

    clear = stars(180.0, np.zeros(0), 0.0)
    alone, hidden = probability(clear), probability(stars(180.0, behind, -9.0))
    assert hidden[180] < 0.02 * alone[180]  # unless one cloud hides them all: a hundredth
    assert hidden[0] == alone[0]
    assert probability(stars(180.0, behind, -9.0, missing=0.5))[180] > 10 * hidden[180]
    assert probability(clear, 0.0).max() == 0.0  # nothing is lower
    assert probability(clear, log_ratio=-0.15)[0] > 5 * alone[0] > 50 * probability(clear, log_ratio=-1.2)[0]


def test_two_sigma_hold_the_part_of_a_skyline_that_is_behind_a_cloud():
    rng, probability = np.random.default_rng(1), np.array([0.001, 0.0455, 0.1, 0.3, 0.8])
    sigma = cloud_sigma_rad(probability, np.full(5, np.radians(6.0)))
    below = np.where(rng.random((100_000, 5)) < probability, rng.uniform(0.0, np.radians(6.0), (100_000, 5)), 0.0)
    beyond = np.mean(below > 2.0 * sigma, axis=0)
    np.testing.assert_allclose(beyond, np.minimum(probability, 0.0455), atol=0.002)
    assert sigma[:2].tolist() == [0.0, 0.0]


def test_what_is_behind_a_step_in_the_sky_is_sky():
    ratio = sky_likelihood_ratio(np.log([1.0, 0.9, 0.7, 0.37, 0.2]))
    assert np.all(np.diff(ratio) < 0)
    assert ratio[1] > 10 > 1 > ratio[3]
    np.testing.assert_allclose(sky_likelihood_ratio(np.log([1 / 0.7, 1 / 0.2])), ratio[[2, 4]])  # a lit ground


def test_a_clouds_edge_in_one_picture_is_nothing_that_moved():
    low, raised_deg = skyline(2.0), np.where(np.arange(360) < 40, 9.0, 2.0)
    for cloud, count in ((0.2, 0), (0.002, 40)):
        high = skyline(raised_deg, cloud=cloud)
        found = join_skylines(low, [low, high, low])
        assert np.count_nonzero(found.source == "varies") == count
        np.testing.assert_allclose(found.elevation_rad, (high if count else low).elevation_rad)


def test_pictures_that_differ_widen_what_they_do_not_show_together():
    nothing = skyline(np.nan)
    found = join_skylines(nothing, [skyline(2.0, 0.1, 0.2), skyline(5.0, 0.2, 0.3)])
    np.testing.assert_array_equal(found.cloud_probability, 0.2)
    np.testing.assert_allclose(np.degrees(found.elevation_rad), 2.0)
    np.testing.assert_allclose(np.degrees(found.sigma_rad), np.hypot(0.1, 3.0))
    alone = join_skylines(nothing, [skyline(2.0, 0.1, 0.2), nothing])
    np.testing.assert_allclose(np.degrees(alone.sigma_rad), 0.1)
