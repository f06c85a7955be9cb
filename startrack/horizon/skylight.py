"""Where the sky's light stops: steps of the brightness along columns of constant azimuth, to a part of a pixel.

At a step the brightness below departs from the sky's, extrapolated from above. Ground may be darker or brighter. A step
need not be the skyline: trees have inner edges, the sky has clouds and reflections. The posterior weighs them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from startrack.camera import Camera
from startrack.frames import off_axis_rad, rays_from_azel
from startrack.horizon.grid import COLUMNS, HIGHEST_RAD, LOWEST_RAD, column_azimuths_rad
from startrack.types import Array, Ints

SAMPLES_PER_PX = 3
SIDE_SAMPLES = 3  # across a column
GAP_PX = 1.0  # on either side of the step: the blurred edge
SKY_PX, GROUND_PX = 4.0, 3.0  # lengths of the averages above and below
MAX_SLOPE_1 = 0.08  # change of the sky's brightness over SKY_PX, relative to it
MIN_SIGNIFICANCE = 3.0
RELATIVE_ERROR = 0.02  # of the extrapolated sky, of its brightness above the darkest pixels
WINDOW_PX = 10.0  # half width of the window in which a step's place is measured
REACH_PX, PLACE_STEP_PX = 2.5, 0.125  # places tried about the most significant sample
EDGE_SIGMAS_PX = (0.8,1.5,2.5,3.5)  # widths tried: the PSF, fuzzy trees, haze
MAX_SIGMA_PX = 2.0
SHAPE_ERROR = 0.3  # of the difference between the fitted edge and the half level
BLURRED_PX = 1.5  # error of the place of an edge of the largest width: where ground begins in haze
SMOOTH_SAMPLES = 4
HIGHEST_STEP_RAD = np.radians(45.0)  # above, columns are narrower than pixels and see the same features
SKY_LEVEL_PX = 3.0  # above the edge: where the sky's level is taken; below, haze darkens it
FILL_COLUMNS = 21  # around a star
LARGE_AREA_PX, GLARE_PX = 500, 40  # of the Moon and what surrounds it
SATURATED_PX = 5  # around saturated pixels nothing is measured
LEVEL_RAD, ABOVE_RAD = np.radians(2.0), np.radians(20.0)  # for the brightness of the sky above a step
HOT_SIGMAS = 6.0  # above the median of the neighbours: stars and hot pixels
MIN_SIGMA_PX = 0.1  # of a step's position


@dataclass(frozen=True)
class Steps:
    """Steps of the brightness (n), from all columns, and which elevations each column shows."""

    column: Ints
    elevation_rad: Array
    sigma_rad: Array
    contrast: Array  # brightness below minus above, relative to the brightest sky above
    significance: Array
    lowest_rad: Array  # (columns,) lowest elevation that the photograph shows; nan where it shows nothing


@dataclass(frozen=True)
class _Columns:
    """Brightness (k, columns) on a grid of elevations, nan out of view."""

    elevation_rad: Array  # (k,) ascending
    light_e: Array
    noise_e: Array  # of one sample's pixel
    step_rad: float
    px_rad: float


def find_steps(
    image_e: NDArray[np.float32], noise_e: NDArray[np.float32], dead: NDArray[np.bool_], camera: Camera,
    R_cam_enu: Array, *, widths: tuple[int, ...], stars_px: Array, glare_px: Array,
) -> list[Steps]:  # fmt: skip
    """All significant steps of an image (H, W) [e] with the noise of its pixels; saturated ones, `dead`, are left out."""
    columns = _sample(_without_points(image_e, noise_e), noise_e, dead, (stars_px, glare_px), camera, R_cam_enu)
    return [_steps_of(_average_columns(columns, width), width) for width in widths]


def _average_columns(columns: _Columns, width: int) -> _Columns:
    """Running means over an odd number of columns, at least half of which must be in view."""
    from scipy.ndimage import uniform_filter1d

    known = np.isfinite(columns.light_e)
    total = uniform_filter1d(np.where(known, columns.light_e, 0.0), width, axis=1, mode="wrap")
    share = uniform_filter1d(known.astype(float), width, axis=1, mode="wrap")
    light = np.where(share > 0.49, total / np.maximum(share, 1e-9), np.nan)
    return replace(columns, light_e=light)


def _fill_points(columns: _Columns, points: NDArray[np.bool_]) -> _Columns:
    """The columns with stars, the samples `points` (k, columns), replaced by the mean of their neighbours."""
    without = replace(columns, light_e=np.where(points, np.nan, columns.light_e))
    around = _average_columns(without, FILL_COLUMNS).light_e
    return replace(columns, light_e=np.where(points, around, columns.light_e))


def _steps_of(columns: _Columns, width: int) -> Steps:
    """The steps of columns that are means over `width`."""
    width_px = width * 2 * np.pi / COLUMNS / columns.px_rad
    dark = float(np.nanpercentile(columns.light_e, 0.5))
    at_ground = _level_above(columns, GAP_PX, 2 * GAP_PX + GROUND_PX / 2, dark)
    below = _mean(columns, -GAP_PX - GROUND_PX, -GAP_PX)
    difference = below - at_ground
    pixels = max(width_px, 1.0)
    noise = columns.noise_e / np.sqrt(pixels)
    sigma = np.sqrt(
        np.square(noise) * (6.0 / SKY_PX + 1.0 / GROUND_PX) + np.square(RELATIVE_ERROR * (at_ground - dark))
    )
    significance = np.abs(difference) / sigma
    peak = _is_peak(significance, round(2 * SAMPLES_PER_PX)) & (significance > MIN_SIGNIFICANCE)
    peak &= columns.elevation_rad[:, None] < HIGHEST_STEP_RAD
    row, column = np.nonzero(peak)
    elevation, sigma_px, good = _positions(columns, row, column, noise)
    contrast = difference[row, column] / np.maximum(_sky_level(columns)[row, column] - dark, 1e-9)
    seen = np.isfinite(columns.light_e)
    lowest = np.where(seen.any(axis=0), columns.elevation_rad[np.argmax(seen, axis=0)], np.nan)
    return Steps(column[good], elevation[good], sigma_px[good] * columns.px_rad, contrast[good],
                 significance[row, column][good], lowest)


def _positions(columns: _Columns, row: Ints, column: Ints, noise: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Elevation [rad] and sigma [px] (n,) of steps at samples (row, column) (n,), and which of them are measured.

    Least squares of a level of ground and a sloping level of sky, joined by an edge of one of several widths; the mean
    and the scatter of the edge's place over all widths and places, by their likelihoods.
    """
    half = round(WINDOW_PX * SAMPLES_PER_PX)
    good = (row >= half) & (row < len(columns.elevation_rad) - half)
    middle = np.where(good, row, half)
    light = columns.light_e[middle[:, None] + np.arange(-half, half + 1), column[:, None]]
    good &= np.isfinite(light).all(axis=1)
    light = np.where(good[:, None], light, 0.0)
    light = light - light.mean(axis=1, keepdims=True)
    total = np.sum(np.square(light), axis=1)
    places_px = np.arange(-REACH_PX, REACH_PX + PLACE_STEP_PX / 2, PLACE_STEP_PX)
    rest = np.stack([[total - np.sum(np.square(light @ _edge_basis(half, place, width)), axis=1) for place in places_px]
                     for width in EDGE_SIGMAS_PX])  # fmt: skip
    best = rest.reshape(-1, len(row)).min(axis=0)
    freedom = (2 * WINDOW_PX + 1) - 5.0
    variance = np.maximum(np.square(noise[row, column]), best / SAMPLES_PER_PX / freedom)
    weight = np.exp(-0.5 * np.maximum(rest - best, 0.0) / SAMPLES_PER_PX / np.where(variance > 0, variance, 1.0))
    weight /= weight.sum(axis=(0, 1))
    by_place = weight.sum(axis=0)
    mean_px = places_px @ by_place
    sigma_px = np.sqrt(np.maximum(np.square(places_px) @ by_place - np.square(mean_px), 0.0))
    half_px = _half_level(light, half, places_px, rest.reshape(-1, len(row)).argmin(axis=0))
    half_px = np.where(np.abs(half_px - mean_px) < REACH_PX, half_px, mean_px)
    width_px = np.einsum("w,wpn->n", np.array(EDGE_SIGMAS_PX), weight)
    shape_px = np.hypot(SHAPE_ERROR * np.abs(half_px - mean_px), BLURRED_PX * (width_px / EDGE_SIGMAS_PX[-1]) ** 3)
    elevation = columns.elevation_rad[middle] + half_px * columns.px_rad
    sigma_px = np.sqrt(np.square(sigma_px) + np.square(shape_px) + MIN_SIGMA_PX**2)
    return elevation, sigma_px, good & (sigma_px < MAX_SIGMA_PX)


