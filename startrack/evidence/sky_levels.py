"""Levels of the sky and of the ground on either side of a skyline, as they vary along it, and the noise of a pixel."""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from startrack.evidence.sky_pixels import SkyPixels
from startrack.kernels import njit
from startrack.types import Array, Bools, Ints

SECTORS = 240  # of 1.5 degrees, as the localizer's
LEVEL_SIGMAS = 4.0  # of the edge: from here on a pixel shows the sky or the ground alone
MIN_SIDE_PIXELS = 30  # of a sector on either side of the skyline
LEVEL_SECTORS = 5.0  # standard deviation of the smoothing along the skyline: 7.5 degrees
SLOPE_SECTORS = 20.0  # of the slopes away from the skyline
FIRST_CLIP_SIGMAS, CLIP_SIGMAS = 6.0, 3.5  # of the pixels: faint stars and defects
ROUNDS = 3
SLOPE_EXCESS = 2.0  # mean square of slopes that the noise explains, in units of their variance
MEDIAN_ABS_NORMAL = 0.6745
GROUND, SKY = range(2)


@dataclass(frozen=True, eq=False)
class SkyLevels:
    """Light of the ground and the sky beside the skyline, by sector of azimuth; arrays (2, SECTORS) hold both."""

    covered: Bools  # (SECTORS,) with pixels enough on both sides
    level_e: Array  # at the skyline itself
    slope_e: Array  # per pixel of height
    own_e: Array  # level of each sector by itself, less `level_e`
    own_sigma_e: Array
    noise_e: Array  # (2,) standard deviation of a pixel on either side
    correlation: float  # variance of a sector's level beside that of independent pixels; at least 1

    @property
    def step_e(self) -> Array:
        """(SECTORS,) sky less ground."""
        return np.asarray(self.level_e[SKY] - self.level_e[GROUND])


def sector_of(azimuth_rad: Array) -> Ints:
    """Sector (n,) of each azimuth."""
    return (azimuth_rad * (SECTORS / (2 * np.pi))).astype(np.int64) % SECTORS


def measure_levels(pixels: SkyPixels, sector: Ints) -> SkyLevels:
    """Levels on both sides of the skyline by `pixels` (n,) of these sectors (n,), outliers left out.

    The pixels closer to the skyline than LEVEL_SIGMAS of the edge are not used. A level is smoothed over some sectors,
    a slope over many.
    """
    height, light = pixels.height_px, pixels.light_e
    nearest = LEVEL_SIGMAS * pixels.edge_px
    side = np.where(height > nearest, SKY, np.where(height < -nearest, GROUND, -1))
    counts = np.array([np.bincount(sector[side == s], minlength=SECTORS) for s in (GROUND, SKY)])
    covered = np.asarray((counts >= MIN_SIDE_PIXELS).all(axis=0))
    level, slope, noise = np.zeros((2, SECTORS)), np.zeros((2, SECTORS)), np.ones(2)
    for s in (GROUND, SKY):
        values = light[side == s]
        middle = float(np.median(values)) if len(values) else 0.0
        level[s], noise[s] = middle, np.median(np.abs(values - middle)) / MEDIAN_ABS_NORMAL if len(values) else 1.0
    clip = FIRST_CLIP_SIGMAS
    for _ in range(ROUNDS):
        sums = np.zeros((2, 6, SECTORS))
        _sum_sides(side, sector, height, light, level, slope, clip * noise, sums)
        count = sums[:, 0]
        noise = np.sqrt(np.maximum(sums[:, 5].sum(axis=1) / np.maximum(count.sum(axis=1), 1.0), 1e-12))
        sums *= covered
        more_slope = _significant_slope(sums, slope, noise)
        more_level = _smooth_level(sums, more_slope)
        level, slope, clip = level + more_level, slope + more_slope, CLIP_SIGMAS
    own = (sums[:, 3] - more_slope * sums[:, 1]) / np.maximum(count, 1.0) - more_level
    own_sigma = noise[:, None] / np.sqrt(np.maximum(count, 1.0))
    z2 = np.square(own / own_sigma)[:, covered]
    correlation = float(np.median(z2)) / MEDIAN_ABS_NORMAL**2 if z2.size else 1.0
    return SkyLevels(covered, level, slope, own, own_sigma, noise, max(correlation, 1.0))


def _significant_slope(sums: Array, slope_e: Array, noise_e: Array) -> Array:
    """What is to be added to slopes (2, SECTORS) by sums (2, 6, SECTORS) of residuals, shrunk towards no slope at all.

    A slope that the noise alone explains would only make the levels at the skyline uncertain: 0.5 e of 7 e.
    """
    n, h, hh, q, qh = np.moveaxis(gaussian_filter1d(sums[:, :5], SLOPE_SECTORS, axis=-1, mode="wrap"), 1, 0)
    spread = np.maximum(hh - h * h / np.maximum(n, 1e-9), 1e-9)
    slope = slope_e + (qh - h * q / np.maximum(n, 1e-9)) / spread
    variance = np.square(noise_e)[:, None] / (spread * 2 * np.sqrt(np.pi) * SLOPE_SECTORS)
    noisy = SLOPE_EXCESS * variance.mean(axis=1) / np.maximum(np.square(slope).mean(axis=1), 1e-12)
    return np.asarray(slope * np.maximum(1.0 - noisy, 0.0)[:, None] - slope_e)


def _smooth_level(sums: Array, slope_e: Array) -> Array:
    """Level (2, SECTORS) at the skyline of residuals with these sums (2, 6, SECTORS) and slopes (2, SECTORS)."""
    count, values = sums[:, 0], sums[:, 3] - slope_e * sums[:, 1]
    smoothed = gaussian_filter1d(np.stack([count, values]), LEVEL_SECTORS, axis=-1, mode="wrap")
    return np.asarray(smoothed[1] / np.maximum(smoothed[0], 1e-9))


@njit(cache=True, nogil=True)
def _sum_sides(side, sector, height, light, level, slope, limit, sums):
    """Add up sums (2, 6, SECTORS): count, h, h^2, and with the residual q: q, q h, q^2, of pixels within the limits."""
    for k in range(len(side)):
        s = side[k]
        if s >= 0:
            i, h = sector[k], height[k]
            q = light[k] - level[s, i] - slope[s, i] * h
            if abs(q) <= limit[s]:
                sums[s, 0, i] += 1.0
                sums[s, 1, i] += h
                sums[s, 2, i] += h * h
                sums[s, 3, i] += q
                sums[s, 4, i] += q * h
                sums[s, 5, i] += q * q
