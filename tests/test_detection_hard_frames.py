"""Detection in difficult frames: few bits, crowding, moonlight, blooming, streaks, defocus, pure noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from star_painter import cramer_rao, flux_of, isolated_stars, paint, plain_camera

from startrack.core.types import Exposure, TooFewStars
from startrack.detection import Detector
from startrack.detection.background import background_and_noise

SIZE = 1024
VARIANCE = 100.0 + 3.0**2


def expose(mean: np.ndarray, rng: np.random.Generator, ceiling: float = 65535.0) -> Exposure:
    counts = np.rint(rng.poisson(mean) + rng.normal(0, 3.0, mean.shape))
    return Exposure(pixels_adu=np.clip(counts, 0, ceiling).astype(np.float32), saturation_adu=ceiling)


def jittered_grid(spacing: float, rng: np.random.Generator, margin: float = 40.0) -> np.ndarray:
    grid = np.arange(margin, SIZE - margin, spacing)
    xy = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    return xy + rng.uniform(-4, 4, xy.shape)


@pytest.mark.parametrize(("sigma_adu", "level"), [(0.4, 3.3), (0.7, 12.6), (2.2, 3.7), (5.0, 20.2)])
def test_noise_of_images_with_few_values(sigma_adu: float, level: float) -> None:
    """Medians of integers are integers: the noise of an 8-bit image must not be quantised."""
    rng = np.random.default_rng(1)
    image = np.maximum(np.rint(rng.normal(level, sigma_adu, (512, 512))), 0).astype(np.float32)
    background, noise = background_and_noise(image, 1.0, 1.0)
    assert noise.whole().mean() == pytest.approx(image.std(), rel=0.06)
    assert abs(background.whole().mean() - image.mean()) < 0.2 * image.std()


@pytest.mark.parametrize("height", [1, 2, 7, 8, 9, 12, 40])
@pytest.mark.parametrize("width", [1, 5, 7, 9, 20, 33])
def test_frames_smaller_than_a_stamp_have_no_stars(height: int, width: int) -> None:
    """Nor has a larger one with a star that near to a corner: it needs light from all around."""
    rng, at = np.random.default_rng(height), np.array([3.0, 3.0])
    row, column = np.mgrid[:height, :width]
    mean = 100.0 + 5000.0 * np.exp(-0.5 * (np.square(column - at[0]) + np.square(row - at[1])) / 1.3)
    with pytest.raises(TooFewStars):
        Detector()(expose(mean, rng))


@pytest.mark.parametrize("bits", [8, 12, 14, 16])
def test_bit_depths(bits: int) -> None:
    """The same exposure, rounded ever more coarsely: with 8 bits a step is half as large again as the noise."""
    rng = np.random.default_rng(2)
    stars = isolated_stars(1.2, 100.0, 3.0, (6, 150), rng=rng, size=SIZE, spacing=40)
    gain = {8: 16.0, 12: 4.0, 14: 2.0, 16: 1.0}[bits]
    adu = np.clip(np.floor(stars.exposure.pixels_adu / gain), 0, 2**bits - 1)
    camera = plain_camera((SIZE, SIZE), 1.2)
    camera = replace(camera, sensor=replace(camera.sensor, gain_e_per_adu=gain, saturation_adu=2.0**bits - 1))
    found = Detector()(Exposure(pixels_adu=adu.astype(np.float32), saturation_adu=2.0**bits - 1), camera)
    distance, nearest = cKDTree(found.xy_px).query(stars.xy_px)
    bright = stars.snr > (9 if bits > 8 else 12)
    assert (distance[bright] < 1.5).all()
    assert np.count_nonzero(cKDTree(stars.xy_px).query(found.xy_px)[0] > 3) <= 2
    chi2 = [
        (found.xy_px[j] - xy) @ np.linalg.solve(found.covariance_px2[j], found.xy_px[j] - xy)
        for xy, j, take in zip(stars.xy_px, nearest, bright, strict=True) if take
    ]  # fmt: skip
    assert 1.5 < np.mean(chi2) < 2.6


@pytest.mark.parametrize("sigma", [1.2, 2.5])
def test_few_faint_stars_are_lost_in_crowded_frames(sigma: float) -> None:
    """The wings of a thousand bright stars cover a tenth to half of the frame and would bias background and noise."""
    rng = np.random.default_rng(3)
    xy = rng.uniform(20, SIZE - 20, (1500 if sigma < 2 else 700, 2))
    flux = np.exp(rng.uniform(np.log(600 * sigma), np.log(2e5), len(xy)))
    image = np.full((SIZE, SIZE), 100.0)
    paint(image, xy, flux, sigma)
    found = Detector()(expose(image, rng), plain_camera((SIZE, SIZE), sigma))
    alone = cKDTree(xy).query(xy, k=2)[0][:, 1] > 5 * sigma
    faint = alone & (flux < 2 * flux_of(10.0, sigma, VARIANCE)) & (flux > flux_of(8.0, sigma, VARIANCE))
    seen = cKDTree(found.xy_px).query(xy)[0] < 1.5 * sigma
    assert faint.sum() >= 40
    assert seen[faint].mean() > 0.95
    assert np.median(found.background_e) == pytest.approx(100.0, abs=1.0)
    assert np.median(found.noise_e) == pytest.approx(np.sqrt(VARIANCE), rel=0.04)
    assert np.count_nonzero(cKDTree(xy).query(found.xy_px)[0] > 2 * sigma) <= 4


def test_moonlight() -> None:
    """A glow that falls from 20,000 electrons to a hundred, with its photon noise."""
    rng = np.random.default_rng(4)
    y, x = np.mgrid[:SIZE, :SIZE]
    glow = 100 + 20_000 * np.exp(-np.hypot(x - 200, y - 300) / 150)
    xy = jittered_grid(45, rng)
    local = glow[np.rint(xy[:, 1]).astype(int), np.rint(xy[:, 0]).astype(int)]
    flux = np.array([flux_of(12.0, 1.2, v + 9) for v in local])
    image = glow.copy()
    paint(image, xy, flux, 1.2)
    found = Detector()(expose(image, rng), plain_camera((SIZE, SIZE), 1.2))
    distance, _ = cKDTree(found.xy_px).query(xy)
    assert np.mean(distance < 1.0) > 0.97
    assert np.sqrt(np.mean(distance[distance < 1.0] ** 2 / 2)) < 0.18  # 0.12 at the bound
    assert np.count_nonzero(cKDTree(xy).query(found.xy_px)[0] > 3) <= 3


def test_bloomed_stars_do_not_spoil_their_neighbourhood() -> None:
    """Columns of saturated pixels above and below bright stars (blooming): the other stars are still detected."""
    rng = np.random.default_rng(5)
    xy = jittered_grid(60, rng)
    flux = np.full(len(xy), flux_of(30.0, 1.2, VARIANCE))
    image = np.full((SIZE, SIZE), 100.0)
    paint(image, xy, flux, 1.2)
    exposure = expose(image, rng)
    pixels = exposure.pixels_adu.copy()
    bloomed = np.stack([np.arange(75, 1000, 150), np.full(7, 500) + np.arange(7) * 3], axis=1)
    for column, row in bloomed:
        pixels[row - 60 : row + 60, column] = 65535.0
    found = Detector()(replace(exposure, pixels_adu=pixels), plain_camera((SIZE, SIZE), 1.2))
    distance, _ = cKDTree(found.xy_px).query(xy)
    away = np.abs(xy[:, None, 0] - bloomed[None, :, 0]).min(axis=1) > 6
    assert np.mean(distance[away] < 0.5) > 0.99
    assert np.count_nonzero(cKDTree(xy).query(found.xy_px)[0] > 3) <= 3


def draw_streaks(length_px: float, sigma: float, rng: np.random.Generator) -> tuple[Exposure, np.ndarray, np.ndarray]:
    """Streaks of a rotation about the frame's corner, the positions at mid-exposure, and the fluxes."""
    xy = jittered_grid(max(50, 1.6 * length_px), rng, margin=40 + length_px)
    flux = np.exp(rng.uniform(np.log(4e3), np.log(6e4), len(xy)))
    along = np.stack([-xy[:, 1], xy[:, 0]], axis=1) / np.linalg.norm(xy, axis=1, keepdims=True)
    image, steps = np.full((SIZE, SIZE), 100.0), max(1, int(3 * length_px))
    for t in (np.arange(steps) + 0.5) / steps - 0.5:
        paint(image, xy + t * length_px * along, flux / steps, sigma)
    return expose(image, rng), xy, flux


