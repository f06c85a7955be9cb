"""Evidence of the diffuse light of the sky: pixels near a predicted skyline, summed in cells, as rows of `Evidence`.

The ground is darker or brighter than the sky, or as bright. A pixel q above the level of the ground, where the whole
sky would be t above it (t of either sign), contributes l V + c V (1 - V) / 2 with l = (q t - t^2 / 2) / s^2 and c = t^2
/ s^2, s^2 its variance and V the fraction of the sky that it shows. The pixels of a narrow sector at equal heights
above the predicted skyline show the same V, wherever the true skyline is nearby: their sums are one row.

A star beside the edge is measured on half a step, which would add light to the one on its brighter side and take it
from the one on its darker side: it is measured in an image without the step.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from math import ceil, sqrt
from typing import Any

import numpy as np

from startrack.camera import Camera
from startrack.core.statistics import NORMAL_CDF, median, relative_weights, robust_sigma
from startrack.core.types import MIDDLES_RAD, SECTORS, Array, Bools, Detections, Evidence, Ints, SmoothImage, sector_of
from startrack.evidence.photometry import SURE_SIGMAS
from startrack.evidence.sky_levels import CLIP_SIGMAS, GROUND, SKY, SkyLevels, SkylineBand, SkyPixels, measure_levels
from startrack.evidence.skyline import BAND_PX, CLIP_SHIFT_PX, Horizon
from startrack.evidence.star_photometer import SEEN_LLR
from startrack.frames import off_axis_rad, rays_from_azel
from startrack.kernels.library import kernel

PREDICTED_SIGMA_PX = 0.1  # of a predicted skyline, errors of the image included
FADE_PX = 3.0  # over which the light beside the skyline goes over to the background at the ends of the band
CELL_PX = 0.75  # of a cell
LEVELS = 13  # cells of a sector: up to 4.9 px above and below a predicted skyline that is right to CLIP_SHIFT_PX
SHIFT_PX, SHIFT_STEP_PX = 4.0, 0.05  # of the skyline in one sector: the largest, for such a prediction, and a step
NEEDED_SECTORS = SECTORS // 4  # with a step; fewer determine no shift of the skyline
MIN_STEP_SIGMAS = 8.0  # of the steps together
MISFIT_SIGMAS = 6.0  # of a sector's misfit against the others'
RAMP_PX = 4.0  # standard deviation of an edge that is no skyline: light that fades
SHARP_NATS = 10.0  # by which the sharp edge must explain the pixels better than such a ramp
# Widths of the skyline's edge, in those of a star's. Photographs behind an edge of 0.95 px, stars of 0.53 px: where the
# edge was taken to be as sharp as the stars, it was found 0.1 px too low, by a bright and noisy sky up to 0.5 px.
SOFTNESS = np.linspace(0.8, 2.2, 29)
EDGE_ROUNDS = 3


def exceeds_noise(sky: SkyLight) -> bool:
    """Whether the step of the `sky` is larger than the noise of a pixel: else it shifts no star's flux by much."""
    covered = sky.levels.covered
    step_e = np.abs(sky.levels.step_e[covered])
    return bool(covered.any() and np.median(step_e) >= np.median(sky.levels.noise_e[:, covered]))


def brightness_mag_arcsec2(
    sky: SkyLight, camera: Camera, R_cam_enu: Array, exposure_s: float | None
) -> float | None:  # fmt: skip
    """Brightness of the sky beyond that of the ground [V mag/arcsec2], by the zero point of the `camera`.

    The step per solid angle of the pixel, throughput and second of the exposure (`exposure_s`); `R_cam_enu` gives where
    it is in the image. None where the step is not significant, or the camera has no zero point, or the exposure no
    known duration.
    """
    sensor, covered = camera.sensor, sky.levels.covered
    _, sigma_e = sky.levels.mean_step_e(covered)
    if sensor is None or not exposure_s or not covered.any():
        return None
    step_e = float(np.median(sky.levels.step_e[covered]))
    if not step_e > SURE_SIGMAS * sigma_e:
        return None
    rays_cam = rays_from_azel(MIDDLES_RAD[covered], sky.elevation_rad[covered]) @ R_cam_enu.T
    angle = np.array(np.median(off_axis_rad(rays_cam)))
    arcsec2 = float(camera.pixel_solid_angle_sr(angle)) * np.degrees(3600) ** 2
    per_s = arcsec2 * float(sensor.throughput(angle)) * sensor.zero_point_e_per_s
    return float(-2.5 * np.log10(step_e / (per_s * exposure_s)))


