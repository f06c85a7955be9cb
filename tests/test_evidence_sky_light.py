"""The light of the sky near the skyline: its levels, the height at which it stops, and what is not taken for it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.special import ndtr
from sky_helpers import EDGE_PX, ELEVATION_RAD, GROUND_E, NOISE_E, PX_PER_RAD, level_horizon, paint_pixels

from startrack.core.statistics import CDF_REACH, CDF_STEPS, NORMAL_CDF
from startrack.core.types import MIDDLES_RAD, SECTORS, Array, sector_of
from startrack.evidence import BAND_PX, Skyline, SkylineEstimate
from startrack.evidence.sky_levels import (
    GROUND,
    LEVEL_SECTORS,
    SKY,
    SkyLevels,
    SkyPixels,
    measure_levels,
    pixels_near_skyline,
)
from startrack.evidence.sky_light import CELL_PX, LEVELS, SkyLight, measure_sky_light, sectors_with_step
from startrack.evidence.skyline import CLIP_SHIFT_PX, MOST_REACH_PX, scale_across
from startrack.frames import rays_from_azel

STEPS_E = (7.0, 90.0)
SMOOTHED = 2 * np.sqrt(np.pi) * LEVEL_SECTORS  # sectors in one smoothed level


def levels_of(pixels: SkyPixels) -> SkyLevels:
    return measure_levels(pixels, sector_of(pixels.azimuth_rad))


def sky_of(pixels: SkyPixels) -> SkyLight:
    return measure_sky_light(pixels, level_horizon)


def wave_px(azimuth_rad: Array) -> Array:
    """A skyline that stands up to a third of a pixel aside of the predicted one."""
    return 0.2 * np.cos(azimuth_rad) + 0.13 * np.sin(3 * azimuth_rad + 1.0)


def test_the_table_of_the_normal_distribution() -> None:
    x = np.concatenate([np.linspace(-12.0, 12.0, 20_011), [-8.0, 8.0, 0.0]])
    found = np.interp(x, np.linspace(-CDF_REACH, CDF_REACH, CDF_STEPS + 1), NORMAL_CDF)  # as common.h does
    assert np.abs(found - ndtr(x)).max() < 1e-6
    assert (np.diff(found[:-3]) >= 0).all()
    assert found[0] < 1e-14 and found[-4] > 1 - 1e-14


def test_levels_slopes_and_noise_of_both_sides() -> None:
    rng = np.random.default_rng(1)
    pixels = paint_pixels(rng, 90.0, slopes_e=(0.3, -0.8))
    light = pixels.light_e + np.where(pixels.height_px > 0, 0.75 * NOISE_E, 0.0) * rng.normal(size=len(pixels.light_e))
    found = levels_of(replace(pixels, light_e=light))
    assert found.covered.all()
    sigma = np.sqrt(found.variance_e2 / SMOOTHED)
    for side, level, slope, noise in ((GROUND, GROUND_E, 0.3, NOISE_E), (SKY, GROUND_E + 90.0, -0.8, 1.25 * NOISE_E)):
        assert np.abs(found.level_e[side] - level).max() < 4.5 * sigma[side].max()
        assert found.slope_e[side] == pytest.approx(np.full(SECTORS, slope), abs=0.2)
        assert found.noise_e[side] == pytest.approx(np.full(SECTORS, noise), rel=0.06)
    assert found.step_e == pytest.approx(np.full(SECTORS, 90.0), abs=4.0)
    assert 1.0 <= found.correlation < 1.3


def test_a_slope_that_the_noise_explains_is_none() -> None:
    found = levels_of(paint_pixels(np.random.default_rng(2), 7.0))
    assert np.abs(found.slope_e).max() < 0.05  # a slope of one sector by itself has a sigma of 0.3


def test_levels_that_vary_along_the_skyline_are_followed() -> None:
    pixels = paint_pixels(np.random.default_rng(3), 90.0)
    glow = 20.0 * np.cos(pixels.azimuth_rad) * (pixels.height_px > 0)
    found = levels_of(replace(pixels, light_e=pixels.light_e + glow))
    assert found.step_e == pytest.approx(90.0 + 20.0 * np.cos(MIDDLES_RAD), abs=2.5)


def test_outliers_do_not_change_the_levels() -> None:
    rng = np.random.default_rng(4)
    pixels = paint_pixels(rng, 90.0)
    plain = levels_of(pixels)
    bad = rng.random(len(pixels.light_e)) < 0.01
    light = np.where(bad, pixels.light_e + rng.choice([-60.0, 500.0, 5e4], len(bad)), pixels.light_e)
    found = levels_of(replace(pixels, light_e=light))
    assert found.level_e == pytest.approx(plain.level_e, abs=0.3)
    assert found.noise_e == pytest.approx(plain.noise_e, rel=0.03)


def test_sectors_with_too_few_pixels_on_one_side_are_not_covered() -> None:
    pixels = paint_pixels(np.random.default_rng(5), 90.0)
    sector = sector_of(pixels.azimuth_rad)
    gone = ((sector >= 10) & (sector < 14) & (pixels.height_px > 0)) | ((sector == 100) & (pixels.height_px < 0))
    rows = {name: a[~gone] for name, a in vars(pixels).items() if np.shape(a) == gone.shape}
    kept = replace(pixels, **rows)
    sky = sky_of(kept)
    missing = [10, 11, 12, 13, 100]
    assert np.flatnonzero(~sky.levels.covered).tolist() == missing
    assert np.flatnonzero(np.isinf(sky.variance_px2)).tolist() == missing
    assert np.flatnonzero(~sectors_with_step(sky)).tolist() == missing
    assert np.abs(sky.levels.step_e[[9, 14, 99, 101]] - 90.0).max() < 2.5


def test_correlated_noise_widens_the_sigmas() -> None:
    rng = np.random.default_rng(6)
    plain, grouped = (sky_of(paint_pixels(rng, 90.0, group=group)) for group in (1, 4))
    assert plain.levels.correlation < 1.3
    assert grouped.levels.correlation == pytest.approx(4.0, rel=0.25)
    wider = np.median(grouped.levels.own_sigma_e / plain.levels.own_sigma_e)
    assert wider == pytest.approx(2.0, rel=0.15)
    assert np.median(grouped.shift_sigma_px / plain.shift_sigma_px) == pytest.approx(2.0, rel=0.15)


@pytest.mark.parametrize(
    ("step_e", "group"),
    [(7.0, 1), (90.0, 1), (14.0, 4), (90.0, 4)],
    ids=["faint", "bright", "faint, correlated noise", "bright, correlated noise"],
)
def test_shifts_of_the_skyline_are_found_within_their_sigmas(step_e: float, group: int) -> None:
    rng, off, sigma, sigma_with_levels = np.random.default_rng([7, group]), [], [], []
    for _ in range(4):
        sky = sky_of(paint_pixels(rng, step_e, shift_px=wave_px, group=group))
        off.append(sky.shift_px - wave_px(MIDDLES_RAD))
        sigma.append(sky.shift_sigma_px)
        sigma_with_levels.append(np.sqrt(sky.variance_px2))
    known = np.isfinite(sigma)
    assert known.mean() > 0.95  # where the noise excludes hardly any height, none is stated
    z = (np.array(off) / sigma)[known]
    assert np.mean(np.square(z)) == pytest.approx(1.0, abs=0.25)
    assert abs(z.mean()) < 0.2
    # The variance counts the levels' errors as those of each sector by itself, though these are smoothed.
    assert 0.3 < np.mean(np.square(np.array(off) / sigma_with_levels)[known]) < 1.1


@pytest.mark.parametrize("softness", [1.0, 1.5, 2.0])
def test_a_soft_edge_below_a_noisy_sky_is_found_where_it_is(softness: float) -> None:
    """The dark ground has less noise than the sky: taken to be sharper, the edge is found 0.1 px too low."""
    rng = np.random.default_rng(11)
    pixels = paint_pixels(rng, 90.0, edge_px=softness * EDGE_PX)
    sky_noise = 5 * NOISE_E * (pixels.height_px > softness * EDGE_PX) * rng.normal(size=len(pixels.light_e))
    found = sky_of(replace(pixels, light_e=pixels.light_e + sky_noise))
    assert found.cell_edge_px == pytest.approx(np.hypot(softness * EDGE_PX, CELL_PX / np.sqrt(12)), rel=0.1)
    sigma = found.shift_sigma_px / np.sqrt(SECTORS)
    assert abs(found.shift_px.mean()) < 4 * sigma.mean() + 0.02


def test_a_skyline_far_from_the_predicted_one_is_found_roughly() -> None:
    """Pixels between both skylines are taken for outliers: the shift is too small, by a part of it."""
    rng = np.random.default_rng(18)
    for shift in (1.0, 2.0, -2.0):
        sky = sky_of(paint_pixels(rng, 90.0, shift_px=lambda azimuth, shift=shift: np.full(len(azimuth), shift)))
        assert 0.8 < sky.shift_px.mean() / shift < 1.0
        assert sectors_with_step(sky).sum() > 200


@pytest.mark.slow
@pytest.mark.parametrize("slope", [0.0, 0.0026], ids=["level", "sloped"])  # of the sky, per step and pixel
@pytest.mark.parametrize("step_e", STEPS_E)
def test_the_variance_contains_the_errors_of_the_levels(step_e: float, slope: float) -> None:
    """Means over wide ranges, in which the errors of the smoothed levels do not average out."""
    rng, draws = np.random.default_rng(8), 40
    chi2 = np.zeros((draws, 3))
    for k in range(draws):
        sky = sky_of(paint_pixels(rng, step_e, slopes_e=(0.0, slope * step_e)))
        for j, parts in enumerate((1, 4, 8)):
            weight = 1.0 / sky.variance_px2.reshape(parts, -1)
            mean = (weight * sky.shift_px.reshape(parts, -1)).sum(axis=1) / weight.sum(axis=1)
            chi2[k, j] = np.mean(np.square(mean) * weight.sum(axis=1))
    assert chi2[:, 0].mean() == pytest.approx(1.0, abs=0.6)  # 40 draws: 2.7 standard deviations
    assert 0.55 < chi2[:, 1:].mean() < 1.35


def test_cells_have_the_likelihood_of_their_pixels() -> None:
    pixels = paint_pixels(np.random.default_rng(9), 90.0)
    sky, sector = sky_of(pixels), sector_of(pixels.azimuth_rad)
    levels, shifts = sky.levels, np.array([-1.5, -0.5, 0.0, 0.7, 1.5])
    by_pixels, by_cells = np.zeros(5), np.zeros(5)
    for s in range(0, SECTORS, 8):
        inside = (sector == s) & (np.abs(pixels.height_px) < 0.5 * LEVELS * CELL_PX)
        h, light = pixels.height_px[inside], pixels.light_e[inside]
        ground, full = levels.level_e[:, s, None] + levels.slope_e[:, s, None] * h
        here = ndtr(h / EDGE_PX)
        variance = np.square(levels.noise_e[GROUND, s]) * (1 - here) + np.square(levels.noise_e[SKY, s]) * here
        usual = np.square(light - ground - (full - ground) * here) <= 3.5**2 * variance * levels.correlation
        visible = ndtr((h - shifts[:, None]) / EDGE_PX)
        rest = np.square(light - ground - (full - ground) * visible) - np.square(light - ground)
        by_pixels += np.sum((-0.5 * rest / variance / levels.correlation)[:, usual], axis=1)
        visible = ndtr((sky.height_px[s] - shifts[:, None]) / sky.cell_edge_px)
        by_cells += np.sum(visible * (sky.llr[s] + 0.5 * sky.extended_nats[s] * (1 - visible)), axis=1)
    assert by_cells - by_cells[2] == pytest.approx(by_pixels - by_pixels[2], rel=0.06)
    assert np.argmax(by_cells) == 2


def test_rows_of_evidence() -> None:
    sky = sky_of(paint_pixels(np.random.default_rng(10), 90.0))
    chosen = (np.arange(SECTORS) % 3 == 0) & (np.arange(SECTORS) < 120)
    rows = sky.evidence(chosen)
    sector = sector_of(rows.azimuth_rad)
    assert np.array_equal(np.unique(sector), np.flatnonzero(chosen))
    assert len(rows) == LEVELS * np.count_nonzero(chosen)
    assert rows.edge_sigma_rad == pytest.approx(np.full(len(rows), sky.cell_edge_px / PX_PER_RAD))
    height_px = (rows.elevation_rad - ELEVATION_RAD) * PX_PER_RAD
    assert height_px == pytest.approx(sky.height_px[chosen].ravel())
    # The variance of the shift by these rows is that of the sector with its levels.
    wider = sky.extended_nats[chosen].sum(axis=1) / np.bincount(sector, rows.extended_nats, SECTORS)[chosen]
    assert wider == pytest.approx((sky.variance_px2 / np.square(sky.shift_sigma_px))[chosen])
    assert rows.llr / rows.extended_nats == pytest.approx((sky.llr / sky.extended_nats)[chosen].ravel())


def test_another_predicted_skyline_moves_the_shifts() -> None:
    pixels = paint_pixels(np.random.default_rng(11), 90.0, shift_px=wave_px)
    sky = sky_of(pixels)

    def raised(azimuth_rad: Array) -> Array:
        return level_horizon(azimuth_rad) + wave_px(azimuth_rad) / PX_PER_RAD

    height = pixels.height_px - wave_px(pixels.azimuth_rad)
    above = measure_sky_light(replace(pixels, height_px=height), raised)
    sigma = np.sqrt(np.median(sky.variance_px2))
    assert np.abs(above.shift_px - (sky.shift_px - wave_px(MIDDLES_RAD))).max() < 1.5 * sigma
    assert np.abs(above.shift_px).mean() < sigma < 0.4 * np.abs(sky.shift_px).mean()
    assert np.allclose(above.elevation_rad, raised(MIDDLES_RAD))


def test_a_skyline_far_from_a_prediction_of_as_large_an_error_is_found_within_its_sigma() -> None:
    """One that is taken to be right to a pixel loses the pixels between both as outliers."""
    pixels = paint_pixels(np.random.default_rng(21), 90.0, shift_px=lambda azimuth: np.full(azimuth.shape, 2.6))
    z, sigma_px = {}, {}
    for reach_px in (CLIP_SHIFT_PX, 3.0):
        sky = sky_of(replace(pixels, reach_px=np.full(SECTORS, reach_px)))
        z[reach_px] = (sky.shift_px - 2.6) / np.sqrt(sky.variance_px2)
        sigma_px[reach_px] = np.median(sky.shift_sigma_px)
    assert abs(z[3.0].mean()) < 0.25 and np.square(z[3.0]).mean() < 1.5
    assert sigma_px[3.0] < 0.9 * sigma_px[CLIP_SHIFT_PX] or abs(z[CLIP_SHIFT_PX].mean()) > 1.0


@pytest.mark.parametrize("step_e", STEPS_E)
def test_a_step_counts_in_nearly_every_sector(step_e: float) -> None:
    assert np.count_nonzero(sectors_with_step(sky_of(paint_pixels(np.random.default_rng(12), step_e)))) > 230


@pytest.mark.parametrize(
    ("step_e", "edge_px"),
    [(0.0, EDGE_PX), (0.1, EDGE_PX), (90.0, 4.0), (-90.0, 4.0), (90.0, 8.0), (20.0, 5.0)],
    ids=["no step", "lost in the noise", "ramp", "ramp of bright ground", "wide ramp", "weak ramp"],
)
def test_light_that_is_no_sky_above_a_skyline_does_not_count(step_e: float, edge_px: float) -> None:
    sky = sky_of(paint_pixels(np.random.default_rng(13), step_e, edge_px=edge_px))
    assert not sectors_with_step(sky).any()


def darkened(pixels: SkyPixels, which: Any, level_e: float, seed: int) -> SkyPixels:
    """The pixels with those that are chosen at another level."""
    noise = np.random.default_rng(seed).normal(0, NOISE_E, len(pixels.light_e))
    return replace(pixels, light_e=np.where(which, level_e + noise, pixels.light_e))


def test_a_mast_leaves_its_sectors_out() -> None:
    pixels = paint_pixels(np.random.default_rng(14), 90.0)
    sector = sector_of(pixels.azimuth_rad)
    good = sectors_with_step(sky_of(darkened(pixels, (sector >= 50) & (sector < 54), GROUND_E, 1)))
    assert not good[50:54].any()
    assert np.count_nonzero(good) > 200


def test_a_slope_as_bright_as_the_sky_says_nothing() -> None:
    pixels = paint_pixels(np.random.default_rng(15), 90.0)
    sector = sector_of(pixels.azimuth_rad)
    sky = sky_of(darkened(pixels, (sector >= 80) & (sector < 90), GROUND_E + 90.0, 2))
    assert np.isinf(sky.shift_sigma_px[80:90]).all()
    assert sky.extended_nats[80:90].sum(axis=1).max() < 1e-3 * np.median(sky.extended_nats.sum(axis=1))
    assert np.count_nonzero(sectors_with_step(sky)[np.isfinite(sky.shift_sigma_px)]) > 220


def test_a_lit_rim_does_not_move_the_skyline() -> None:
    """A strip of the ground below the skyline that is brighter than the sky: its pixels are outliers."""
    pixels = paint_pixels(np.random.default_rng(16), 90.0)
    sector, height = sector_of(pixels.azimuth_rad), pixels.height_px
    strip = (sector >= 120) & (sector < 126) & (height > -4.0) & (height < 0.0)
    sky = sky_of(darkened(pixels, strip, GROUND_E + 300.0, 3))
    good = sectors_with_step(sky)
    assert (~good | (np.abs(sky.shift_px) < 3.5 * np.sqrt(sky.variance_px2)))[120:126].all()
    assert np.count_nonzero(good) > 200


def test_too_few_sectors_with_a_step_do_not_count() -> None:
    pixels = paint_pixels(np.random.default_rng(17), 90.0)
    sector = sector_of(pixels.azimuth_rad)
    assert not sectors_with_step(sky_of(darkened(pixels, sector >= 50, GROUND_E, 4))).any()


def test_pixels_of_an_image_near_its_skyline(located: Any) -> None:
    result = located.result
    horizon = Skyline.trace(located.truth.position_enu_m[:2], result.terrain)
    near = SkylineEstimate(horizon, np.zeros(SECTORS))
    band = pixels_near_skyline(result.detections, result.camera, result.R_cam_enu, near)
    assert np.array_equal(band.reach_px, np.full(SECTORS, CLIP_SHIFT_PX))
    pixels = band.without_stars(result.photometry)
    assert len(band.pixel) > len(pixels.light_e) > 20_000
    assert np.abs(band.height_px).max() < BAND_PX
    elevation = horizon(pixels.azimuth_rad) + pixels.height_px / pixels.px_per_rad
    rays_cam = rays_from_azel(pixels.azimuth_rad, elevation) @ result.R_cam_enu.T
    xy, inside = result.camera.project(rays_cam)
    assert inside.all() and np.abs(xy - np.rint(xy)).max() < 1e-6
    columns, rows = np.rint(xy).astype(int).T
    assert np.array_equal(pixels.light_e, result.detections.image_e[rows, columns])
    assert not result.detections.dead[rows, columns].any()
    bright = result.photometry.xy_px[result.photometry.expected_e > 1000.0]
    assert cKDTree(bright).query(xy)[0].min() > 3.0  # px: three sigma of the PSF
    # The height is measured across the skyline: pixels one height apart are that far apart in the image.
    up, _ = result.camera.project(rays_from_azel(pixels.azimuth_rad, horizon(pixels.azimuth_rad)) @ result.R_cam_enu.T)
    assert np.hypot(*(xy - up).T) == pytest.approx(np.abs(pixels.height_px), rel=0.03, abs=0.05)
    assert pixels.edge_px == pytest.approx(np.hypot(result.detections.psf_sigma_px, np.sqrt(1 / 12)))
    # The band follows the error of the prediction, and leaves out what is hardly known.
    sigma_px = np.where(np.arange(SECTORS) < 120, 1.5, 4.0)
    wide = pixels_near_skyline(
        result.detections, result.camera, result.R_cam_enu,
        SkylineEstimate(horizon, sigma_px / np.median(pixels.px_per_rad)),
    )  # fmt: skip
    assert np.median(wide.reach_px[:120]) == pytest.approx(3.0, rel=0.2)
    assert BAND_PX + 1.0 < np.abs(wide.height_px).max() < BAND_PX + MOST_REACH_PX
    assert set(sector_of(wide.azimuth_rad)) <= set(np.flatnonzero(wide.reach_px < MOST_REACH_PX))


def test_the_scale_across_a_steep_skyline_is_that_of_the_shortest_way(located: Any) -> None:
    result = located.result

    def steep(azimuth_rad: Array) -> Array:
        return 0.5 + 0.3 * np.sin(6 * azimuth_rad)

    azimuth = np.linspace(0.0, 2 * np.pi, 40, endpoint=False)
    scale = scale_across(result.camera, result.R_cam_enu, steep)(azimuth)
    fine = np.linspace(0.0, 2 * np.pi, 200_000, endpoint=False)
    line, _ = result.camera.project(rays_from_azel(fine, steep(fine)) @ result.R_cam_enu.T)
    raised, _ = result.camera.project(rays_from_azel(azimuth, steep(azimuth) + 2e-3) @ result.R_cam_enu.T)
    shortest = np.array([np.hypot(*(line - point).T).min() for point in raised])
    assert scale * 2e-3 == pytest.approx(shortest, rel=0.03)
    assert (scale < 0.9 * 326.0).any()
