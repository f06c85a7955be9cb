"""The light above a skyline on the Earth: stars as air and lens dim them, and steps at which the sky's light stops.

The brightness is that along columns of constant azimuth. At a step that below departs from the sky's, extrapolated from
above. Ground may be darker or brighter. A step need not be the skyline: trees have inner edges, the sky has clouds and
reflections. The posterior weighs them.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import lru_cache

import numpy as np

from startrack.applications.horizon.columns import (
    ABOVE_RAD,
    AVERAGINGS,
    COLUMN_SAMPLES,
    HIGHEST_GROUND_RAD,
    LEVEL_RAD,
    Averaging,
    Columns,
    average_columns,
    coarser,
    mean_above,
    sample_columns,
)
from startrack.applications.horizon.frames import SkyFrame
from startrack.core.errors import NoSolution
from startrack.core.limits import check_time
from startrack.core.statistics import NORMAL_BY_MEDIAN
from startrack.core.types import Array, Bools, Evidence, Ints
from startrack.evidence import (
    SEEN_LLR,
    FluxScale,
    StarPhotometer,
    StarPhotometry,
    flux_scale,
    measure_response,
    with_noise_of_blocks,
)
from startrack.frames import airmass, azel_from_rays

BRIGHT_SNR = 12.0  # of stars beside which the light of the sky is not measured
STAR_GLARE_PX, GLARE_PER_DECADE_PX = 3.0, 2.5  # of the faintest of them, and more for each factor of ten
# Of stars in a damaged frame: what is left of the light of fainter ones is extrapolated, and there are thousands.
LEAST_TRUSTED_SNR = 1.0
UNKNOWN_RESPONSE = "what the damaged image leaves of a star's light is not known"
BEYOND_CIRCLE_RAD = np.radians(4.5)  # the edge of the image circle is stated to some degrees; light is followed so far
CLEAR_GAP_PX = 1.0  # on either side of the step: the blurred edge
SKY_PX, GROUND_PX = 4.0, 3.0  # lengths of the averages above and below
MAX_SLOPE_1 = 0.08  # change of the sky's brightness over SKY_PX, relative to it
MIN_SIGNIFICANCE = 1.0  # weaker ones say nothing
SMOOTH_DEGREE = 3  # of the smooth course of light that an edge must be told from
OPEN_SKY_RAD = np.radians(15.0)  # from here up the scatter of averages is measured: faint stars, correlated noise
PEAK_PX = 2.0  # a step is the most significant within this distance
RELATIVE_ERROR = 0.02  # of the extrapolated sky, of its brightness above the darkest pixels
DARKEST_PERCENT = 0.5
MOST_RATIO = 10.0  # of the brightness on the two sides of a step: more says no more, and the darkest pixels have none
WINDOW_PX = 10.0  # half width of the window in which an edge's place is measured
REACH_PX, PLACE_STEP_PX = 2.5, 0.25
PLACES_PX = np.arange(-REACH_PX, REACH_PX + PLACE_STEP_PX / 2, PLACE_STEP_PX)  # tried
EDGE_SIGMAS_PX = (0.8, 1.5, 2.5, 3.5)  # widths tried: the PSF, fuzzy trees, haze
SHAPE_ERROR = 0.3  # of the difference between the fitted edge and the half level
BLURRED_PX = 1.5  # error of the place of an edge of the largest width: where ground begins in haze
MIN_SIGMA_PX, MAX_SIGMA_PX = 0.1, 2.0  # of a place; beyond, it is not measured
SMOOTH_SAMPLES = 5  # odd: the mean is at its middle
LEVEL_PX = 2  # of ground that must be in view below an edge,
EDGE_ENDS_SIGMAS = 2.0  # which ends so many of its widths below its place
SKY_LEVEL_PX = 3.0  # above the edge: where the sky's level is taken; below, haze darkens it


@dataclass(frozen=True)
class StarLight:
    """The stars of one image: rows of evidence in apparent directions of enu, and the pixels of bright stars."""

    rays: Evidence
    bright_px: Array  # (m, 2) of stars and planets
    glare_px: Array  # (m,) radius of their light
    missing: float  # share of the stars high in the sky that are not seen: clouds


def measure_stars(frame: SkyFrame) -> StarLight:
    """Light of every catalogue star in view of a `frame`, and the pixels of bright stars."""
    camera = replace(frame.camera, sensor=None, calibrated_angle_rad=frame.camera.max_angle_rad)
    stars = frame.sky.stars
    air = airmass(azel_from_rays(stars.rays_icrs @ frame.R_enu_icrs.T)[1])
    matches = frame.matched_detection, frame.matched_star
    detections = frame.detections if frame.damage is None else with_noise_of_blocks(frame.detections)
    scale = flux_scale(detections, camera, stars, matches, frame.R_cam_icrs, air)
    light = StarPhotometer()(
        detections, camera, stars, list(frame.bodies), frame.R_cam_icrs, frame.R_enu_icrs, scale,
        frame.extra_sigma_px, air=air,
    )  # fmt: skip
    rows = (light if frame.damage is None else _with_response(light)).evidence()
    scale_rad = camera.mean_scale_rad_per_px(np.array(min(camera.max_angle_rad, np.pi / 2)))
    rays = replace(rows, edge_sigma_rad=np.full(len(rows), float(scale_rad)))  # a pixel of the usual PSF
    # Stars are missed where no ground is expected.
    highest = rays.elevation_rad > min(HIGHEST_GROUND_RAD, float(np.quantile(rays.elevation_rad, 0.5, method="lower")))
    decided = rays.llr[highest & (np.abs(rays.llr) > SEEN_LLR)]
    missing = float((np.count_nonzero(decided < 0) + 1) / (len(decided) + 2))
    return StarLight(rays, *_glare(frame, scale, light), missing)


def _with_response(light: StarPhotometry) -> StarPhotometry:
    """The `light` of a damaged frame as its response to stars corrects it; no evidence where that is not known."""
    try:
        light = measure_response(light).correct(light)
    except NoSolution:
        return light.mask_stars(np.full(len(light.star), UNKNOWN_RESPONSE))
    return light.mask_stars(np.where(light.expected_e < LEAST_TRUSTED_SNR * light.sigma_e, UNKNOWN_RESPONSE, ""))


def _glare(frame: SkyFrame, scale: FluxScale, light: StarPhotometry) -> tuple[Array, Array]:
    """Pixels (m, 2) of bright stars and planets, and the radii (m,) of their light [px]."""
    noise_e = max(float(np.median(light.sigma_e[light.usable])) if light.usable.any() else 0.0, 1e-9)
    planets = [body for body in frame.bodies if body.name not in ("Sun", "Moon")]
    rays = np.array([body.ray_icrs for body in planets]).reshape(-1, 3)
    px, seen = frame.camera.project(rays @ frame.R_cam_icrs.T)
    air = airmass(azel_from_rays(rays @ frame.R_enu_icrs.T)[1])
    v_mag = np.array([body.v_mag for body in planets])
    flux_e, _ = scale.expect(v_mag, rays @ frame.R_cam_icrs.T, replace(frame.camera, sensor=None), air)
    snr = np.concatenate([light.expected_e, flux_e[seen]]) / noise_e
    missing = np.concatenate([light.llr < -SEEN_LLR, np.zeros(int(seen.sum()), dtype=bool)])  # behind the ground
    bright = (snr > BRIGHT_SNR) & ~missing
    radius_px = STAR_GLARE_PX + GLARE_PER_DECADE_PX * np.log10(snr[bright] / BRIGHT_SNR)
    return np.concatenate([light.xy_px, px[seen]])[bright], radius_px


@dataclass(frozen=True)
class Steps:
    """Steps (n) of the brightness, from all columns."""

    column: Ints
    elevation_rad: Array
    sigma_rad: Array
    contrast: Array  # brightness below minus above, relative to the brightest sky above
    log_ratio: Array  # logarithm of the brightness below over that of the sky right above
    dimming: Array  # logarithm of the brightness of the brightest sky above over that of the light right above
    significance: Array

    def take(self, which: Bools) -> Steps:
        """The steps that a mask (n,) selects."""
        return Steps(**{one.name: getattr(self, one.name)[which] for one in fields(Steps)})


def find_steps(frame: SkyFrame, stars: StarLight) -> list[Steps]:
    """All significant steps of the image of a `frame`, for each of the AVERAGINGS; `stars` are left out."""
    edge = min(frame.camera.max_angle_rad + BEYOND_CIRCLE_RAD, frame.camera.lens.max_invertible_rad)
    camera = replace(frame.camera, max_angle_rad=edge)
    columns = sample_columns(frame.detections, (stars.bright_px, stars.glare_px), camera, frame.R_cam_enu)
    return [_steps_of(columns, averaging) for averaging in AVERAGINGS]


@dataclass(frozen=True)
class Contrasts:
    """Contrast of the light below every sample (k, columns) of averaged columns to that above it."""

    columns: Columns
    below_e: Array
    above_e: Array  # extrapolated to below
    noise_e: Array  # of a pixel's part in them
    significance: Array
    dark_e: float  # of the darkest pixels


def _steps_of(columns: Columns, averaging: Averaging) -> Steps:
    """The steps of `columns` in one of their averages: along each step's own slope."""
    from scipy.ndimage import maximum_filter1d

    columns = coarser(columns, averaging.pixels)
    dark = float(np.nanpercentile(average_columns(columns, averaging.columns).light_e, DARKEST_PERCENT))
    along = [_contrasts(average_columns(columns, averaging.columns, slope=slope), dark) for slope in averaging.slopes]
    best = np.argmax([one.significance for one in along], axis=0)
    clean = np.max([one.significance for one in along], axis=0)
    peak = clean == maximum_filter1d(clean, 2 * round(PEAK_PX * COLUMN_SAMPLES) + 1, axis=0)
    peak &= (clean > MIN_SIGNIFICANCE) & (columns.elevation_rad[:, None] < HIGHEST_GROUND_RAD)
    parts = [_steps_at(one, *np.nonzero(peak & (best == k))) for k, one in enumerate(along)]
    return Steps(**{one.name: np.concatenate([getattr(part, one.name) for part in parts]) for one in fields(Steps)})