def take_out_sky_step(band: SkylineBand, sky: SkyLight) -> Detections:
    """The detections of the `band` with the step of the sky's light in their background, and each side's noise.

    The step is as wide as the image shows it, and where prediction and image together place it in each sector.
    """
    from scipy.special import ndtr

    levels, sector = sky.levels, sector_of(band.azimuth_rad)
    known = np.flatnonzero(levels.covered[sector])
    s, height_px, pixel = sector[known], band.height_px[known], band.pixel[known]
    background, noise = band.detections.background_e.copy(), band.detections.noise_e.copy()
    # Views: what is written into `level` and `sigma` below is in `background` and `noise`.
    image, level, sigma = (values.reshape(-1) for values in (band.detections.image_e, background, noise))
    before_px2 = np.square(band.estimate.sigma_rad * band.to_px(MIDDLES_RAD)) + PREDICTED_SIGMA_PX**2
    shift_px = sky.shift_px * before_px2 / (before_px2 + sky.variance_px2)
    visible = ndtr((height_px - shift_px[s]) / sky.edge_px)
    low, high = (levels.level_e[side, s] + levels.slope_e[side, s] * height_px for side in (GROUND, SKY))
    off = image[pixel] - (low + (high - low) * visible)
    # Faint stars, which the levels leave out, are in the background and the noise; both of all sectors together.
    sides = visible < 0.5, visible >= 0.5
    middle = [median(off[side]) for side in sides]
    ground_e2, sky_e2 = (
        np.square(levels.noise_e[k, s]) * robust_sigma(off[side] / levels.noise_e[k, s[side]]) ** 2
        for k, side in zip((GROUND, SKY), sides, strict=True)
    )
    light = low + middle[0] + (high + middle[1] - low - middle[0]) * visible
    ratio = np.sqrt(ground_e2 + (sky_e2 - ground_e2) * visible) / sigma[pixel]
    fade = np.clip((BAND_PX - np.abs(height_px)) / FADE_PX, 0.0, 1.0)
    level[pixel] += (fade * (light - level[pixel])).astype(np.float32)
    sigma[pixel] *= (1.0 + fade * (ratio - 1.0)).astype(np.float32)
    return replace(band.detections, background=SmoothImage.of(background), noise=SmoothImage.of(noise))


@dataclass(frozen=True, eq=False)
class SkyLight:
    """The light of the sky near a predicted skyline: sums in cells of every sector of azimuth, lowest cells first."""

    levels: SkyLevels
    horizon: Horizon  # the predicted one
    elevation_rad: Array  # (SECTORS,) of the predicted skyline at MIDDLES_RAD
    px_per_rad: Array  # (SECTORS,)
    reach_px: Array  # (SECTORS,) no farther from the predicted skyline the true one was sought
    height_px: Array  # (SECTORS, cells) of the cells above the predicted skyline, means by information
    llr: Array  # (SECTORS, cells)
    extended_nats: Array  # (SECTORS, cells)
    edge_px: float  # width of the edge in the image
    fades: bool  # over more than the edge of a skyline
    shift_px: Array  # (SECTORS,) how much higher than predicted the skyline stands
    shift_sigma_px: Array  # (SECTORS,) infinite where the sector by itself excludes hardly any height
    misfit_nats: Array  # (SECTORS,) by which the best cells exceed the best skyline

    @property
    def cell_edge_px(self) -> float:
        """Width [px] of the edge in the cells, which are wide themselves."""
        return float(_widened(self.edge_px))

    @cached_property
    def variance_px2(self) -> Array:
        """Variances (SECTORS,) of the skyline's height with the errors of both levels; infinite if not covered."""
        return np.asarray(np.sum(self._variances_px2, axis=0))

    @cached_property
    def _variances_px2(self) -> tuple[Array, Array]:
        """Variances (SECTORS,) by the noise, and by levels: one too high by d moves the edge of a step t by 2 d / t px.

        Levels are smoothed over sectors, whose errors then agree; over wider ranges that is as if each sector had the
        whole error of its own level. A sector that excludes hardly any height has the variance of its information.
        """
        from scipy.special import ndtr

        at = (self.height_px - self.shift_px[:, None]) / self.cell_edge_px
        visible, slope = ndtr(at), np.exp(-0.5 * np.square(at)) / (np.sqrt(2 * np.pi) * self.cell_edge_px)
        weight = self.extended_nats * slope
        information = np.maximum((weight * slope).sum(axis=1), 1e-12)
        per_sky, per_ground = ((weight * part).sum(axis=1) / information for part in (visible, 1.0 - visible))
        variance = self.levels.variance_e2
        step = np.where(self.levels.step_e != 0, self.levels.step_e, np.inf)
        by_levels = (np.square(per_ground) * variance[GROUND] + np.square(per_sky) * variance[SKY]) / step**2
        own = np.where(np.isfinite(self.shift_sigma_px), np.square(self.shift_sigma_px), 1.0 / information)
        return np.where(self.levels.covered, own, np.inf), by_levels

    def evidence(self, sectors: Bools) -> Evidence:
        """Rows of the chosen `sectors` (SECTORS,), for the localizer."""
        own, by_levels = self._variances_px2
        factor = 1.0 + by_levels / own
        s, h = np.nonzero((self.extended_nats > 0.0) & sectors[:, None])
        return Evidence(
            azimuth_rad=MIDDLES_RAD[s],
            elevation_rad=self.elevation_rad[s] + self.height_px[s, h] / self.px_per_rad[s],
            llr=self.llr[s, h] / factor[s],
            extended_nats=self.extended_nats[s, h] / factor[s],
            edge_sigma_rad=self.cell_edge_px / self.px_per_rad[s],
        )


