"""Skylines whose ground is brighter than the sky, or as bright, and steps of light that are no skyline."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from horizon_helpers import CAMERA, GROUND, SITE, SKY, painted_frame, skyline_deg

from startrack.applications.horizon import measure_skyline, orient_frames
from startrack.applications.horizon.columns import (
    AVERAGINGS,
    AZIMUTH_COLUMNS,
    COLUMN_SAMPLES,
    Columns,
    average_columns,
    coarser,
    elevations_rad,
    mean_above,
)
from startrack.applications.horizon.measure import _has_step, measure_frames
from startrack.applications.horizon.posterior import KINDS, add_step_log_likelihood, combine_columns
from startrack.applications.horizon.skylight import Steps, _steps_of, measure_stars
from startrack.catalog import load_catalog
from startrack.core.types import MeasuredSkyline

BRIGHT, LIT = 640.0, (140.0, 330.0)  # ground in moonlight, and between which azimuths


def sky_with_slope(azimuth_deg: np.ndarray, elevation_deg: np.ndarray) -> np.ndarray:
    return SKY * (1.0 + 0.4 * np.cos(np.radians(azimuth_deg)) * np.exp(-np.maximum(elevation_deg, 0.0) / 15.0))


def even_sky(azimuth_deg: np.ndarray, elevation_deg: np.ndarray) -> np.ndarray:
    return np.full(azimuth_deg.shape, SKY)


def lit_ground(azimuth_deg: np.ndarray, elevation_deg: np.ndarray) -> np.ndarray:
    return np.where((azimuth_deg > LIT[0]) & (azimuth_deg < LIT[1]), BRIGHT, GROUND)


def snow_below_the_ridge(azimuth_deg: np.ndarray, elevation_deg: np.ndarray) -> np.ndarray:
    """Ground as bright as the sky, with dark ground from three degrees below the skyline down."""
    return np.where(elevation_deg > skyline_deg(azimuth_deg) - 3.0, SKY, GROUND)


def errors(found: MeasuredSkyline) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Known azimuths (n,), errors [deg] and sigmas [deg]."""
    true = skyline_deg((np.arange(360.0)[:, None] + np.arange(-0.49, 0.5, 0.02)) % 360).mean(axis=1)
    known = np.flatnonzero(found.known)
    return known, (np.degrees(found.elevation_rad) - true)[known], np.degrees(found.sigma_rad[known])


def measure(ground, sky) -> MeasuredSkyline:
    frame = painted_frame(4, ground=ground, sky=sky, faintest_mag=99.0)
    return measure_skyline([frame], load_catalog(), SITE, camera=CAMERA).skyline


@pytest.mark.slow
@pytest.mark.parametrize("sky", [even_sky, sky_with_slope])
def test_ground_that_is_brighter_than_the_sky_has_a_skyline(sky):
    known, error, sigma = errors(measure(lit_ground, sky))
    lit = (known > LIT[0]) & (known < LIT[1])
    assert lit.sum() > 150 and len(known) > 300
    assert np.median(np.abs(error[lit])) < 0.1
    assert np.mean(np.abs(error) < 3 * sigma) > 0.97


@pytest.mark.slow
def test_a_step_of_light_below_a_faint_ridge_is_not_stated_as_the_skyline():
    _, error, sigma = errors(measure(snow_below_the_ridge, even_sky))
    assert np.count_nonzero(np.abs(error) > 3 * sigma) <= 18  # of 360


@pytest.mark.slow
def test_a_step_of_light_in_the_sky_is_not_stated_as_the_skyline():
    def banded(azimuth_deg: np.ndarray, elevation_deg: np.ndarray) -> np.ndarray:
        return np.where(elevation_deg > 16.0, 1.3 * SKY, SKY)

    _, error, sigma = errors(measure(lambda azimuth_deg, elevation_deg: np.full(azimuth_deg.shape, GROUND), banded))
    assert len(error) > 250
    assert np.mean(np.abs(error) < 3 * sigma) > 0.97


def columns_of(light_e: np.ndarray, noise_e: float, step_deg: float = 0.04) -> Columns:
    elevation = np.radians(-2.0 + step_deg * np.arange(len(light_e)))
    step = float(np.radians(step_deg))
    px = COLUMN_SAMPLES * step
    return Columns(elevation, light_e, np.full(light_e.shape, noise_e), step, px, px)


