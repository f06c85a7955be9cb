"""Pixels of the sky and of the ground beside a skyline, and their levels, as they vary along it, with their noise.

The ground has patches, each of any brightness, darker or brighter than the sky or as it. From sector to sector its
level drifts a little, or with a small probability it is that of another patch: anything. The posterior of each sector's
level, given all sectors, is the sum over where its patch begins and ends (a forward and a backward pass around the
circle); each term is that of a Kalman smoother.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np

from startrack.camera import Camera
from startrack.core.statistics import NORMAL_BY_MEDIAN, robust_sigma
from startrack.core.types import MIDDLES_RAD, SECTORS, Array, Bools, Detections, Ints, sector_of
from startrack.evidence.skyline import (
    BAND_PX,
    CLIP_SHIFT_PX,
    MOST_REACH_PX,
    SKYLINE_SIGMAS,
    Skyline,
    SkylineEstimate,
    look_through,
    scale_across,
    skyline_band,
)
from startrack.evidence.star_photometer import StarPhotometry, filtered_noise_e
from startrack.frames import azel_from_rays
from startrack.kernels.library import kernel
from startrack.psf import noise_area_px

MASKED_SIGMA = 0.4  # light of a known star, in a pixel's noise, from which the pixel is left out
CIRCLE_EDGE_PX = 3.0  # beside the end of the image circle
UNRESOLVED_PX2 = 1.0 / 12.0  # variance of the position in a pixel
BORDER_PROBABILITY = 0.05  # of a patch's end between two sectors: patches of 30 degrees
DRIFT = 0.2  # from sector to sector, in the sigma of one sector's own level: then 20 sectors are averaged
LONGEST = 40  # sectors of a patch that are told apart; beyond, the drift has made them forget
LEAST_PATCH = 1e-12  # of a patch that is counted
ANY_SIGMAS = 20.0  # that levels of other patches may differ by beyond twice the range of what is seen
LEVEL_SIGMAS = 4.0  # of the edge: from here on a pixel shows the sky or the ground alone
MIN_SIDE_PIXELS = 12  # of a sector on either side of the skyline; 30 left out half of it for a camera of 1 Mpx
MIN_KEPT = 0.5  # of them, by the last clipping: else the sector shows something else than those beside it
LEVEL_SECTORS = 5.0  # standard deviation of the smoothing of levels and noise along the skyline: 7.5 degrees
SLOPE_SECTORS = (20.0, 7.0)  # of the slopes away from the skyline, and of what these leave
FIRST_CLIP_SIGMAS, CLIP_SIGMAS = 6.0, 3.5  # of the pixels: faint stars and defects
LEVEL_ROUNDS = 3
MEDIAN_STEP = 8  # of the pixels from which the first levels are taken
NOISE_EXCESS = 4.0  # of a sector's mean square about that of its neighbours, in sigma, which chance explains
SLOPE_EXCESS = 2.0  # mean square of slopes that the noise explains, in units of their variance
GROUND, SKY = range(2)


@dataclass(frozen=True, eq=False)
class SkyPixels:
    """Pixels (n,) near a predicted skyline that show no star, each with its direction and its light."""

    azimuth_rad: Array  # in enu
    px_per_rad: Array  # of elevation, across the skyline
    height_px: Array  # above the skyline, across it
    light_e: Array
    edge_px: float  # width of a sharp edge in the image: the PSF and the pixel
    reach_px: Array  # (SECTORS,) no farther from the predicted skyline is the true one; infinite: not known


@dataclass(frozen=True, eq=False)
class SkylineBand:
    """The pixels (n,) of an image near a predicted skyline, each with its direction."""

    detections: Detections
    estimate: SkylineEstimate
    to_px: Skyline  # pixels per radian of elevation, across the skyline
    whole: Bools  # (H, W) of the band, with dead pixels and some to spare
    pixel: Ints  # in the flat image
    azimuth_rad: Array  # in enu
    px_per_rad: Array  # of elevation, across the skyline
    height_px: Array  # above the skyline, across it
    reach_px: Array  # (SECTORS,) no farther from the predicted skyline is the true one

    def heights_px(self, azimuth_rad: Array, elevation_rad: Array) -> Array:
        """Heights (n,) [px] of directions `azimuth_rad`, `elevation_rad` (n,) in enu above the skyline, across it."""
        return np.asarray((elevation_rad - self.estimate.skyline(azimuth_rad)) * self.to_px(azimuth_rad))

    def without_stars(self, stars: StarPhotometry) -> SkyPixels:
        """The pixels that show no source, and no star of `stars`, visible or hidden."""
        starless = self.whole.copy()
        _leave_out_stars(starless, self.detections, stars)
        chosen = starless.ravel()[self.pixel]
        return SkyPixels(
            azimuth_rad=self.azimuth_rad[chosen],
            px_per_rad=self.px_per_rad[chosen],
            height_px=self.height_px[chosen],
            light_e=self.detections.image_e.ravel()[self.pixel[chosen]].astype(np.float64),
            edge_px=sqrt(self.detections.psf_sigma_px**2 + UNRESOLVED_PX2),
            reach_px=self.reach_px,
        )


def pixels_near_skyline(
    detections: Detections, camera: Camera, R_cam_enu: Array, estimate: SkylineEstimate
) -> SkylineBand:  # fmt: skip
    """Pixels of the `detections`' image near a skyline, which `camera` and `R_cam_enu` place in the image.

    The band is as much wider as the `estimate` of the skyline is uncertain.
    """
    to_px = scale_across(camera, R_cam_enu, estimate.skyline)
    reach_px = np.maximum(SKYLINE_SIGMAS * estimate.sigma_rad * to_px(MIDDLES_RAD), CLIP_SHIFT_PX)
    reach_px[reach_px > MOST_REACH_PX] = np.inf
    half_px = BAND_PX + np.minimum(reach_px, MOST_REACH_PX) - CLIP_SHIFT_PX
    band = skyline_band(detections.image_e.shape, camera, R_cam_enu, estimate.skyline, float(half_px.max()))
    pixel, rays_cam = look_through(band & ~detections.dead, camera)
    azimuth, elevation = azel_from_rays(rays_cam @ R_cam_enu)
    scale = to_px(azimuth)
    height = (elevation - estimate.skyline(azimuth)) * scale
    limit_rad = min(camera.calibrated_angle_rad, camera.max_angle_rad) - CIRCLE_EDGE_PX / camera.focal_px[0]
    sector = sector_of(azimuth)
    usable = (rays_cam[:, 2] > np.cos(limit_rad)) & (np.abs(height) < half_px[sector])
    usable = np.flatnonzero(usable & np.isfinite(reach_px[sector]))
    rows = pixel[usable], azimuth[usable], scale[usable], height[usable]
    return SkylineBand(detections, estimate, to_px, band, *rows, reach_px)


def _leave_out_stars(band: Bools, detections: Detections, stars: StarPhotometry) -> None:
    """Clear the pixels of the band (H, W) that hold light of known stars, visible or hidden, or of detections."""
    sigma2 = detections.psf_sigma_px**2 + UNRESOLVED_PX2
    noise_e = filtered_noise_e(detections) / sqrt(noise_area_px(detections.psf_sigma_px))
    xy_px = np.concatenate([stars.xy_px, detections.xy_px])
    peak = np.concatenate([stars.expected_e, detections.flux_e]) / (2 * np.pi * sigma2 * max(noise_e, 1e-9))
    bright = np.flatnonzero(peak > MASKED_SIGMA)
    radius = np.ceil(np.sqrt(2 * sigma2 * np.log(peak[bright] / MASKED_SIGMA)) + 0.5)
    _clear_disks(band, np.rint(np.clip(xy_px[bright], -1e6, 1e6)).astype(np.int64), radius.astype(np.int64))


def _clear_disks(mask: Bools, xy_px: Ints, radius_px: Ints) -> None:
    """Clear the pixels of a mask (H, W) within `radius_px` (n,) of the pixels (n, 2).

    A small disk whose middle the mask lacks hardly reaches into the band: it is left out.
    """
    _clear(mask, xy_px, radius_px, BAND_PX / 2, np.empty(len(xy_px), np.bool_))


_clear = kernel(
    "clear_disks", "mask: out bool[height, width]", "xy_px: int64[n, 2]", "radius_px: int64[n]", "large_px: float64",
    "touching: out bool[n]",
)  # fmt: skip


def patch_levels(own_e: Array, variance_e2: Array) -> Array:
    """Levels (n,) [e] of the ground in sectors round the circle that show `own_e` with errors `variance_e2` (n,).

    The variance is infinite where a sector shows nothing.
    """
    shown = np.isfinite(variance_e2)
    if not shown.any():
        return own_e
    sigma_e = float(np.sqrt(np.median(variance_e2[shown])))
    width_e = 2.0 * float(np.ptp(own_e[shown])) + ANY_SIGMAS * sigma_e
    middle_e = float(np.median(own_e[shown]))
    measured = np.where(shown, own_e, middle_e), np.where(shown, variance_e2, width_e**2)
    drift_e2 = (DRIFT * sigma_e) ** 2
    ahead = _filter_patches(*measured, width_e, drift_e2)
    own, variance = (np.ascontiguousarray(one[::-1]) for one in measured)
    behind = [np.roll(part[::-1], -1, axis=0) for part in _filter_patches(own, variance, width_e, drift_e2)]
    states = (np.ascontiguousarray(part) for part in (*ahead, *behind))
    level = np.empty(len(own_e))
    _join(*states, width_e, drift_e2, BORDER_PROBABILITY, LEAST_PATCH, level)
    return level


def _filter_patches(own: Array, variance: Array, width: float, drift: float) -> tuple[Array, Array, Array]:
    """Weights, means and variances (n, LONGEST) of the level by this sector and those before it.

    One for each number of sectors since the patch began. Two laps: the first one is for the memory of the second.
    """
    shape = len(own), LONGEST
    weight, mean, spread = np.zeros(shape), np.zeros(shape), np.ones(shape)
    _filter(own, variance, width, drift, BORDER_PROBABILITY, weight, mean, spread, np.zeros((3, LONGEST + 1)))
    return weight, mean, spread


_STATES = [f"{name}: float64[n, longest]" for name in ("weight", "mean", "spread")]
_filter = kernel(
    "filter_patches", "own: float64[n]", "variance: float64[n]", "width: float64", "drift: float64", "border: float64",
    *(state.replace(": ", ": out ") for state in _STATES), "scratch: out float64[3, longest + 1]",
)  # fmt: skip
_join = kernel(
    "join_patches", *_STATES, *(f"later_{state}" for state in _STATES), "width: float64", "drift: float64",
    "border: float64", "least_weight: float64", "level: out float64[n]",
)  # fmt: skip


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
        """Step (SECTORS,) [e] of the light: sky less ground."""
        return np.asarray(self.level_e[SKY] - self.level_e[GROUND])

    @property
    def step_sigma_e(self) -> Array:
        """Standard deviation (SECTORS,) [e] of `step_e`."""
        averaged = 2 * sqrt(np.pi) * LEVEL_SECTORS  # sectors in one smoothed level
        return np.asarray(np.hypot(*(self.own_sigma_e * sqrt(self.correlation / averaged))))

    def step_sigmas(self, sectors: Bools) -> float:
        """Size of the steps of either sign of some `sectors` (SECTORS,) together, in that of their noise."""
        return sqrt(float(np.sum(np.square(self.step_e[sectors] / self.step_sigma_e[sectors]))) / LEVEL_SECTORS)

    def mean_step_e(self, sectors: Bools) -> tuple[float, float]:
        """Mean step [e] of some `sectors` (SECTORS,) and its standard deviation; 0 of none."""
        count = max(int(np.count_nonzero(sectors)), 1)
        sigma = sqrt(float(np.sum(np.square(self.step_sigma_e[sectors]))) * LEVEL_SECTORS) / count
        return float(self.step_e[sectors].sum()) / count, sigma


def measure_levels(pixels: SkyPixels, sector: Ints) -> SkyLevels:
    """Levels on both sides of the skyline by `pixels` (n,) of these sectors (n,), outliers left out.

    The pixels closer than LEVEL_SIGMAS of the edge to where the skyline may be are not used. The level of the sky is
    smoothed over some sectors, that of the ground within patches, a slope over many.
    """
    height, light = pixels.height_px, pixels.light_e
    nearest = LEVEL_SIGMAS * pixels.edge_px + (pixels.reach_px - CLIP_SHIFT_PX)[sector]
    side = np.where(height > nearest, SKY, np.where(height < -nearest, GROUND, -1))
    counts = np.array([np.bincount(sector[side == s], minlength=SECTORS) for s in (GROUND, SKY)])
    covered = np.asarray((counts >= MIN_SIDE_PIXELS).all(axis=0))
    level, noise = _first_levels(side, sector, light)
    slope, limit = np.zeros((2, SECTORS)), FIRST_CLIP_SIGMAS * noise
    limit[GROUND] += np.abs(level[GROUND] - [np.roll(level[GROUND], k) for k in (-1, 1)]).max(axis=0)  # a patch's end
    for _ in range(LEVEL_ROUNDS):
        sums = np.zeros((2, 6, SECTORS))  # of 1, h, h^2, q, q h, q^2; heights h, what pixels exceed the level by q
        _sum_sides(side, sector, height, light, level, slope, limit, sums)
        sums *= covered
        noise = _noise_of_sides(sums)
        more, kept = _significant_slopes(sums, slope, noise)
        own = sums[:, 3] - more * sums[:, 1]
        smoothed = _smooth(np.stack([sums[:, 0], own]), LEVEL_SECTORS)
        change = smoothed[1] / np.maximum(smoothed[0], 1e-9)
        own_e, independent = own / np.maximum(sums[:, 0], 1.0), np.square(noise) / np.maximum(sums[:, 0], 1.0)
        z2 = np.square(own_e - change)[SKY] / independent[SKY]  # the ground's levels may be those of two patches
        correlation = max(float(np.median(z2[covered])) * NORMAL_BY_MEDIAN**2, 1.0) if covered.any() else 1.0
        error_e2 = np.where(sums[GROUND, 0] > 0, independent[GROUND] * correlation, np.inf)
        change[GROUND] = patch_levels(level[GROUND] + own_e[GROUND], error_e2) - level[GROUND]
        level, slope, limit = level + change, slope + more, CLIP_SIGMAS * noise
    covered &= np.asarray((sums[:, 0] > MIN_KEPT * counts).all(axis=0))
    own_e -= change  # they were less the former level
    own_sigma, variance = _level_errors(sums, own_e, independent, correlation, kept, covered)
    return SkyLevels(
        covered=covered, level_e=level, slope_e=slope, own_e=own_e, own_sigma_e=own_sigma, variance_e2=variance,
        noise_e=noise, correlation=correlation,
    )  # fmt: skip


def _noise_of_sides(sums: Array) -> Array:
    """Standard deviation (2, SECTORS) of a pixel on either side, by sums (2, 6, SECTORS) of residuals.

    It is smoothed over sectors, but for those that scatter more: where one patch of the ground goes over to the next,
    the pixels of a sector show both.
    """
    count, squares = np.maximum(sums[:, 0], 1e-9), sums[:, 5]
    own, most = squares / count, 1.0 + NOISE_EXCESS * np.sqrt(2.0 / np.maximum(count, 1.0))
    beside = range(-int(LEVEL_SECTORS), int(LEVEL_SECTORS) + 1)
    usual = own < most * np.median([np.roll(own, k, axis=1) for k in beside], axis=0)
    smooth = _smooth(squares * usual, LEVEL_SECTORS) / np.maximum(_smooth(count * usual, LEVEL_SECTORS), 1e-9)
    return np.sqrt(np.maximum(np.where(own < most * smooth, smooth, own), 1e-12))


def _level_errors(
    sums: Array, own_e: Array, independent_e2: Array, correlation: float, kept_slope: Array, covered: Bools
) -> tuple[Array, Array]:
    """Sigma of the sectors' own levels, variance of the levels at the skyline (2, SECTORS), without `correlation`.

    Where own levels (2, SECTORS) differ from the smooth ones by more than the noise explains, these are rough: an
    excess everywhere is taken as correlated noise, one nearby as a level that varies faster than it is smoothed.
    """
    z2 = np.square(own_e) / independent_e2
    nearby, seen = (_smooth(np.asarray(a, dtype=np.float64), LEVEL_SECTORS) for a in (z2 * covered, covered))
    rough = np.maximum(nearby / np.maximum(seen, 1e-9), correlation)
    extrapolated = np.square(sums[:, 1]) / np.maximum(sums[:, 0], 1.0) / np.maximum(_spread(sums), 1e-9)
    return np.sqrt(correlation * independent_e2), independent_e2 * rough * (1.0 + kept_slope * extrapolated)


def _first_levels(side: Ints, sector: Ints, light_e: Array) -> tuple[Array, Array]:
    """Level and noise (2, SECTORS), (2, SECTORS): medians of the sky's pixels all together, of the ground's by sector.

    `side`, `sector` and `light_e` (n,) are those of the pixels.
    """
    level, noise = np.zeros((2, SECTORS)), np.ones((2, SECTORS))
    for s in (GROUND, SKY):
        here = np.flatnonzero(side == s)[:: MEDIAN_STEP if s == SKY else 1]
        if len(here):
            level[s] = np.median(light_e[here])
            if s == GROUND:
                ordered = here[np.lexsort((light_e[here], sector[here]))]
                count = np.bincount(sector[ordered], minlength=SECTORS)
                middle = ordered[np.minimum(np.cumsum(count) - count + count // 2, len(ordered) - 1)]
                level[s] = np.where(count > 0, light_e[middle], level[s])
            noise[s] = robust_sigma(light_e[here] - level[s][sector[here]], 0.0)
    return level, noise


def _significant_slopes(sums: Array, slope_e: Array, noise_e: Array) -> tuple[Array, Array]:
    """Changes of slopes (2, SECTORS) by sums (2, 6, SECTORS) of residuals, and the parts that are kept (2, 1).

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


# Adds to sums (2, 6, SECTORS): count, h, h^2, and with the residual q: q, q h, q^2, of pixels within the limits.
_sum_sides = kernel(
    "sum_sides", "side: int64[n]", "sector: int64[n]", "height: float64[n]", "light: float64[n]",
    "level: float64[2, sectors]", "slope: float64[2, sectors]", "limit: float64[2, sectors]",
    "sums: out float64[2, 6, sectors]",
)  # fmt: skip