@pytest.mark.parametrize(("length_px", "rms_px"), [(2.0, 0.04), (4.0, 0.05), (8.0, 0.10), (20.0, 0.20)])
@pytest.mark.parametrize("sigma", [0.8, 1.2])
def test_streaked_stars_are_where_they_stood_at_mid_exposure(length_px: float, rms_px: float, sigma: float) -> None:
    rng = np.random.default_rng(6)
    exposure, xy, flux = draw_streaks(length_px, sigma, rng)
    found = Detector()(exposure, plain_camera((SIZE, SIZE), sigma))
    distance, nearest = cKDTree(found.xy_px).query(xy)
    near = distance < 1.0
    assert near.mean() > 0.95
    assert np.count_nonzero(cKDTree(xy).query(found.xy_px)[0] > 2) <= 0.02 * len(xy)  # no streak is detected twice
    error = found.xy_px[nearest[near]] - xy[near]
    assert np.sqrt(np.mean(error**2)) < rms_px
    chi2 = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance_px2[nearest[near]]), error)
    assert chi2.mean() < 2 * 1.5  # right, or slightly too large
    assert np.median(found.flux_e[nearest[near]] / flux[near]) == pytest.approx(1.0, abs=0.08)


@pytest.mark.parametrize("gain", [0.5, 2.0])
def test_photon_noise_of_an_unknown_gain_is_measured(gain: float) -> None:
    """Without a camera file: errors of bright stars as stated, and centroids at the bound for a known gain."""
    rng = np.random.default_rng(7)
    stars = isolated_stars(1.2, 100.0, 3.0, (15, 250), rng=rng, size=SIZE, spacing=32)
    found = Detector()(replace(stars.exposure, pixels_adu=stars.exposure.pixels_adu / np.float32(gain) + 50))
    distance, nearest = cKDTree(found.xy_px).query(stars.xy_px)
    bright = (distance < 1.0) & (stars.snr > 60)
    error = found.xy_px[nearest[bright]] - stars.xy_px[bright]
    chi2 = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance_px2[nearest[bright]]), error)
    assert 1.4 < chi2.mean() < 2.6
    pairs = zip(stars.xy_px[bright], stars.flux[bright], strict=True)
    bound = np.array([np.diag(cramer_rao(xy - np.rint(xy), flux, 1.2, VARIANCE))[:2] for xy, flux in pairs])
    assert np.sqrt(np.mean(error**2 / bound)) < 1.10
    assert np.median(found.snr[nearest[bright]] / stars.snr[bright]) == pytest.approx(1.0, abs=0.12)


