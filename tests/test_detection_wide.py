"""Wide PSFs, detected in binned frames and fitted in the frame itself; and parts of the detector."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree
from star_painter import cramer_rao, isolated_stars, plain_camera

from startrack.core.types import SmoothImage
from startrack.detection import Detector
from startrack.detection.classify import detection_threshold
from startrack.detection.frame import Frame, SourceNoise, bin_frame, binning_factor
from startrack.detection.peaks import bright_pixels, group_touching

SIZE = 1024
BACKGROUND, READ_NOISE = 94.0, 2.5


@pytest.mark.parametrize("known", [True, False], ids=["camera file", "nothing known"])
@pytest.mark.parametrize("sigma", [2.0, 3.0, 4.5])
def test_centroids_and_covariances_of_wide_stars(sigma: float, known: bool) -> None:
    rng = np.random.default_rng(round(10 * sigma))
    stars = isolated_stars(sigma, BACKGROUND, READ_NOISE, (4, 110), rng=rng, size=SIZE, spacing=48)
    found = Detector()(stars.exposure, plain_camera((SIZE, SIZE), sigma) if known else None)
    assert found.psf_sigma_px == pytest.approx(sigma, rel=0.05)
    distance, nearest = cKDTree(found.xy_px).query(stars.xy_px)
    assert np.mean(distance[stars.snr > 8] < sigma) > 0.99
    bright = (distance < sigma) & (stars.snr > 12)
    error = found.xy_px[nearest[bright]] - stars.xy_px[bright]
    variance = BACKGROUND + READ_NOISE**2
    pairs = zip(stars.xy_px[bright], stars.flux[bright], strict=True)
    bound = np.array([np.diag(cramer_rao(xy - np.rint(xy), flux, sigma, variance))[:2] for xy, flux in pairs])
    assert bright.sum() > 150
    assert np.sqrt(np.mean(error**2 / bound)) < 1.15  # the statistical error is 5 %
    chi2 = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance_px2[nearest[bright]]), error)
    assert 1.5 < chi2.mean() < 2.6
    assert found.background_e.shape == (SIZE, SIZE)


def test_binned_frames_keep_flux_and_noise() -> None:
    rng = np.random.default_rng(2)
    image = rng.poisson(50.0, (201, 303)).astype(np.float32)
    dead = np.zeros(image.shape, dtype=bool)
    dead[11, 20] = True
    flat = np.ones_like(image)
    background, noise = SmoothImage.of(50 * flat), SmoothImage.of(np.sqrt(50 * flat))
    small = bin_frame(Frame(image, background, noise, dead, SourceNoise(per_unit=0.0)), 4)
    assert small.shape == (50, 75)
    assert small.image[3, 5] == pytest.approx(image[12:16, 20:24].sum())
    assert np.std(small.image - small.background.whole()) == pytest.approx(float(small.noise.rows[0, 0]), rel=0.05)
    assert np.argwhere(small.dead).tolist() == [[2, 5]]
    assert [binning_factor(s) for s in (0.6, 1.7, 1.8, 3.5, 3.6, 8.0)] == [1, 1, 2, 2, 4, 8]


def test_touching_pixels_are_grouped_as_opencv_groups_them() -> None:
    dead = np.random.default_rng(3).random((90, 120)) < 0.2
    row, column = np.nonzero(dead)
    count, label = group_touching(row, column)
    expected_count, expected = cv2.connectedComponents(dead.astype(np.uint8))
    assert count == expected_count - 1 > 20
    assert len(set(zip(label.tolist(), expected[row, column].tolist(), strict=True))) == count


def test_bright_pixels_are_those_of_stars_not_hot_ones() -> None:
    image = np.random.default_rng(4).normal(0, 1, (200, 300)).astype(np.float32)
    positions = [(40, 50), (100, 120), (220, 150)]
    for x, y in positions:
        image[y - 1 : y + 2, x - 1 : x + 2] += 15
        image[y, x] += 20
    image[70, 70] = 200.0
    zero, one = (SmoothImage.of(np.full_like(image, value)) for value in (0, 1))
    frame = Frame(image, zero, one, None, SourceNoise(per_unit=0.0))
    assert sorted(map(tuple, bright_pixels(frame, 8.0, 10).tolist())) == sorted(positions)


def test_bright_pixels_are_not_those_at_the_edge_of_a_bright_sky() -> None:
    image = np.random.default_rng(5).normal(0, 1, (200, 300)).astype(np.float32)
    image[:, 150:] += 30  # as the background misses it there
    positions = [(40, 50), (220, 150)]
    for x, y in positions:
        image[y - 1 : y + 2, x - 1 : x + 2] += 15
        image[y, x] += 20
    zero, one = (SmoothImage.of(np.full_like(image, value)) for value in (0, 1))
    frame = Frame(image, zero, one, None, SourceNoise(per_unit=0.0))
    found = {tuple(one) for one in bright_pixels(frame, 8.0, 500).tolist()}
    assert found >= set(positions)
    assert not any(148 <= x <= 152 for x, _ in found)


def test_skew_noise_raises_the_threshold_and_wide_stars_lower_it() -> None:
    usual = detection_threshold(5.42, 1.25, 0.088)
    assert usual == pytest.approx(5.42, abs=0.03)
    assert detection_threshold(5.42, 1.25, 0.2) > usual > detection_threshold(5.42, 1.25, 0.0) > 5.0
    assert detection_threshold(5.42, 0.6, 0.088) > usual > detection_threshold(5.42, 3.0, 0.088)