def _contrasts(columns: Columns, dark_e: float) -> Contrasts:
    """The contrasts of `columns` that are averaged."""
    check_time()
    above = _level_above(columns, CLEAR_GAP_PX, 2 * CLEAR_GAP_PX + GROUND_PX / 2, dark_e)
    below = mean_above(columns, -CLEAR_GAP_PX - GROUND_PX, -CLEAR_GAP_PX)
    stated = columns.noise_e * np.sqrt(6.0 / SKY_PX + 1.0 / GROUND_PX)
    sky = (columns.elevation_rad > OPEN_SKY_RAD) & (columns.elevation_rad < HIGHEST_GROUND_RAD)
    scatter = np.abs(below - above)[sky] / stated[sky]
    scatter = scatter[np.isfinite(scatter)]
    excess = max(float(np.median(scatter)) * NORMAL_BY_MEDIAN, 1.0) if len(scatter) else 1.0  # no open sky in view
    noise, stated = (excess * one for one in (columns.noise_e, stated))
    sigma = np.hypot(stated, RELATIVE_ERROR * (above - dark_e))
    return Contrasts(columns, below, above, noise, np.nan_to_num(np.abs(below - above) / sigma), dark_e)


def _steps_at(light: Contrasts, row: Ints, column: Ints) -> Steps:
    """The steps at samples (n,) of the averaged columns of `light`."""
    from scipy.ndimage import maximum_filter1d

    columns, dark = light.columns, light.dark_e
    elevation, sigma_px, clear, good = _measure_edges(columns, row, column, light.noise_e)
    significance = np.minimum(light.significance[row, column], clear)
    good &= significance > MIN_SIGNIFICANCE
    # The sky's level is the largest mean of LEVEL_RAD within ABOVE_RAD.
    level, size = mean_above(columns, 0.0, LEVEL_RAD / columns.px_rad), round(ABOVE_RAD / columns.step_rad)
    sky = maximum_filter1d(np.nan_to_num(level), size, axis=0, origin=-(size // 2), mode="constant")
    below, above = light.below_e[row, column] - dark, light.above_e[row, column] - dark
    sky = np.maximum(sky[row, column] - dark, 1e-9)
    contrast = (below - above) / sky
    log_ratio, dimming = (
        np.log(np.clip(one / np.maximum(above, 1e-9), 1.0 / MOST_RATIO, MOST_RATIO)) for one in (below, sky)
    )
    column, sigma_rad = column[good], sigma_px[good] * columns.px_rad
    marks = (one[good] for one in (contrast, log_ratio, dimming, significance))
    return Steps(column, elevation[good], sigma_rad, *marks)


def _level_above(columns: Columns, gap_px: float, distance_px: float, dark_e: float) -> Array:
    """The sky's brightness (k, columns) extrapolated downwards by `distance_px` from `gap_px` above each elevation.

    The slope is limited: where the samples above are ground themselves, they are no measure of the sky's slope.
    """
    near = mean_above(columns, gap_px, gap_px + SKY_PX)
    far = mean_above(columns, gap_px + SKY_PX, gap_px + 2 * SKY_PX)
    limit = MAX_SLOPE_1 * np.maximum(near - dark_e, 0.0)
    return near + np.clip(near - far, -limit, limit) * (distance_px + SKY_PX / 2) / SKY_PX


def _measure_edges(columns: Columns, row: Ints, column: Ints, noise: Array) -> tuple[Array, Array, Array, Bools]:
    """Steps at samples (row, column) (n,): elevation [rad], sigma [px], significance, which are measured; each (n,).

    The significance is by how many sigma an edge explains the light better than a smooth course does.

    Least squares of a level of ground and a sloping level of sky, joined by an edge of one of several widths; the mean
    and the scatter of the edge's place over all widths and places, by their likelihoods.
    """
    half = round(WINDOW_PX * COLUMN_SAMPLES)
    good = (row >= half) & (row < len(columns.elevation_rad) - half)
    middle = np.where(good, row, half)
    light, depth_px = _fill_below(columns.light_e[middle[:, None] + np.arange(-half, half + 1), column[:, None]], half)
    good &= np.isfinite(light).all(axis=1)
    light = np.where(good[:, None], light, 0.0)
    light = light - light.mean(axis=1, keepdims=True)
    weight, best, clear = _weigh_edges(light, half, noise[row, column])
    by_place = weight.sum(axis=0)
    mean_px = PLACES_PX @ by_place
    variance_px2 = np.maximum(np.square(PLACES_PX) @ by_place - np.square(mean_px), 0.0)
    half_px = _half_level(light, half, best)
    half_px = np.where(np.abs(half_px - mean_px) < REACH_PX, half_px, mean_px)
    width_px = np.einsum("w,wpn->n", np.array(EDGE_SIGMAS_PX), weight)
    shape_px = np.hypot(SHAPE_ERROR * np.abs(half_px - mean_px), BLURRED_PX * (width_px / EDGE_SIGMAS_PX[-1]) ** 3)
    sigma_px = np.sqrt(variance_px2 + np.square(shape_px) + MIN_SIGMA_PX**2)
    elevation = columns.elevation_rad[middle] + half_px * columns.px_rad
    # An edge ends in the ground's level. A ramp that ends at the edge of the view may be the sky's.
    good &= (depth_px >= WINDOW_PX) | (mean_px - EDGE_ENDS_SIGMAS * width_px > LEVEL_PX - depth_px)
    return elevation, sigma_px, clear, good & (sigma_px < MAX_SIGMA_PX)


def _fill_below(light: Array, half: int) -> tuple[Array, Array]:
    """Samples (n, 2 half + 1) with their part below the view at the level of the lowest ground in view.

    Then the depth (n,) [px] of the view below the middle.
    """
    first = np.minimum(np.argmax(np.isfinite(light), axis=1), half)
    lowest = first[:, None] + np.arange(LEVEL_PX * COLUMN_SAMPLES)
    level = np.take_along_axis(light, lowest, axis=1).mean(axis=1, keepdims=True)
    filled = np.where(np.arange(light.shape[1]) < first[:, None], level, light)
    return filled, (half - first) / COLUMN_SAMPLES


def _weigh_edges(light: Array, half: int, noise_e: Array) -> tuple[Array, Ints, Array]:
    """Posterior (widths, places, n) of the edges in samples (n, 2 half + 1), and the index of each best one (n,).

    Then by how many sigma (n,) the best edge explains them better than a smooth course.
    """
    total = np.sum(np.square(light), axis=1)
    rest = np.stack([
        [total - np.sum(np.square(light @ _edge_basis(half, place, width)), axis=1) for place in PLACES_PX]
        for width in EDGE_SIGMAS_PX
    ])  # fmt: skip
    flat = rest.reshape(-1, len(light))
    least = flat.min(axis=0)
    fitted = 2 + _edge_basis(half, 0.0, EDGE_SIGMAS_PX[0]).shape[1]  # place and width
    # Samples of one pixel are not independent.
    variance = np.maximum(np.square(noise_e), least / COLUMN_SAMPLES / (2 * WINDOW_PX + 1 - fitted))
    chi2 = np.maximum(rest - least, 0.0) / COLUMN_SAMPLES / np.where(variance > 0, variance, 1.0)
    weight = np.exp(-0.5 * chi2)
    smooth = total - np.sum(np.square(light @ _smooth_basis(half)), axis=1)
    clear = np.sqrt(np.maximum(smooth - least, 0.0) / COLUMN_SAMPLES) / np.maximum(noise_e, 1e-9)
    return weight / weight.sum(axis=(0, 1)), flat.argmin(axis=0), clear


def _half_level(light: Array, half: int, best: Ints) -> Array:
    """Places [px] (n,) where the samples (n, 2 half + 1) cross the middle between ground and sky of the fit `best`.

    Of fuzzy ground (trees) it depends less on the light on the leaves than the place of the fitted edge does.
    """
    from scipy.ndimage import uniform_filter1d

    x = np.arange(-half, half + 1) / COLUMN_SAMPLES
    smooth = uniform_filter1d(light, SMOOTH_SAMPLES, axis=1)
    found = np.full(len(light), np.nan)
    for k in np.unique(best):
        place, width = PLACES_PX[k % len(PLACES_PX)], EDGE_SIGMAS_PX[k // len(PLACES_PX)]
        rows = np.flatnonzero(best == k)
        ground, sky, slope = np.linalg.lstsq(_edge_profile(half, place, width), light[rows].T, rcond=None)[0]
        level = 0.5 * (ground + sky + slope * SKY_LEVEL_PX)[:, None]
        above = (smooth[rows] - level) * np.sign(sky - ground)[:, None]
        crossing = (above[:, :-1] < 0) & (above[:, 1:] >= 0)
        distance = np.where(crossing, np.abs(x[:-1] - place), np.inf)
        at = np.argmin(distance, axis=1)
        low, high = above[np.arange(len(rows)), at], above[np.arange(len(rows)), at + 1]
        found[rows] = np.where(
            np.isfinite(distance.min(axis=1)),
            x[at] - low / np.where(high > low, high - low, 1.0) / COLUMN_SAMPLES,
            np.nan,
        )
    return found


@lru_cache(maxsize=8)
def _smooth_basis(half: int) -> Array:
    """Orthonormal columns (2 half + 1, n) that span the smooth courses of light: of a lens that darkens at its edge."""
    x = np.linspace(-1.0, 1.0, 2 * half + 1)
    return np.linalg.qr(x[:, None] ** np.arange(SMOOTH_DEGREE + 1))[0]


@lru_cache(maxsize=512)
def _edge_basis(half: int, place_px: float, sigma_px: float) -> Array:
    """Orthonormal columns (2 half + 1, 3) that span the profiles of an edge."""
    return np.linalg.qr(_edge_profile(half, place_px, sigma_px))[0]


def _edge_profile(half: int, place_px: float, sigma_px: float) -> Array:
    """Columns (2 half + 1, 3): ground, sky and the sky's slope, for an edge at a place in the window."""
    from scipy.special import ndtr

    x = np.arange(-half, half + 1) / COLUMN_SAMPLES - place_px
    sky = ndtr(x / sigma_px)
    return np.stack([1.0 - sky, sky, sky * x], axis=1)
