"""Pixels of the diffuse sky and the ground near a predicted skyline, without those that show stars or defects.

By them the levels of the sky and of the ground on either side of the skyline, as they vary along it, and their noise.
"""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
from dataclasses import dataclass
from math import sqrt

import numpy as np

from startrack.camera import Camera
from startrack.core.kernels import njit
from startrack.core.statistics import robust_sigma
from startrack.core.types import SECTORS, Array, Bools, Detections, Ints
from startrack.evidence.sky_step import (
    BAND_PX,
    ELEVATION_STEP_RAD,
    MEDIAN_ABS_NORMAL,
    SKYLINE_POINTS,
    Horizon,
    Skyline,
    look_through,
    skyline_band,
)
from startrack.evidence.star_evidence import StarPhotometry, filtered_noise_e
from startrack.frames import azel_from_rays, off_axis_rad, rays_from_azel
from startrack.psf import noise_area_px

MASKED_SIGMA = 0.4  # light of a known star, in a pixel's noise, from which the pixel is left out
CIRCLE_EDGE_PX = 3.0  # beside the end of the image circle
UNRESOLVED_PX2 = 1.0 / 12.0  # variance of the position in a pixel
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
class SkyPixels:
    """Pixels (n,) near a predicted skyline, each with its direction and its light."""

    azimuth_rad: Array  # in enu
    elevation_rad: Array
    px_per_rad: Array  # of elevation, across the skyline
    height_px: Array  # above the skyline, across it
    light_e: Array
    edge_px: float  # width of a sharp edge in the image: the PSF and the pixel


def pixels_near_skyline(
    detections: Detections, camera: Camera, R_cam_enu: Array, horizon: Horizon, stars: StarPhotometry
) -> SkyPixels:
    """Pixels of the `detections`' image near a `horizon` that show no known star and no source.

    `camera` and `R_cam_enu` place the skyline in the image; `stars` are those whose light is left out, visible or not.
    """
    band = skyline_band(detections.image_e.shape, camera, R_cam_enu, horizon)
    _leave_out_stars(band, detections, stars)
    pixel, rays_cam = look_through(band & ~detections.dead, camera)
    azimuth, elevation = azel_from_rays(rays_cam @ R_cam_enu)
    scale = scale_across(camera, R_cam_enu, horizon)(azimuth)
    height = (elevation - horizon(azimuth)) * scale
    limit_rad = min(camera.calibrated_angle_rad, camera.max_angle_rad) - CIRCLE_EDGE_PX / camera.focal_px[0]
    usable = np.flatnonzero((rays_cam[:, 2] > np.cos(limit_rad)) & (np.abs(height) < BAND_PX))
    return SkyPixels(
        azimuth_rad=azimuth[usable],
        elevation_rad=elevation[usable],
        px_per_rad=scale[usable],
        height_px=height[usable],
        light_e=detections.image_e.ravel()[pixel[usable]].astype(np.float64),
        edge_px=sqrt(detections.psf_sigma_px**2 + UNRESOLVED_PX2),
    )


def scale_across(camera: Camera, R_cam_enu: Array, horizon: Horizon) -> Skyline:
    """Pixels per radian of elevation across the image of a `horizon`, as a function of azimuths [rad].

    Across, not upwards: a steep skyline is closer than it is high. `camera` and `R_cam_enu` place it in the image.
    """
    azimuth = np.linspace(0.0, 2 * np.pi, SKYLINE_POINTS, endpoint=False)
    elevation = horizon(azimuth)
    rays_cam = rays_from_azel(azimuth, elevation) @ R_cam_enu.T
    seen = off_axis_rad(rays_cam) < min(camera.max_angle_rad, camera.lens.max_invertible_rad)

    def pixels(turned: int, raised_rad: float) -> Array:
        rays_enu = rays_from_azel(np.roll(azimuth, turned), np.roll(elevation, turned) + raised_rad)
        return camera.project_unlimited((rays_enu @ R_cam_enu.T)[seen])

    up = (pixels(0, ELEVATION_STEP_RAD) - pixels(0, -ELEVATION_STEP_RAD)) / (2 * ELEVATION_STEP_RAD)
    along = pixels(-1, 0.0) - pixels(1, 0.0)
    across = np.abs(up[:, 0] * along[:, 1] - up[:, 1] * along[:, 0])
    scale = np.ones(SKYLINE_POINTS)
    scale[seen] = across / np.maximum(np.hypot(*along.T), 1e-9)
    return Skyline(scale)


def _leave_out_stars(band: Bools, detections: Detections, stars: StarPhotometry) -> None:
    """Clear the pixels of the band (H, W) that hold light of known stars, visible or hidden, or of detections."""
    sigma2 = detections.psf_sigma_px**2 + UNRESOLVED_PX2
    noise_e = filtered_noise_e(detections) / sqrt(noise_area_px(detections.psf_sigma_px))
    xy_px = np.concatenate([stars.xy_px, detections.xy_px])
    peak = np.concatenate([stars.expected_e, detections.flux_e]) / (2 * np.pi * sigma2 * max(noise_e, 1e-9))
    bright = np.flatnonzero(peak > MASKED_SIGMA)
    radius = np.ceil(np.sqrt(2 * sigma2 * np.log(peak[bright] / MASKED_SIGMA)) + 0.5)
    _clear_disks(band, np.rint(np.clip(xy_px[bright], -1e6, 1e6)).astype(np.int64), radius.astype(np.int64))


@njit(cache=True)
def _clear_disks(mask, xy_px, radius_px):
    """Clear the pixels of a mask (H, W) within `radius_px` (n,) of the pixels (n, 2).

    A small disk whose middle the mask lacks hardly reaches into the band: it is left out.
    """
    height, width = mask.shape
    touching = np.empty(len(xy_px), np.bool_)
    for k in range(len(xy_px)):
        x, y = xy_px[k, 0], xy_px[k, 1]
        touching[k] = radius_px[k] > BAND_PX / 2 or (0 <= x < width and 0 <= y < height and mask[y, x])
    for k in range(len(xy_px)):
        x, y, r = xy_px[k, 0], xy_px[k, 1], radius_px[k]
        if not touching[k]:
            continue
        for row in range(max(y - r, 0), min(y + r + 1, height)):
            for column in range(max(x - r, 0), min(x + r + 1, width)):
                if (column - x) * (column - x) + (row - y) * (row - y) <= r * r:
                    mask[row, column] = False


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
    correlation = max(float(np.median(z2[:, covered])) / MEDIAN_ABS_NORMAL**2, 1.0) if covered.any() else 1.0
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
