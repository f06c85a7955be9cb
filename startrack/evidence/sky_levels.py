"""Levels of the sky and of the ground on either side of a skyline, as they vary along it, and their noise."""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
from dataclasses import dataclass
from math import sqrt

import numpy as np

from startrack.core.kernels import njit
from startrack.core.statistics import NORMAL_BY_MEDIAN, robust_sigma
from startrack.core.types import SECTORS, Array, Bools, Ints
from startrack.evidence.sky_pixels import SkyPixels
from startrack.evidence.skyline import CLIP_SHIFT_PX

LEVEL_SIGMAS = 4.0  # of the edge: from here on a pixel shows the sky or the ground alone
MIN_SIDE_PIXELS = 12  # of a sector on either side of the skyline; 30 left out half of it for a camera of 1 Mpx
MIN_KEPT = 0.5  # of them, by the last clipping: else the sector shows something else than those beside it
LEVEL_SECTORS = 5.0  # standard deviation of the smoothing of levels and noise along the skyline: 7.5 degrees
SLOPE_SECTORS = (20.0, 7.0)  # of the slopes away from the skyline, and of what these leave
FIRST_CLIP_SIGMAS, CLIP_SIGMAS = 6.0, 3.5  # of the pixels: faint stars and defects
LEVEL_ROUNDS = 3
MEDIAN_STEP = 8  # of the pixels from which the first levels are taken
SLOPE_EXCESS = 2.0  # mean square of slopes that the noise explains, in units of their variance
GROUND, SKY = range(2)


@dataclass(frozen=True, eq=False)
class SkyLevels:
    """Light of the ground and the sky beside the skyline, by sector of azimuth; arrays (2, SECTORS) hold both."""

    covered: Bools  # (SECTORS,) with pixels enough on both sides that are no outliers
    level_e: Array  # at the skyline itself
    slope_e: Array  # per pixel of height
    own_e: Array  # level of each sector by itself, less `level_e`
    own_sigma_e: Array
    variance_e2: Array  # of `level_e` for each sector by itself, before it is smoothed
    noise_e: Array  # standard deviation of a pixel on either side
    correlation: float  # variance of a sector's level beside that of independent pixels; at least 1

    @property
    def step_e(self) -> Array:
        """(SECTORS,) sky less ground."""
        return np.asarray(self.level_e[SKY] - self.level_e[GROUND])

    @property
    def step_sigma_e(self) -> Array:
        """(SECTORS,) standard deviation of `step_e`."""
        averaged = 2 * sqrt(np.pi) * LEVEL_SECTORS  # sectors in one smoothed level
        return np.asarray(np.hypot(*(self.own_sigma_e * sqrt(self.correlation / averaged))))

    def mean_step_e(self, sectors: Bools) -> tuple[float, float]:
        """The mean step of some `sectors` (SECTORS,) and its standard deviation; 0 of none."""
        count = max(int(np.count_nonzero(sectors)), 1)
        sigma = sqrt(float(np.sum(np.square(self.step_sigma_e[sectors]))) * LEVEL_SECTORS) / count
        return float(self.step_e[sectors].sum()) / count, sigma


def measure_levels(pixels: SkyPixels, sector: Ints) -> SkyLevels:
    """Levels on both sides of the skyline by `pixels` (n,) of these sectors (n,), outliers left out.

    The pixels closer than LEVEL_SIGMAS of the edge to where the skyline may be are not used. A level is smoothed over
    some sectors, a slope over many.
    """
    height, light = pixels.height_px, pixels.light_e
    nearest = LEVEL_SIGMAS * pixels.edge_px + (pixels.reach_px - CLIP_SHIFT_PX)[sector]
    side = np.where(height > nearest, SKY, np.where(height < -nearest, GROUND, -1))
    counts = np.array([np.bincount(sector[side == s], minlength=SECTORS) for s in (GROUND, SKY)])
    covered = np.asarray((counts >= MIN_SIDE_PIXELS).all(axis=0))
    level, noise = _first_levels(side, light)
    slope, clip = np.zeros((2, SECTORS)), FIRST_CLIP_SIGMAS
    for _ in range(LEVEL_ROUNDS):
        sums = np.zeros((2, 6, SECTORS))
        _sum_sides(side, sector, height, light, level, slope, clip * noise, sums)
        sums *= covered
        count, squares = _smooth(sums[:, [0, 5]], LEVEL_SECTORS).swapaxes(0, 1)
        noise = np.sqrt(np.maximum(squares / np.maximum(count, 1e-9), 1e-12))
        more, kept = _significant_slopes(sums, slope, noise)
        own = sums[:, 3] - more * sums[:, 1]
        smoothed = _smooth(np.stack([sums[:, 0], own]), LEVEL_SECTORS)
        change = smoothed[1] / np.maximum(smoothed[0], 1e-9)
        level, slope, clip = level + change, slope + more, CLIP_SIGMAS
    covered &= np.asarray((sums[:, 0] > MIN_KEPT * counts).all(axis=0))
    own_e = own / np.maximum(sums[:, 0], 1.0) - change
    own_sigma, variance, correlation = _level_errors(sums, own_e, noise, kept, covered)
    return SkyLevels(
        covered=covered, level_e=level, slope_e=slope, own_e=own_e, own_sigma_e=own_sigma, variance_e2=variance,
        noise_e=noise, correlation=correlation,
    )  # fmt: skip


