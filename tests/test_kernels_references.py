"""Compiled kernels against slow references in plain numpy: random and empty arrays, and NaN where it is legal."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from startrack.core import statistics
from startrack.core.statistics import NORMAL_CDF
from startrack.evidence import sky_levels, sky_light
from startrack.frames import wahba
from startrack.identification import attitude_refinement, star_grid
from startrack.localization import search_profiles
from startrack.localization.likelihood import smooth_skyline

SEEDS = range(3)


@pytest.mark.parametrize("size", [1, 2, 7, 240])
def test_interpolation_around_the_circle(size):
    rng = np.random.default_rng(size)
    values = rng.normal(size=size)
    azimuth = np.concatenate([rng.uniform(-30.0, 30.0, 500), [0.0, -1e-17, 2 * np.pi, -2 * np.pi, 1e6]])
    around = np.append(values, values[0])
    expected = np.interp(azimuth % (2 * np.pi), np.linspace(0.0, 2 * np.pi, size + 1), around)
    np.testing.assert_allclose(statistics.interpolate_circle(values, azimuth), expected, atol=1e-8)


def test_interpolation_of_nothing_and_of_no_number():
    assert statistics.interpolate_circle(np.arange(4.0), np.zeros((0, 3))).shape == (0, 3)
    found = statistics.interpolate_circle(np.arange(4.0), np.array([np.nan, np.inf, -np.inf, 0.0]))
    assert np.isnan(found[:3]).all() and found[3] == 0.0
    assert np.isnan(statistics.interpolate_circle(np.array([1.0, np.nan, 1.0]), np.array([2.0])))


@pytest.mark.parametrize("seed", SEEDS)
def test_disks_are_cleared_whose_middle_is_set_or_that_are_large(seed):
    rng = np.random.default_rng(seed)
    before = rng.random((40, 60)) < 0.8
    count = [0, 1, 30][seed]
    xy, radius = rng.integers(-20, 80, (count, 2)), rng.integers(0, 14, count)
    found, expected = before.copy(), before.copy()
    sky_levels._clear_disks(found, xy, radius)
    row, column = np.indices(before.shape)
    for (x, y), r in zip(xy, radius, strict=True):
        inside = 0 <= x < 60 and 0 <= y < 40
        if r > sky_levels.BAND_PX / 2 or (inside and before[y, x]):
            expected &= (column - x) ** 2 + (row - y) ** 2 > r * r
    np.testing.assert_array_equal(found, expected)


def random_pixels(seed, count):
    rng = np.random.default_rng(seed)
    sector, height = rng.integers(0, 9, count), rng.uniform(-6.0, 6.0, count)
    light = rng.normal(5.0, 2.0, count)
    light[rng.random(count) < 0.05] = np.nan
    level, slope = rng.normal(5.0, 1.0, (2, 9)), rng.normal(0.0, 0.2, (2, 9))
    return rng, sector, height, light, level, slope


@pytest.mark.parametrize("count", [0, 1, 700])
def test_sums_of_sides_leave_out_pixels_beyond_the_limit_and_those_without_light(count):
    rng, sector, height, light, level, slope = random_pixels(count, count)
    side, limit = rng.integers(-1, 2, count), rng.uniform(1.0, 4.0, (2, 9))
    found = np.zeros((2, 6, 9))
    sky_levels._sum_sides(side, sector, height, light, level, slope, limit, found)
    for s in range(2):
        for i in range(9):
            mine = (side == s) & (sector == i)
            rest = light[mine] - level[s, i] - slope[s, i] * height[mine]
            kept = np.abs(rest) <= limit[s, i]
            q, h = rest[kept], height[mine][kept]
            expected = [len(q), h.sum(), (h * h).sum(), q.sum(), (q * h).sum(), (q * q).sum()]
            np.testing.assert_allclose(found[s, :, i], expected, atol=1e-11)


@pytest.mark.parametrize("count", [0, 600])
def test_cells_are_the_sums_over_their_pixels(count):
    rng, sector, height, light, level, slope = random_pixels(count, count)
    covered, variance = rng.random(9) < 0.8, rng.uniform(0.5, 2.0, (2, 9))
    scale, reach = rng.uniform(500.0, 900.0, count), np.where(np.arange(9) % 4, rng.uniform(0.0, 3.0, 9), np.inf)
    sums, scales = np.zeros((9, 13, 3)), np.zeros((9, 2))
    sky_light._sum_cells(
        sector, height, light, scale, covered, level, slope, variance, 1.2, 1.1, reach, 3.5, 0.75, NORMAL_CDF, sums,
        scales,
    )  # fmt: skip
    expected, expected_scales = np.zeros_like(sums), np.zeros_like(scales)
    for i, h, q, per_rad in zip(sector, height, light, scale, strict=True):
        ground = level[0, i] + slope[0, i] * h
        step = level[1, i] + slope[1, i] * h - ground
        s2 = variance[0, i] + (variance[1, i] - variance[0, i]) * ndtr(h / 1.1)
        ends = step * ndtr((h - reach[i]) / 1.1), step * ndtr((h + reach[i]) / 1.1)
        beyond = max(min(ends) - (q - ground), q - ground - max(ends), 0.0)
        if covered[i] and abs(h) < 0.5 * 13 * 0.75 and not np.isnan(q) and beyond**2 * 1.2 <= 3.5**2 * s2:
            c = step * step / s2
            expected[i, int((h + 0.5 * 13 * 0.75) / 0.75)] += ((q - ground) * step - 0.5 * step * step) / s2, c, c * h
            expected_scales[i] += 1.0, per_rad
    np.testing.assert_allclose(scales, expected_scales)
    np.testing.assert_allclose(sums, expected, rtol=1e-4, atol=1e-4)  # the table of the normal distribution


def test_shifts_are_scored_by_the_fraction_of_sky_of_each_cell():
    rng = np.random.default_rng(4)
    height, llr, extended = rng.normal(size=(3, 5, 13))
    shifts, log = np.linspace(-3.0, 3.0, 11), np.empty((5, 11))
    sky_light._score_shifts(height, llr, extended, 0.8, shifts, NORMAL_CDF, log)
    visible = ndtr((height[:, None] - shifts[:, None]) / 0.8)
    expected = (visible * (llr[:, None] + 0.5 * extended[:, None] * (1.0 - visible))).sum(axis=-1)
    np.testing.assert_allclose(log, expected, atol=1e-5)
    sky_light._score_shifts(np.full_like(height, np.nan), llr, extended, 0.8, shifts, NORMAL_CDF, log)
    assert np.isfinite(log).all()


@pytest.mark.parametrize("every", [1, 4])
def test_the_circle_is_the_trace_of_the_products_of_its_sectors(every):
    rng = np.random.default_rng(every)
    hide, stop = search_profiles.HIDE, search_profiles.STOP
    clear, hidden = rng.uniform(0.05, 1.0, 40), rng.uniform(0.0, 0.5, 40 * every)
    product = np.eye(2)
    for k, e in enumerate(clear):
        moved = product @ np.array([[1.0 - hide, hide], [stop, 1.0 - stop]])
        product = moved * [e, hidden[k * every]]
    found = search_profiles._log_circle(clear, hidden, every, hide, stop)
    assert found == pytest.approx(np.log(np.trace(product)), rel=1e-12)


def test_a_curve_passes_from_sector_to_sector_by_a_full_matrix():
    rng = np.random.default_rng(6)
    heights = 0.2 * smooth_skyline.HEIGHTS
    likelihood, cells, rough = rng.uniform(0.1, 1.0, (12, len(heights))), np.gradient(heights), 2e-3
    near = np.exp(-np.abs(heights[:, None] - heights) / rough)
    step = (1.0 - smooth_skyline.JUMP) * near / (near @ cells) + smooth_skyline.JUMP / cells.sum()
    state, expected = cells / cells.sum(), []
    for s, one in enumerate(likelihood):
        state = (cells * (step @ state) if s else state) * one
        expected.append(np.log(state.sum()))
        state /= state.sum()
    np.testing.assert_allclose(smooth_skyline._pass(likelihood, heights, cells, rough), expected, rtol=1e-9)


@pytest.mark.parametrize("seed", SEEDS)
def test_inliers_turn_the_attitude_and_outliers_do_not(seed):
    rng = np.random.default_rng(seed)
    gate_px, outlier = attitude_refinement.FIRST_GATE_PX, attitude_refinement.STAR_OUTLIER_CHI2
    R, change = np.linalg.qr(rng.normal(size=(3, 3)))[0], np.eye(3) + 1e-3 * rng.normal(size=(3, 3))
    rays_cam = rng.normal(size=(30, 3))
    rays_cam /= np.linalg.norm(rays_cam, axis=1)[:, None]
    detection = np.sort(rng.integers(0, 30, 90))
    rays_icrs, distance = rays_cam[detection] @ R @ change, np.abs(rng.normal(0.0, 2.0, 90))
    distance[rng.random(90) < 0.2] = np.inf
    stated, which = rng.uniform(0.01, 0.1, 30), np.sort(rng.choice(90, 41, replace=False))
    agree, variance, refined, most = attitude_refinement.rotate_by_inliers(
        which, detection, distance, stated, rays_cam, rays_icrs, R
    )
    squared, own = distance[which] ** 2, stated[detection[which]]
    first = distance[which] < gate_px
    middles = (np.sort(one[first])[np.count_nonzero(first) // 2] for one in (squared, own))
    extra = next(middles) / attitude_refinement.CHI2_2DOF_MEDIAN - next(middles)
    np.testing.assert_allclose(variance, own + max(extra, attitude_refinement.SMALLEST_EXTRA_PX2))
    np.testing.assert_array_equal(agree, first & (squared < outlier * variance))
    cam, icrs = rays_cam[detection[which[agree]]], rays_icrs[which[agree]]
    np.testing.assert_allclose(refined, wahba(cam, icrs, 1.0 / variance[agree]), atol=1e-9)
    assert most == np.abs(refined - R).max() > 1e-6


@pytest.mark.parametrize("count", [0, 5])
def test_an_attitude_of_far_pairs_is_none(count):
    which, far = np.arange(count), np.full(count, np.inf)
    rays = np.ones((count, 3))
    agree, _, refined, change = attitude_refinement.rotate_by_inliers(which, which, far, far, rays, rays, np.eye(3))
    assert not agree.any() and not refined.any() and change == np.inf
    R, hit = star_grid.settle_rotation(rays, rays, np.zeros(count, bool), 1.0)
    assert not hit.any() and np.array_equal(R, np.eye(3))


def test_rays_of_no_number_are_near_no_star():
    rays = np.array([[np.nan, 0.0, 1.0], [0.0, 0.0, 1.0]])
    assert star_grid.StarGrid(np.array([[0.0, 0.0, 1.0]])).neighbours(rays, 0.1).ray.tolist() == [1]