def test_light_that_falls_smoothly_has_no_steps():
    rows, noise = 1200, 2.0
    elevation_deg = -2.0 + 0.04 * np.arange(rows)
    lens = 25.0 * np.clip((elevation_deg + 3.0) / 6.0, 0.0, 1.0) ** 0.5  # of a lens that darkens at its edge
    edge = np.where(elevation_deg > 8.0, 1.0, 0.7)
    rng = np.random.default_rng(2)
    pixels = rng.normal(size=(rows // COLUMN_SAMPLES, AZIMUTH_COLUMNS)).repeat(COLUMN_SAMPLES, axis=0) * noise
    found = _steps_of(columns_of((lens * edge)[:, None] + pixels, noise), AVERAGINGS[2])
    clear = found.significance > 6.0
    at_edge = np.abs(np.degrees(found.elevation_rad) - 8.0) < 0.3
    assert len(np.unique(found.column[clear & at_edge])) > 0.9 * AZIMUTH_COLUMNS
    assert np.count_nonzero(clear & ~at_edge) < 0.01 * AZIMUTH_COLUMNS


def test_the_mean_of_unlike_columns_has_the_error_by_which_they_differ():
    rng = np.random.default_rng(3)
    light = rng.normal(100.0, 2.0, (300, AZIMUTH_COLUMNS))
    light[:150, :700] -= 80.0  # a wall at the column 700
    mean = average_columns(columns_of(light, 2.0), 21)
    assert mean.noise_e[60, 700] > 20.0
    assert np.median(mean.noise_e[60, 720:1400]) < 1.5


@pytest.mark.parametrize("averaging", AVERAGINGS)
@pytest.mark.parametrize("px_of_columns", [1, 4])
def test_the_noise_of_means_is_that_of_white_noise(averaging, px_of_columns):
    """Over four pixels of each averaging, of an image's pixels as wide as a column, or four to a column."""
    noise, pixels, width_deg = 3.0, 200, 360.0 / AZIMUTH_COLUMNS
    drawn = np.random.default_rng(5).normal(0.0, noise, (pixels, AZIMUTH_COLUMNS, px_of_columns)).mean(axis=2)
    step_deg = width_deg / px_of_columns / COLUMN_SAMPLES
    columns = columns_of(drawn.repeat(COLUMN_SAMPLES, axis=0), noise, step_deg)
    found = coarser(columns, averaging.pixels)
    for slope in averaging.slopes[len(averaging.slopes) // 2 :]:
        mean, inside = average_columns(found, averaging.columns, slope=slope), slice(30, -30)
        true = np.nanstd(mean_above(mean, 0.0, 4.0)[inside]) * np.sqrt(4.0)
        assert true / np.median(mean.noise_e[inside]) == pytest.approx(1.0, abs=0.15)


def test_a_view_without_open_sky_has_steps():
    light = np.full((600, AZIMUTH_COLUMNS), 100.0)
    light[:200] = 50.0
    light[300:] = np.nan
    found = _steps_of(columns_of(light + np.random.default_rng(6).normal(size=light.shape), 1.0), AVERAGINGS[0])
    assert len(np.unique(found.column[found.significance > 9.0])) == AZIMUTH_COLUMNS


def test_white_noise_has_no_skyline():
    noise, share = 3.0, []
    drawn = 300.0 + np.random.default_rng(7).normal(0.0, noise, (400, AZIMUTH_COLUMNS))
    columns = columns_of(drawn.repeat(COLUMN_SAMPLES, axis=0), noise, 360.0 / AZIMUTH_COLUMNS / COLUMN_SAMPLES)
    steps = [_steps_of(columns, averaging) for averaging in AVERAGINGS]
    for elevation_deg in (5.0, 10.0, 20.0):
        share.append(_has_step([steps], np.full(AZIMUTH_COLUMNS, np.radians(elevation_deg))).mean())
    assert max(share) < 0.02


def test_means_follow_a_slope():
    slope, columns = 0.6, columns_of(np.zeros((600, AZIMUTH_COLUMNS)), 1.0)
    azimuth = (np.arange(AZIMUTH_COLUMNS) - 700) * 2 * np.pi / AZIMUTH_COLUMNS
    ramp = (columns.elevation_rad[:, None] - slope * azimuth > np.radians(10.0)).astype(float)
    along = average_columns(replace(columns, light_e=ramp), 21, slope=slope).light_e[:, 700]
    across = average_columns(replace(columns, light_e=ramp), 21).light_e[:, 700]
    assert np.count_nonzero((along > 0.05) & (along < 0.95)) < 0.2 * np.count_nonzero((across > 0.05) & (across < 0.95))


def test_a_coarser_column_has_the_means_of_its_pixels():
    columns = columns_of(np.arange(12.0)[:, None] * np.ones(AZIMUTH_COLUMNS), 3.0)
    found = coarser(columns, 3)
    np.testing.assert_allclose(found.light_e[:, 0], [1.0, 4.0, 7.0, 10.0])
    np.testing.assert_allclose(found.noise_e, np.sqrt(3.0))
    assert found.px_rad == pytest.approx(3 * columns.px_rad)
    assert found.across_px_rad == columns.across_px_rad


def edge(elevation_deg: float, contrast: float, which: np.ndarray, dimming: float = 0.0, clear: float = 9.0) -> Steps:
    values = np.radians(elevation_deg), np.radians(0.05), contrast, np.log1p(contrast), dimming, clear
    return Steps(which, *(np.full(len(which), value) for value in values))


def test_the_sign_of_the_step_is_a_matter_of_many_columns():
    """A bright skyline among bright ones costs nothing; a clearer dark edge of a few columns below it is not it."""
    column = np.arange(AZIMUTH_COLUMNS)
    one = np.ones(AZIMUTH_COLUMNS)
    bright = np.zeros((len(KINDS), AZIMUTH_COLUMNS, len(elevations_rad())), np.float32)
    dark = bright.copy()
    add_step_log_likelihood(bright, edge(5.0, 0.5, column), 1.0)
    add_step_log_likelihood(dark, edge(5.0, -0.5, column), 1.0)
    for likelihood in (bright, dark):
        mean, sigma = combine_columns(likelihood)
        np.testing.assert_allclose(np.degrees(mean), 5.0 * one, atol=0.05)
        assert np.degrees(sigma.max()) < 0.1


@pytest.mark.parametrize(("dimming", "found_deg"), [(1.3, 5.0), (0.0, 3.0)])
def test_lit_ground_below_a_dark_ridge_is_no_skyline(dimming, found_deg):
    """A faint edge at 5 degrees, a clear one at which the light rises at 3: between them is dark ground, or sky."""
    column = np.arange(AZIMUTH_COLUMNS)
    likelihood = np.zeros((len(KINDS), AZIMUTH_COLUMNS, len(elevations_rad())), np.float32)
    add_step_log_likelihood(likelihood, edge(5.0, -0.25, column, clear=1.5), 0.5)
    add_step_log_likelihood(likelihood, edge(3.0, 0.25, column, dimming, 5.0), 0.5)
    mean, _ = combine_columns(likelihood)
    np.testing.assert_allclose(np.degrees(mean), found_deg, atol=0.1)


def test_steps_know_how_dark_the_light_above_them_is():
    rows, noise = 900, 1.0
    elevation_deg = -2.0 + 0.04 * np.arange(rows)
    light = np.select([elevation_deg < 6.0, elevation_deg < 8.0], [90.0, 50.0], 110.0)  # lit ground, a ridge, the sky
    light[:30] = 10.0  # the darkest pixels
    rng = np.random.default_rng(5)
    pixels = rng.normal(size=(rows // COLUMN_SAMPLES, AZIMUTH_COLUMNS)).repeat(COLUMN_SAMPLES, axis=0) * noise
    found = _steps_of(columns_of(light[:, None] + pixels, noise), AVERAGINGS[0])
    at = (np.abs(np.degrees(found.elevation_rad) - 6.0) < 0.2) & (found.significance > 3.0)
    assert len(np.unique(found.column[at])) > 0.9 * AZIMUTH_COLUMNS
    assert np.median(found.contrast[at]) == pytest.approx(0.4, abs=0.05)
    assert np.median(found.dimming[at]) == pytest.approx(np.log(100.0 / 40.0), abs=0.05)


@pytest.fixture(scope="module")
def filtered():
    """A painted frame behind a filter, as a camera's JPEG is: pixels correlate, and faint stars lose light."""
    frame = painted_frame(6)
    frame = replace(frame, pixels_adu=cv2.GaussianBlur(frame.pixels_adu, (0, 0), 0.9))
    (one,), _ = orient_frames([frame], load_catalog(), SITE, camera=CAMERA, fov_rad=None)
    return one


@pytest.mark.slow
def test_no_stars_are_seen_in_the_correlated_noise_of_the_ground(filtered):
    assert filtered.damage is not None
    rays = measure_stars(filtered).rays
    below = np.degrees(rays.elevation_rad) < skyline_deg(np.degrees(rays.azimuth_rad)) - 0.5
    above = np.degrees(rays.elevation_rad) > skyline_deg(np.degrees(rays.azimuth_rad)) + 0.5
    assert np.count_nonzero(rays.llr[above] > 2.0) > 100
    assert np.count_nonzero(rays.llr[below] > 2.0) < 0.02 * np.count_nonzero(below)
    known, error, sigma = errors(measure_frames((filtered,), (), SITE).skyline)
    assert len(known) > 250
    assert np.mean(np.abs(error) < 3 * sigma) > 0.97