def measure_sky_light(pixels: SkyPixels, horizon: Horizon) -> SkyLight:
    """The light of the sky by `pixels` near a predicted `horizon`, above which their heights are."""
    sector = sector_of(pixels.azimuth_rad)
    levels = measure_levels(pixels, sector)
    edge_px = pixels.edge_px
    beyond_px = float(pixels.reach_px[levels.covered].max(initial=CLIP_SHIFT_PX)) - CLIP_SHIFT_PX
    for _ in range(EDGE_ROUNDS):
        cells, scale = _sum_pixels(pixels, sector, levels, edge_px, LEVELS + 2 * ceil(beyond_px / CELL_PX))
        height_px, llr, extended = cells
        shift, sigma, misfit = _shifts(*cells, _widened(edge_px), SHIFT_PX + beyond_px)
        informed, before = np.isfinite(sigma), edge_px
        if informed.any():
            shifted = height_px[informed] - shift[informed, None], llr[informed], extended[informed]
            nats = [_nats(*shifted, one) for one in _widened(pixels.edge_px * SOFTNESS)]
            edge_px = pixels.edge_px * float(SOFTNESS[int(np.argmax(nats))])
        if edge_px == before:
            break
    seen = scale[:, 0] > 0
    return SkyLight(
        levels=levels,
        horizon=horizon,
        elevation_rad=horizon(MIDDLES_RAD),
        px_per_rad=np.where(seen, scale[:, 1] / np.maximum(scale[:, 0], 1.0), 1.0),
        reach_px=pixels.reach_px,
        height_px=height_px,
        llr=llr,
        extended_nats=extended,
        edge_px=edge_px,
        fades=edge_px >= SOFTNESS[-1] * pixels.edge_px,
        shift_px=np.where(seen, shift, 0.0),
        shift_sigma_px=np.where(seen, sigma, np.inf),
        misfit_nats=misfit,
    )


def _sum_pixels(
    pixels: SkyPixels, sector: Ints, levels: SkyLevels, edge_px: float, cells: int
) -> tuple[tuple[Array, Array, Array], Array]:
    """Heights, l and c (SECTORS, cells) of `pixels` (n,) beside an edge of that width; pixel counts and scales."""
    sums, scale = np.zeros((SECTORS, cells, 3)), np.zeros((SECTORS, 2))
    _sum_cells(
        sector, pixels.height_px, pixels.light_e, pixels.px_per_rad, levels.covered, levels.level_e, levels.slope_e,
        np.square(levels.noise_e) * levels.correlation, levels.correlation, edge_px, pixels.reach_px,
        CLIP_SIGMAS, CELL_PX, NORMAL_CDF, sums, scale,
    )  # fmt: skip
    llr, extended, moment = np.moveaxis(sums, -1, 0)
    return (moment / np.where(extended > 0, extended, 1.0), llr, extended), scale


def _widened(edge_px: Any) -> Any:
    """Width of an edge in cells, whose pixels spread over their height."""
    return np.sqrt(np.square(edge_px) + CELL_PX**2 / 12)


def _nats(height_px: Array, llr: Array, extended: Array, edge_px: float) -> float:
    """Log-likelihood ratio of an edge of this width at height 0, against ground everywhere, by cells (n, m)."""
    from scipy.special import ndtr

    fraction: Any = ndtr(height_px / edge_px)
    return float(np.sum(fraction * (llr + 0.5 * extended * (1.0 - fraction))))