def noise_of_kind(kind: str, rng: np.random.Generator) -> np.ndarray:
    if kind == "uniform":
        return rng.integers(0, 65536, (2048, 2048))
    if kind == "two values":
        return 65535 * rng.integers(0, 2, (2048, 2048))
    return rng.exponential(1000, (2048, 2048))


@pytest.mark.parametrize("kind", ["uniform", "two values", "spiky"])
def test_pure_noise_ends_quickly(kind: str) -> None:
    frame = noise_of_kind(kind, np.random.default_rng(8)).astype(np.float32)
    try:
        found = len(Detector()(Exposure(pixels_adu=frame, saturation_adu=65535.0)))
    except TooFewStars:
        found = 0
    assert found <= Detector().max_candidates


@pytest.mark.parametrize("sigma", [0.6, 0.8, 1.2, 2.0, 3.0])
def test_as_many_faint_stars_at_every_width(sigma: float) -> None:
    rng = np.random.default_rng(9)
    stars = isolated_stars(sigma, 100.0, 3.0, (5, 7), rng=rng, size=2048, spacing=60)
    found = Detector()(stars.exposure, plain_camera((2048, 2048), sigma))
    seen = cKDTree(found.xy_px).query(stars.xy_px)[0] < 1.5 + sigma
    assert seen.mean() > 0.78  # measured over many frames: 0.81 to 0.88
    assert np.count_nonzero(cKDTree(stars.xy_px).query(found.xy_px)[0] > 5.0) <= 4