def _level_errors(
    sums: Array, own_e: Array, noise_e: Array, kept_slope: Array, covered: Bools
) -> tuple[Array, Array, float]:
    """Sigma of the sectors' own levels, variance of the levels at the skyline (2, SECTORS), correlation of the noise.

    Where own levels (2, SECTORS) differ from the smooth ones by more than the noise explains, these are rough: an
    excess everywhere is taken as correlated noise, one nearby as a level that varies faster than it is smoothed.
    """
    count = np.maximum(sums[:, 0], 1.0)
    independent = np.square(noise_e) / count
    z2 = np.square(own_e) / independent
    correlation = max(float(np.median(z2[:, covered])) * NORMAL_BY_MEDIAN**2, 1.0) if covered.any() else 1.0
    nearby, seen = (_smooth(np.asarray(a, dtype=np.float64), LEVEL_SECTORS) for a in (z2 * covered, covered))
    rough = np.maximum(nearby / np.maximum(seen, 1e-9), correlation)
    extrapolated = np.square(sums[:, 1]) / count / np.maximum(_spread(sums), 1e-9)
    return np.sqrt(correlation * independent), independent * rough * (1.0 + kept_slope * extrapolated), correlation


def _first_levels(side: Ints, light_e: Array) -> tuple[Array, Array]:
    """Level and noise (2, SECTORS), (2, SECTORS) from the medians of all pixels of either side."""
    middle, noise = np.zeros(2), np.ones(2)
    for s in (GROUND, SKY):
        values = light_e[side == s][::MEDIAN_STEP]
        if len(values):
            middle[s] = np.median(values)
            noise[s] = robust_sigma(values, middle[s])
    return np.repeat(middle[:, None], SECTORS, axis=1), np.repeat(noise[:, None], SECTORS, axis=1)


def _significant_slopes(sums: Array, slope_e: Array, noise_e: Array) -> tuple[Array, Array]:
    """What is to be added to slopes (2, SECTORS) by sums (2, 6, SECTORS) of residuals; the parts that are kept (2, 1).

    Slopes are shrunk towards no slope at all: one that the noise alone explains would only make the levels at the
    skyline uncertain, by 0.5 e of 7 e. What wide slopes leave is treated in the same way.
    """
    target, kept = np.zeros_like(slope_e), np.zeros((2, 1))
    for width in SLOPE_SECTORS:
        wide = _smooth(sums[:, :5], width)
        n, h, _, q, qh = np.moveaxis(wide, 1, 0)
        spread = np.maximum(_spread(wide), 1e-9)
        slope = slope_e + (qh - h * q / np.maximum(n, 1e-9)) / spread - target
        variance = np.square(noise_e) / (spread * 2 * np.sqrt(np.pi) * width)
        noisy = SLOPE_EXCESS * variance.mean(axis=1) / np.maximum(np.square(slope).mean(axis=1), 1e-12)
        part = np.maximum(1.0 - noisy, 0.0)[:, None]
        target, kept = target + part * slope, np.maximum(kept, part)
    return target - slope_e, kept


def _spread(sums: Array) -> Array:
    """Sum (2, SECTORS) of the squared distances of heights from their mean, from sums (2, 5 or more, SECTORS)."""
    return np.asarray(sums[:, 2] - np.square(sums[:, 1]) / np.maximum(sums[:, 0], 1e-9))


def _smooth(values: Array, sectors: float) -> Array:
    """Gaussian means of `values` (..., SECTORS) round the circle, with a standard deviation of `sectors`."""
    n, reach = values.shape[-1], int(4.0 * sectors + 0.5)
    weights = np.exp(-0.5 / (sectors * sectors) * np.arange(-reach, reach + 1) ** 2)
    weights /= weights.sum()
    around = values[..., np.arange(-reach, n + reach) % n]
    smooth = values * weights[reach]
    for k in range(reach):
        smooth += (around[..., k : k + n] + around[..., 2 * reach - k : 2 * reach - k + n]) * weights[k]
    return np.asarray(smooth)


@njit(cache=True)
def _sum_sides(side, sector, height, light, level, slope, limit, sums):
    """Add up sums (2, 6, SECTORS): count, h, h^2, and with the residual q: q, q h, q^2, of pixels within the limits."""
    for k in range(len(side)):
        s = side[k]
        if s >= 0:
            i, h = sector[k], height[k]
            q = light[k] - level[s, i] - slope[s, i] * h
            if abs(q) <= limit[s, i]:
                sums[s, 0, i] += 1.0
                sums[s, 1, i] += h
                sums[s, 2, i] += h * h
                sums[s, 3, i] += q
                sums[s, 4, i] += q * h
                sums[s, 5, i] += q * q