def _shifts(
    height_px: Array, llr: Array, extended: Array, edge_px: float, most_px: float
) -> tuple[Array, Array, Array]:
    """Mean and standard deviation (SECTORS,) [px] of the skyline's height above the predicted one, and the misfit."""
    shifts_px = np.linspace(-most_px, most_px, 2 * ceil(most_px / SHIFT_STEP_PX) + 1)
    log = np.empty((SECTORS, len(shifts_px)))
    cells = (np.ascontiguousarray(one) for one in (height_px, llr, extended))
    _score_shifts(*cells, edge_px, shifts_px, NORMAL_CDF, log)
    best = log.max(axis=1)
    informed = best - np.maximum(log[:, 0], log[:, -1]) > SEEN_LLR
    _, mean, sigma = average_shifts(log, shifts_px)
    # Each cell's own best fraction of sky, free of any skyline.
    free = np.clip(llr / np.where(extended > 0, extended, 1.0) + 0.5, 0.0, 1.0)
    misfit = (llr * free + 0.5 * extended * free * (1.0 - free)).sum(axis=1) - best
    return np.where(informed, mean, 0.0), np.where(informed, sigma, np.inf), misfit


def average_shifts(log_weights: Array, shifts: Array) -> tuple[Array, Array, Array]:
    """Weights (n, m) of evenly spaced `shifts` (m,), of `log_weights` (n, m); means and standard deviations (n,)."""
    weight = relative_weights(log_weights, axis=1)
    weight /= weight.sum(axis=1, keepdims=True)
    mean = weight @ shifts
    variance = weight @ np.square(shifts) - np.square(mean)
    return weight, mean, np.sqrt(np.maximum(variance, (shifts[1] - shifts[0]) ** 2 / 12))


def sectors_with_step(sky: SkyLight) -> Bools:
    """Whether in sectors (SECTORS,) the light steps, up or down, from a ground to a sky that goes on beside them.

    Of a weak step the rows say little. None at all where the step as a whole is too weak, or fades instead of stepping.
    """
    levels = sky.levels
    good = levels.covered & (sky.extended_nats > 0.0).any(axis=1)
    own = np.abs(levels.own_e) / (levels.own_sigma_e * sqrt(levels.correlation))
    good &= (own < SURE_SIGMAS).all(axis=0)
    if good.any():
        misfit = sky.misfit_nats[good]
        good &= sky.misfit_nats < np.median(misfit) + MISFIT_SIGMAS * max(robust_sigma(misfit), 1.0)
    clear = good & np.isfinite(sky.shift_sigma_px)
    enough = np.count_nonzero(clear) >= NEEDED_SECTORS and levels.step_sigmas(clear) > MIN_STEP_SIGMAS
    return good if enough and _is_sharp(sky, clear) else np.zeros(SECTORS, dtype=bool)


def _is_sharp(sky: SkyLight, sectors: Bools) -> bool:
    """Whether the step is that of a skyline, and explains the cells of the sectors better than a wide ramp, by far."""
    cells = sky.height_px[sectors] - sky.shift_px[sectors, None], sky.llr[sectors], sky.extended_nats[sectors]
    return not sky.fades and _nats(*cells, sky.edge_px) > _nats(*cells, RAMP_PX) + SHARP_NATS


# Fills log (SECTORS, shifts) with the log-likelihoods of a skyline that is shifted.
_score_shifts = kernel(
    "score_shifts", "height: float64[sectors, cells]", "llr: float64[sectors, cells]",
    "extended: float64[sectors, cells]", "edge: float64", "shift: float64[shifts]", f"cdf: float64[{len(NORMAL_CDF)}]",
    "log: out float64[sectors, shifts]",
)  # fmt: skip
# Adds to sums (SECTORS, cells, 3) of l, c and c times the height; scales (SECTORS, 2): pixels, their scale.
_sum_cells = kernel(
    "sum_cells", "sector: int64[n]", "height: float64[n]", "light: float64[n]", "scale: float64[n]",
    "covered: bool[sectors]", "level: float64[2, sectors]", "slope: float64[2, sectors]",
    "variance: float64[2, sectors]", "correlation: float64", "edge: float64", "reach: float64[sectors]",
    "clip: float64", "cell: float64", f"cdf: float64[{len(NORMAL_CDF)}]", "sums: out float64[sectors, cells, 3]",
    "scales: out float64[sectors, 2]",
)  # fmt: skip
