"""Kernels of detection against slow references in plain numpy: random frames and stamps, empty ones, bad pixels."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import convolve1d

from startrack.core.types import SmoothImage
from startrack.detection import background, classify, damage, deblend, fit, frame, peaks, psf_width, streaks
from startrack.psf import filter_kernel, pixel_profile

SIDE = 11
RADIUS = SIDE // 2


def random_frame(rng, shape=(61, 83), known=False, dead=False):
    image = rng.normal(100.0, 3.0, shape).astype(np.float32)
    for row, column in rng.integers(2, min(shape) - 2, (12, 2)):
        image[row - 1 : row + 2, column - 1 : column + 2] += np.float32(rng.uniform(5.0, 60.0))
    blocks = -(-shape[0] // 16), -(-shape[1] // 16)
    smooth = [
        SmoothImage.from_blocks(rng.uniform(*limits, blocks).astype(np.float32), 16, shape)
        for limits in ((95.0, 105.0), (2.0, 4.0))
    ]
    return frame.Frame(
        image, *smooth, rng.random(shape) < 0.02 if dead else None, frame.SourceNoise(1.0),
        found=rng.uniform(0.0, 9.0, shape).astype(np.float32) if known else None,
    )  # fmt: skip


def residuals_of(one):
    rows, columns = np.indices(one.shape)
    light, variance = one.image - one.background.at(rows, columns), one.noise.at(rows, columns) ** 2.0
    if one.found is None:
        return light / np.sqrt(variance)
    variance += one.found * (one.source_noise.per_unit + (frame.RESIDUAL_FRACTION * one.found) ** 2 / one.found)
    return (light - one.found) / np.sqrt(variance)


@pytest.mark.parametrize("known", [False, True])
def test_residuals_are_light_in_units_of_the_noise(known):
    one = random_frame(np.random.default_rng(1), known=known)
    found = np.empty(one.shape, np.float32)
    streaks._fill_residuals(*one.light_and_noise, found)
    np.testing.assert_allclose(found, residuals_of(one), rtol=1e-4, atol=1e-4)
    one.image[5, 7] = np.nan
    streaks._fill_residuals(*one.light_and_noise, found)
    assert np.isnan(found[5, 7]) and np.isfinite(found).sum() == found.size - 1


def test_stamps_are_cut_from_light_and_variance():
    one = random_frame(np.random.default_rng(2))
    rows, columns = np.indices(one.shape)
    centres = np.array([[5, 5], [77, 55], [40, 16]])
    for n in (0, 3):
        light, variance = one.cut_light(centres[:n], 5)
        whole = one.image - one.background.at(rows, columns), one.noise.at(rows, columns) ** 2
        for found, expected in zip((light, variance), whole, strict=True):
            cut = [expected[y - 5 : y + 6, x - 5 : x + 6] for x, y in centres[:n]]
            np.testing.assert_allclose(found, np.reshape(cut, (n, 11, 11)), rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("centre", [(4, 30), (30, 4), (78, 30), (30, 56), (-1, 30)])
def test_a_stamp_that_reaches_beyond_the_frame_is_refused(centre):
    with pytest.raises(ValueError, match="beyond the frame"):
        random_frame(np.random.default_rng(2)).cut_light(np.array([[40, 16], centre]), 5)


@pytest.mark.parametrize("bias_shape", [(1, 1), (5, 7)])
def test_counts_are_converted_and_saturated_ones_marked(bias_shape):
    rng = np.random.default_rng(3)
    counts, recorded = rng.uniform(0.0, 100.0, (2, 5, 7)).astype(np.float32)
    bias, image = rng.uniform(0.0, 9.0, bias_shape).astype(np.float32), np.empty((5, 7), np.float32)
    recorded[0, 0], recorded[1, 1] = 90.0, np.nan
    for converted in (image, image[:0]):
        saturated = np.zeros((5, 7), bool)
        frame._convert_counts(counts, recorded, 0.5, bias, 90.0, converted, saturated)
        np.testing.assert_array_equal(saturated, recorded >= 90.0)
    np.testing.assert_allclose(image, 0.5 * counts - bias, rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize(("shape", "side"), [((40, 50), 16), ((40, 50), 32), ((33, 70), 48), ((2, 1), 16)])
def test_blocks_are_reflected_at_the_border(shape, side):
    rng = np.random.default_rng(side)
    image, steps = rng.random(shape).astype(np.float32), rng.random((16, 16)).astype(np.float32)
    rows, columns = (-(-length // side) for length in shape)
    blocks = np.empty((rows - 1 or 1, columns, 16, 16), np.float32)
    first = rows - len(blocks)
    background._fill_blocks(image, side, first, steps, blocks)
    offset = np.arange(16) // 2 * (side // 8) + np.arange(16) % 2

    def mirrored(at, length):
        period = max(2 * length - 2, 1)
        return np.minimum(at % period, period - at % period) % length

    for i, j in np.ndindex(*blocks.shape[:2]):
        at = np.ix_(mirrored((first + i) * side + offset, shape[0]), mirrored(j * side + offset, shape[1]))
        np.testing.assert_array_equal(blocks[i, j], image[at] + steps)


def test_masked_pixels_get_the_good_ones_of_a_block_in_turn():
    rng = np.random.default_rng(4)
    image, masked = rng.random((48, 60)).astype(np.float32), rng.random((48, 60)) < 0.3
    masked[16:32, 16:32] = True
    found = damage.fill_masked(image, masked)
    np.testing.assert_array_equal(found[~masked], image[~masked])
    for top, left in np.ndindex(3, 4):
        block = np.s_[16 * top : 16 * top + 16, 16 * left : 16 * left + 16]
        if (top, left) == (1, 1):
            continue  # all masked: from a neighbour
        good, count = image[block][~masked[block]], masked[block].sum()
        np.testing.assert_array_equal(found[block][masked[block]], np.resize(good, count))
    assert np.isin(found[16:32, 16:32], image[~masked]).all()


def levels_of(residuals, beside, factor):
    """The local level (H, W): means of squares, averaged over those beside, interpolated between their middles."""
    c, (height, width) = peaks.COARSE_PX, residuals.shape
    kept = np.where(np.abs(residuals) <= background.CLIPPED_SIGMA, residuals, 0.0)
    means = np.array([[kept[y : y + c, x : x + c].mean() for x in range(0, width, c)] for y in range(0, height, c)])
    box = np.ones(2 * beside + 1) / (2 * beside + 1)
    for axis in (0, 1):
        means = np.apply_along_axis(lambda m: np.convolve(np.pad(m, beside, "symmetric"), box, "valid"), axis, means)
    down, across = ((np.arange(n) + 0.5) / c - 0.5 for n in (height, width))
    wide = np.array([np.interp(across, np.arange(means.shape[1]), row) for row in means])
    # At the border x is extrapolated by half of the slope to the only neighbour: 0.
    return factor * np.array([np.interp(down, np.arange(len(means)), column) for column in wide.T]).T


@pytest.mark.parametrize(("sigma", "known", "dead"), [(0.8, False, False), (1.2, True, False), (2.0, False, True)])
def test_maxima_are_those_of_the_filtered_residuals(sigma, known, dead):
    rng = np.random.default_rng(int(10 * sigma))
    one, kernel, factor, beside = random_frame(rng, known=known, dead=dead), filter_kernel(sigma), 0.7, 2
    whole = residuals_of(one)
    for axis in (0, 1):
        whole = convolve1d(whole, kernel.astype(float), axis, mode="constant")
    level = levels_of(residuals_of(one), beside, factor)
    whole -= level
    margin, lowest = len(kernel) // 2 + 1, 0.5
    expected = {}
    for y in range(margin, one.shape[0] - margin):
        for x in range(margin, one.shape[1] - margin):
            near = whole[y - 1 : y + 2, x - 1 : x + 2]
            if near[1, 1] > lowest and near[1, 1] == near.max() and not (dead and one.dead[y, x]):
                tops = []
                for low, high in ((near[1, 0], near[1, 2]), (near[0, 1], near[2, 1])):
                    tops.append(np.clip(0.5 * (low - high) / (low - 2 * near[1, 1] + high), -0.5, 0.5))
                expected[x, y] = whole[y, x], *tops, level[y, x]
    pixels, height, offset, found_level = peaks._peaks_above(one, lowest, kernel, beside, factor)
    assert [tuple(p) for p in pixels.tolist()] == list(expected)
    assert len(pixels) > 8
    found = np.column_stack([height, offset, found_level])
    np.testing.assert_allclose(found, list(expected.values()), rtol=1e-3, atol=1e-3)


def test_more_maxima_than_there_is_room_for_are_looked_for_again(monkeypatch):
    one = random_frame(np.random.default_rng(5))
    every = peaks._peaks_above(one, 0.1, peaks.ONE_TAP)
    assert len(every[0]) > 100
    monkeypatch.setattr(peaks, "PIXELS_PER_PEAK", 10**6)
    for found, expected in zip(peaks._peaks_above(one, 0.1, peaks.ONE_TAP), every, strict=True):
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("shape", [(1, 1), (3, 200), (64, 5)])
def test_frames_of_few_pixels_have_no_maxima_at_their_border(shape):
    one = frame.Frame(
        np.full(shape, 9.0, np.float32), *(SmoothImage(np.ones((1, shape[1]), np.float32), 16, shape[0]),) * 2, None,
        frame.SourceNoise(0.0),
    )  # fmt: skip
    assert len(peaks._peaks_above(one, 0.1, filter_kernel(1.2), 2, 0.5)[0]) == 0


def random_stamps(rng, n, sigma, bad=0.0):
    """Stamps of one source each, their places from the middle and fluxes, and which pixels are usable."""
    places, flux = rng.uniform(-0.8, 0.8, (n, 2)), rng.uniform(300.0, 3000.0, n)
    data = flux[:, None, None] * shapes_of(places, sigma) + rng.normal(3.0, 2.0, (n, SIDE, SIDE))
    usable = rng.random(data.shape) >= bad if bad else None
    variance = rng.uniform(3.0, 5.0, data.shape)
    centres = np.full((n, 2), 40)
    stamps = fit.Stamps(data.astype(np.float32), variance.astype(np.float32), usable, centres, np.full(n, 3.0))
    return stamps, places, flux


def shapes_of(places, sigma):
    px, py = (pixel_profile(places[:, axis], sigma, RADIUS)[0] for axis in (0, 1))
    return py[:, :, None] * px[:, None, :]


def slow_fit(data, variance, use, start, sigma, noise, rounds):
    """Gauss-Newton for x, y, flux and level of one stamp: the parameters, their covariance, and the profile."""
    parameters = np.array([*start, 0.0, 0.0])

    def equations():
        x, y, flux, level = parameters
        (px, dx), (py, dy) = (pixel_profile(np.array([v]), sigma, RADIUS) for v in (x, y))
        shape = np.outer(py, px)
        slopes = np.stack([flux * np.outer(py, dx), flux * np.outer(dy, px), shape, np.ones_like(shape)], -1)
        own = max(flux, 0.0) * shape
        weight = use / (variance + own * (noise.per_unit + noise.model_error**2 * own))
        normal = np.einsum("ijk,ij,ijm->km", slopes, weight, slopes)
        normal += np.diag([fit.POSITION_PRIOR] * 2 + [fit.FLUX_PRIOR] * 2)
        return normal, np.einsum("ijk,ij->k", slopes, weight * (data - flux * shape - level)), shape

    normal, right, shape = equations()
    parameters[2:] = np.linalg.solve(normal[2:, 2:], right[2:])
    for _ in range(rounds - 1):
        normal, right, _ = equations()
        step = np.linalg.solve(normal, right)
        step[:2] = np.clip(step[:2], -fit.MAX_STEP_PX, fit.MAX_STEP_PX)
        parameters += step
        parameters[:2] = np.clip(parameters[:2], -RADIUS, RADIUS)
    normal, _, shape = equations()
    return parameters, np.linalg.inv(normal), shape


@pytest.mark.parametrize(("sigma", "bad"), [(0.7, 0.0), (1.2, 0.1), (1.6, 0.0)])
def test_fits_are_those_of_gauss_newton(sigma, bad):
    rng = np.random.default_rng(int(10 * sigma))
    stamps, places, _ = random_stamps(rng, 12, sigma, bad)
    which, noise = np.array([7, 2, 2, 11]), frame.SourceNoise(1.0, 0.02)
    signal = rng.uniform(0.0, 4.0, (4, SIDE, SIDE)).astype(np.float32)
    start = stamps.centres[which] + places[which] + rng.normal(0.0, 0.3, (4, 2))
    found = fit.fit_points(stamps, which, start, sigma, noise, 0.0, fit.FIT_ROUNDS, signal)
    for i, k in enumerate(which):
        use = np.ones((SIDE, SIDE)) if stamps.usable is None else stamps.usable[k].astype(float)
        data = stamps.data[k] - signal[i].astype(float)
        variance = stamps.variance[k] + (frame.RESIDUAL_FRACTION * signal[i].astype(float)) ** 2
        p, covariance, shape = slow_fit(data, variance, use, start[i] - 40, sigma, noise, fit.FIT_ROUNDS)
        own, rest = p[2] * shape, data - p[2] * shape - p[3]
        np.testing.assert_allclose(found.xy_px[i] - 40, p[:2], atol=1e-4)
        np.testing.assert_allclose([found.flux[i], found.level[i]], p[2:], rtol=1e-4, atol=1e-3)
        np.testing.assert_allclose(found.covariance[i], covariance, rtol=1e-3, atol=1e-5)
        spread = variance + own * (noise.per_unit + noise.model_error**2 * own)
        assert found.chi2[i] == pytest.approx(np.sum(use * rest**2 / spread), rel=1e-3)
        others = use / variance
        nine = np.argmax(data[RADIUS - 1 : RADIUS + 2, RADIUS - 1 : RADIUS + 2])
        others[RADIUS - 1 + nine // 3, RADIUS - 1 + nine % 3] = 0.0
        mean = np.sum(others * data) / np.sum(others)
        assert found.chi2_pixel[i] == pytest.approx(np.sum(others * (data - mean) ** 2), rel=1e-4)
        assert found.dof[i] == use.sum() - 4
        norm = np.sum(use / variance * shape**2)
        above = np.sum(use / variance * shape * (data - 3.0))
        assert found.significance[i] == pytest.approx(above / np.sqrt(norm), rel=1e-3)
        shot = np.sum(use / variance * shape**2 / (1.0 + noise.per_unit * own / variance))
        assert found.snr[i] == pytest.approx(p[2] * np.sqrt(shot), rel=1e-3)


def test_stamps_without_light_or_numbers_have_a_place_within_them():
    stamps, _, _ = random_stamps(np.random.default_rng(6), 3, 1.0)
    stamps.data[1] = 0.0
    stamps.data[2, 4, 4] = np.nan
    start = np.array([[40.0, 40.0], [1e9, np.nan], [40.0, 40.0]])
    found = fit.fit_points(stamps, np.arange(3), start, 1.0, frame.SourceNoise(1.0), 0.0, fit.FIT_ROUNDS)
    assert (np.abs(found.xy_px - 40) <= RADIUS).all()
    none = fit.fit_points(stamps, np.arange(0), start[:0], 1.0, frame.SourceNoise(1.0), 0.0, fit.FIT_ROUNDS)
    assert len(none.flux) == 0


def test_neighbours_light_is_the_sum_of_their_profiles():
    rng = np.random.default_rng(7)
    star = np.array([0, 0, 2, 3, 3, 3])
    offset, flux = rng.uniform(-2.0 * RADIUS, 2.0 * RADIUS, (6, 2)), rng.uniform(-200.0, 2000.0, 6)
    variance, last = np.full((4, SIDE, SIDE), 4.0, np.float32), np.zeros((4, SIDE, SIDE), np.float32)
    expected = np.zeros((3, SIDE, SIDE))
    np.add.at(expected, [0, 0, 1, 2, 2, 2], np.maximum(flux, 0.0)[:, None, None] * shapes_of(offset, 1.3))
    last[3] = expected[2]
    signal, changed = np.empty((3, SIDE, SIDE), np.float32), np.empty(3, bool)
    deblend._sum_neighbours(
        star, offset, flux, 1.3, variance, 0.1, last, fit.profile_scratch(SIDE), signal, changed
    )  # fmt: skip
    np.testing.assert_allclose(signal, expected, rtol=1e-4, atol=1e-3)
    strong = (expected > 0.1 * 2.0).any(axis=(1, 2))
    np.testing.assert_array_equal(changed, strong & [True, True, False])


@pytest.mark.parametrize("bad", [0.0, 0.1])
def test_shapes_are_compared_with_the_psf_and_with_stripes(bad):
    rng = np.random.default_rng(8)
    stamps, places, flux = random_stamps(rng, 6, 1.2, bad)
    which, width = np.array([4, 0, 5]), np.array([1.2, 1.2, 1.5])
    noise, level = frame.SourceNoise(1.0, 0.03), np.full(6, 3.0)
    fits = fit.PointFits(
        xy_px=stamps.centres + places, flux=flux, level=level, covariance=np.zeros((6, 4, 4)),
        **{name: np.zeros(6) for name in ("chi2", "chi2_pixel", "dof", "surround", "significance", "snr")},
    )  # fmt: skip
    misfit, edge = classify._psf_and_edge_misfit(deblend.Fitted(stamps, fits, noise), which, width)
    stripe, ends = classify._stripes(SIDE)
    for i, k in enumerate(which):
        signal = flux[k] * shapes_of(places[k : k + 1], width[i])[0]
        use = np.ones((SIDE, SIDE)) if stamps.usable is None else stamps.usable[k]
        data, spread = stamps.data[k].astype(float), stamps.variance[k] + signal
        excess = np.sum(use * ((data - signal - level[k]) ** 2 - spread))
        assert misfit[i] == pytest.approx(np.sqrt(max(excess, 0.0) / np.sum(use * signal**2)), rel=1e-3, abs=1e-4)
        weight = use / (spread + (noise.model_error * signal) ** 2)
        explained = []
        for d in range(len(ends)):
            numbers = np.unique(stripe[:, :, d])
            sums = [(weight[s].sum(), (weight * data)[s].sum()) for s in (stripe[:, :, d] == j for j in numbers)]
            explained.append(sum(b * b / max(a, 1e-30) for a, b in sums) - len(numbers))
        assert edge[i] == pytest.approx(np.sum(weight * data**2) - max(explained), rel=1e-3)


def test_squared_residuals_are_corrected_by_leverage():
    rng = np.random.default_rng(9)
    stamps, places, flux = random_stamps(rng, 5, 1.1)
    level, root = np.full(5, 3.0), rng.normal(0.0, 0.05, (5, 4, 4))
    covariance = root @ root.transpose(0, 2, 1)
    signal, squared, relative = np.empty((3, 5, SIDE, SIDE))
    lit = np.empty(signal.shape, bool)
    fit._fill_squared_residuals(
        stamps.data, stamps.variance, places, flux, level, covariance, 1.1, 0.03, 0.3, 0.5, fit.profile_scratch(SIDE),
        signal, squared, relative, lit,
    )  # fmt: skip
    (px, dx), (py, dy) = (pixel_profile(places[:, axis], 1.1, RADIUS) for axis in (0, 1))
    f, x, y = (np.einsum("ni,nj->nij", a, b) for a, b in ((py, px), (py, dx), (dy, px)))
    slopes = np.stack([flux[:, None, None] * x, flux[:, None, None] * y, f, np.ones_like(f)], -1)
    expected = flux[:, None, None] * f
    residual = stamps.data - expected - 3.0
    spread = np.einsum("nijk,nkm,nijm->nij", slopes, covariance, slopes)
    leverage = spread / np.maximum(residual**2, stamps.variance + (0.03 * expected) ** 2)
    np.testing.assert_allclose(signal, expected, rtol=1e-4, atol=1e-2)
    clear = np.abs(1.0 - leverage) > 0.1
    np.testing.assert_allclose(squared[clear], (residual**2 / (1.0 - leverage))[clear], rtol=1e-2, atol=1e-2)
    np.testing.assert_allclose(np.mean(relative**2, axis=(1, 2)), 1.0)
    assert (lit == ((expected > 0.3 * stamps.variance) & (leverage < 0.5))).mean() > 0.99


def test_widths_explain_what_weighted_least_squares_explain():
    rng = np.random.default_rng(10)
    stamps, places, _ = random_stamps(rng, 4, 1.1)
    weights, widths = (1.0 / stamps.variance).astype(np.float32), np.array([0.05, 0.8, 1.1, 2.0])
    explained, variance = np.empty((4, 4)), np.empty(4)
    psf_width._explain_by_widths(
        stamps.data, weights, places, widths, fit.profile_scratch(SIDE), explained, variance
    )  # fmt: skip
    for i in range(4):
        root, q = np.sqrt(weights[i].ravel().astype(float)), stamps.data[i].ravel().astype(float)
        rest = np.linalg.lstsq(root[:, None], root * q, rcond=None)[1][0]
        assert variance[i] == pytest.approx(rest, rel=1e-6)
        for j, width in enumerate(np.maximum(widths, 0.1)):
            star = shapes_of(places[i : i + 1], width).ravel()
            columns = root[:, None] * np.stack([np.ones_like(star), star], -1)
            assert explained[i, j] == pytest.approx(
                rest - np.linalg.lstsq(columns, root * q, rcond=None)[1][0], rel=1e-3
            )