def _half_level(light: Array, half: int, places_px: Array, best: Ints) -> Array:
    """Places [px] (n,) where the samples (n, 2 half + 1) cross the middle between ground and sky of the fit `best`.

    Of fuzzy ground (trees) it depends less on the light on the leaves than the place of the fitted edge does.
    """
    from scipy.ndimage import uniform_filter1d

    x = np.arange(-half, half + 1) / SAMPLES_PER_PX
    smooth = uniform_filter1d(light, SMOOTH_SAMPLES, axis=1)
    found = np.full(len(light), np.nan)
    for k in np.unique(best):
        place, width = places_px[k % len(places_px)], EDGE_SIGMAS_PX[k // len(places_px)]
        rows = np.flatnonzero(best == k)
        ground, sky, slope = np.linalg.lstsq(_edge_profile(half, place, width), light[rows].T, rcond=None)[0]
        level = 0.5 * (ground + sky + slope * SKY_LEVEL_PX)[:, None]
        above = (smooth[rows] - level) * np.sign(sky - ground)[:, None]
        crossing = (above[:, :-1] < 0) & (above[:, 1:] >= 0)
        distance = np.where(crossing, np.abs(x[:-1] - place), np.inf)
        at = np.argmin(distance, axis=1)
        low, high = above[np.arange(len(rows)), at], above[np.arange(len(rows)), at + 1]
        found[rows] = np.where(np.isfinite(distance.min(axis=1)), x[at] - low / np.where(high > low, high - low, 1.0) / SAMPLES_PER_PX, np.nan)
    return found


@lru_cache(maxsize=512)
def _edge_basis(half: int, place_px: float, sigma_px: float) -> Array:
    """Orthonormal columns (2 half + 1, 3) that span the profiles of an edge."""
    return np.linalg.qr(_edge_profile(half, place_px, sigma_px))[0]


def _edge_profile(half: int, place_px: float, sigma_px: float) -> Array:
    """Columns (2 half + 1, 3): ground, sky and the sky's slope, for an edge at a place in the window."""
    from scipy.special import ndtr

    x = np.arange(-half, half + 1) / SAMPLES_PER_PX - place_px
    sky = ndtr(x / sigma_px)
    return np.stack([1.0 - sky, sky, sky * x], axis=1)


def _sample(
    image_e: NDArray[np.float32], noise_e: NDArray[np.float32], dead: NDArray[np.bool_],
    stars: tuple[Array, Array], camera: Camera, R_cam_enu: Array,
) -> _Columns:  # fmt: skip
    """The image along columns of azimuth, `stars` (pixels (m, 2), radii (m,)) replaced by their surroundings."""
    import cv2

    px_rad = _px_rad(camera, R_cam_enu)
    elevation = np.arange(LOWEST_RAD, HIGHEST_RAD, px_rad / SAMPLES_PER_PX)
    lost = _around_saturated(dead)
    disks = np.zeros(dead.shape, np.uint8)
    for (x, y), radius in zip(np.rint(stars[0]).astype(int).tolist(), stars[1], strict=True):
        cv2.circle(disks, (x, y), round(radius), 1, -1)
    total, spread, points = 0.0, 0.0, False
    for k in range(SIDE_SAMPLES):
        azimuth = column_azimuths_rad() + ((k + 0.5) / SIDE_SAMPLES - 0.5) * 2 * np.pi / COLUMNS
        xy, inside = camera.project(rays_from_azel(azimuth[None, :], elevation[:, None]) @ R_cam_enu.T)
        x, y = (np.ascontiguousarray(xy[..., i], dtype=np.float32) for i in (0, 1))
        hidden = ~inside | (cv2.remap(lost, x, y, cv2.INTER_NEAREST) > 0)
        total = total + np.where(hidden, np.nan, cv2.remap(image_e, x, y, cv2.INTER_LINEAR).astype(np.float64))
        spread = spread + cv2.remap(noise_e, x, y, cv2.INTER_NEAREST).astype(np.float64)
        points = points | (cv2.remap(disks, x, y, cv2.INTER_NEAREST) > 0)
    columns = _Columns(elevation, total / SIDE_SAMPLES, spread / SIDE_SAMPLES, px_rad / SAMPLES_PER_PX, px_rad)
    return _fill_points(columns, points)


def _around_saturated(dead: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Pixels (H, W) near saturated ones; nearer ones of a lamp or a star than of the Moon."""
    import cv2

    count, label, facts, _ = cv2.connectedComponentsWithStats(dead.astype(np.uint8))
    large = np.isin(label, 1 + np.flatnonzero(facts[1:count, cv2.CC_STAT_AREA] > LARGE_AREA_PX))
    around = [cv2.dilate(part.astype(np.uint8), np.ones((2 * px + 1,) * 2, np.uint8))
              for part, px in ((dead, SATURATED_PX), (large, GLARE_PX))]  # fmt: skip
    return np.asarray(np.maximum(*around), dtype=np.uint8)


def _px_rad(camera: Camera, R_cam_enu: Array) -> float:
    """Size [rad] of a pixel in elevation at the horizon, or where the view comes nearest to it."""
    azimuth = np.linspace(0, 2 * np.pi, 36, endpoint=False)
    angle = off_axis_rad(rays_from_azel(azimuth, 0.0) @ R_cam_enu.T)
    nearest = np.minimum(np.min(angle), camera.max_angle_rad)
    return float(1.0 / (np.sqrt(np.prod(camera.focal_px)) * camera.lens.slope(np.array(nearest))))


def _without_points(image, noise):
    """The image with stars and hot pixels replaced by the median of their neighbours."""
    import cv2

    smooth = cv2.medianBlur(image, 3)
    return np.where(np.abs(image - smooth) > HOT_SIGMAS * noise, smooth, image).astype(np.float32)


def _mean(columns: _Columns, low_px: float, high_px: float, values: Array | None = None) -> Array:
    """Mean (k, columns) of the samples from `low_px` to `high_px` above each elevation; nan where one is missing."""
    low, high = round(low_px * SAMPLES_PER_PX), round(high_px * SAMPLES_PER_PX)
    light = columns.light_e if values is None else values
    sums = np.concatenate([np.zeros((1, light.shape[1])), np.cumsum(np.nan_to_num(light), axis=0)])
    count = np.concatenate([np.zeros((1, light.shape[1])), np.cumsum(np.isfinite(light), axis=0)])
    first = np.clip(np.arange(len(light)) + low, 0, len(light))
    last = np.clip(np.arange(len(light)) + high, 0, len(light))
    full = (count[last] - count[first]) == high - low
    return np.where(full, (sums[last] - sums[first]) / (high - low), np.nan)


def _spread(columns: _Columns, low_px: float, high_px: float, mean: Array) -> Array:
    square = _mean(columns, low_px, high_px, np.square(columns.light_e))
    return np.sqrt(np.maximum(square - np.square(mean), 0.0))


def _level_above(columns: _Columns, gap_px: float, distance_px: float, dark_e: float) -> Array:
    """The sky's brightness (k, columns) extrapolated downwards by `distance_px` from `gap_px` above each elevation.

    The slope is limited: where the samples above are ground themselves, they are no measure of the sky's slope.
    """
    near = _mean(columns, gap_px, gap_px + SKY_PX)
    far = _mean(columns, gap_px + SKY_PX, gap_px + 2 * SKY_PX)
    limit = MAX_SLOPE_1 * np.maximum(near - dark_e, 0.0)
    return near + np.clip(near - far, -limit, limit) * (distance_px + SKY_PX / 2) / SKY_PX


def _sky_level(columns: _Columns) -> Array:
    """Largest mean (k, columns) of LEVEL_RAD within ABOVE_RAD above each elevation."""
    from scipy.ndimage import maximum_filter1d

    mean = _mean(columns, 0.0, LEVEL_RAD / columns.px_rad)
    size = round(ABOVE_RAD / columns.step_rad)
    return np.asarray(maximum_filter1d(np.nan_to_num(mean), size, axis=0, origin=-(size // 2), mode="constant"))


def _is_peak(values: Array, half: int) -> NDArray[np.bool_]:
    """Whether each value (k, columns) is the largest within `half` samples along its column."""
    from scipy.ndimage import maximum_filter1d

    clean = np.nan_to_num(values)
    return (clean > 0) & (clean == maximum_filter1d(clean, 2 * half + 1, axis=0))
