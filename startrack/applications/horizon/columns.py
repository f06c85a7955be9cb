"""The image along columns of constant azimuth, on the grid of azimuths and elevations of the skyline.

Stars and saturated pixels are taken out. Means are taken along and across the columns.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from startrack.camera import Camera
from startrack.core.types import Array, Bools, Detections, Ints
from startrack.frames import off_axis_rad, rays_from_azel

SKYLINE_AZIMUTHS = 360  # of the result, one degree each
COLUMNS_PER_AZIMUTH = 4
AZIMUTH_COLUMNS = SKYLINE_AZIMUTHS * COLUMNS_PER_AZIMUTH
LOWEST_RAD, GRID_STEP_RAD = np.radians(-5.0), np.radians(0.02)  # of the grid of elevations
HIGHEST_GROUND_RAD = np.radians(45.0)  # higher columns are narrower than pixels and see the same features
LEVEL_RAD, ABOVE_RAD = np.radians(2.0), np.radians(20.0)  # for the brightness of the sky above a step
TOP_RAD = HIGHEST_GROUND_RAD + ABOVE_RAD + LEVEL_RAD  # of the columns
COLUMN_SAMPLES = 3  # per pixel along a column, and across it
FILL_SHARE = 0.1  # of the widest average around a star: so many columns without a star are enough
LARGE_AREA_PX, MOON_GLARE_PX = 500, 40  # of the Moon and what surrounds it
SATURATED_PX = 5  # around saturated pixels nothing is measured
USUAL_SCATTER = 1.25  # of its median over the picture: the variance of columns that their noise explains
SCATTER_PX = 4.0  # up and down, over which the scatter of averaged columns is measured
HOT_SIGMAS = 6.0  # above the median of the neighbours: stars and hot pixels


@dataclass(frozen=True)
class Averaging:
    """A mean over columns and elevations in which steps are sought."""

    columns: int  # odd
    pixels: int  # along a column
    slopes: tuple[float, ...]  # of its rows, elevation over azimuth
    weight: float  # of its steps: averages share their pixels with their neighbours and with each other


# A faint ridge shows in wide averages only, and a steep one only in those that follow it.
SLOPES = (-0.6, -0.3, 0.0, 0.3, 0.6)
AVERAGINGS = (
    Averaging(1, 1, (0.0,), 0.6), Averaging(7, 1, (0.0,), 0.3), Averaging(21, 1, (0.0,), 0.2),
    Averaging(21, 3, SLOPES, 0.6),
)  # fmt: skip


def elevations_rad() -> Array:
    """Elevations (n,) of the grid, ascending."""
    return np.asarray(np.arange(LOWEST_RAD, (np.pi + GRID_STEP_RAD) / 2, GRID_STEP_RAD))


def column_of(azimuth_rad: Array) -> Ints:
    """The column (n,) that each azimuth (n,) lies in."""
    column = np.floor(azimuth_rad * (AZIMUTH_COLUMNS / (2 * np.pi)) + COLUMNS_PER_AZIMUTH / 2)
    return np.asarray(column, dtype=np.int64) % AZIMUTH_COLUMNS


@dataclass(frozen=True)
class Columns:
    """Brightness (k, columns) on a grid of elevations, nan out of view."""

    elevation_rad: Array  # (k,) ascending
    light_e: Array  # (k, columns)
    noise_e: Array  # (k, columns) of one sample's pixel
    step_rad: float
    px_rad: float  # along a column
    across_px_rad: float  # a pixel across the columns, by which the noise of neighbouring columns is the same

    @cached_property
    def sums(self) -> tuple[Array, Array]:
        """Sums (k + 1, columns) of the samples below each elevation, and the numbers of known ones."""
        zero = np.zeros((1, self.light_e.shape[1]))
        known = np.isfinite(self.light_e)
        light = np.cumsum(np.where(known, self.light_e, 0.0), axis=0)
        return np.concatenate([zero, light]), np.concatenate([zero, np.cumsum(known, axis=0)])


def sample_columns(
    detections: Detections, stars: tuple[Array, Array], camera: Camera, R_cam_enu: Array
) -> Columns:  # fmt: skip
    """The image of `detections` along columns of azimuth; masked pixels and those near saturated ones are left out.

    `stars` (pixels (m, 2), radii (m,)), fainter ones and hot pixels are replaced by their surroundings.
    """
    noise_e, lost = detections.noise_e, _lost_pixels(detections)
    smooth = cv2.medianBlur(detections.image_e, 3)
    stands_out = np.abs(detections.image_e - smooth) > HOT_SIGMAS * noise_e
    image_e = np.where(stands_out, smooth, detections.image_e).astype(np.float32)
    # Size of a pixel in elevation at the horizon, or where the view comes nearest to it; at least that of the grid.
    away = off_axis_rad(rays_from_azel(np.linspace(0, 2 * np.pi, 36, endpoint=False), 0.0) @ R_cam_enu.T)
    slope = camera.lens.slope(np.array(np.minimum(np.min(away), camera.max_angle_rad)))
    px_rad = max(float(1.0 / (np.sqrt(np.prod(camera.focal_px)) * slope)), COLUMN_SAMPLES * GRID_STEP_RAD)
    elevation = np.arange(LOWEST_RAD, TOP_RAD, px_rad / COLUMN_SAMPLES)
    disks = np.zeros_like(lost)
    for (i, j), radius in zip(np.rint(stars[0]).astype(int).tolist(), stars[1], strict=True):
        cv2.circle(disks, (i, j), round(radius), (1.0,), -1)
    shape = len(elevation), AZIMUTH_COLUMNS
    total, spread, points = np.zeros(shape), np.zeros(shape), np.zeros(shape, dtype=bool)
    # Of the columns' middles: four lie evenly about each degree.
    middles = (np.arange(AZIMUTH_COLUMNS) + 0.5 - COLUMNS_PER_AZIMUTH / 2) * (2 * np.pi / AZIMUTH_COLUMNS)
    for k in range(COLUMN_SAMPLES):
        azimuth = middles + ((k + 0.5) / COLUMN_SAMPLES - 0.5) * 2 * np.pi / AZIMUTH_COLUMNS
        x, y, inside = image_points(camera, R_cam_enu, azimuth[None, :], elevation[:, None])
        hidden = ~inside | (cv2.remap(lost, x, y, cv2.INTER_NEAREST) > 0)
        total += np.where(hidden, np.nan, cv2.remap(image_e, x, y, cv2.INTER_LINEAR))
        spread += cv2.remap(noise_e, x, y, cv2.INTER_NEAREST)
        points |= cv2.remap(disks, x, y, cv2.INTER_NEAREST) > 0
    light_e, spread_e = total / COLUMN_SAMPLES, spread / COLUMN_SAMPLES
    columns = Columns(elevation, light_e, spread_e, px_rad / COLUMN_SAMPLES, px_rad, px_rad)
    without = replace(columns, light_e=np.where(points, np.nan, columns.light_e))
    around = average_columns(without, AVERAGINGS[-1].columns, FILL_SHARE).light_e
    return replace(columns, light_e=np.where(points, around, columns.light_e))


def image_points(
    camera: Camera, R_cam_enu: Array, azimuth_rad: NDArray[np.floating[Any]], elevation_rad: NDArray[np.floating[Any]]
) -> tuple[NDArray[np.float32], NDArray[np.float32], Bools]:
    """Pixels x and y of directions as OpenCV takes them, and which directions are in view.

    `azimuth_rad` and `elevation_rad` have shapes that broadcast to that of the results; `R_cam_enu` is (3, 3).
    """
    xy, inside = camera.project(rays_from_azel(azimuth_rad, elevation_rad) @ R_cam_enu.T)
    x, y = (np.ascontiguousarray(xy[..., axis], dtype=np.float32) for axis in (0, 1))
    return x, y, inside


def _lost_pixels(detections: Detections) -> NDArray[np.uint8]:
    """Pixels (H, W) that are masked, or near saturated ones; nearer ones of a lamp or a star than of the Moon."""
    masked = np.zeros_like(detections.dead) if detections.mask is None else detections.mask.masked
    saturated = detections.dead & ~masked
    count, label, facts, _ = cv2.connectedComponentsWithStats(saturated.astype(np.uint8))
    large = np.isin(label, 1 + np.flatnonzero(facts[1:count, cv2.CC_STAT_AREA] > LARGE_AREA_PX))
    around = [cv2.dilate(part.astype(np.uint8), np.ones((2 * px + 1,) * 2, np.uint8))
              for part, px in ((saturated, SATURATED_PX), (large, MOON_GLARE_PX))]  # fmt: skip
    return np.asarray(np.maximum(*around) | masked.view(np.uint8), dtype=np.uint8)


def average_columns(columns: Columns, width: int, least: float = 0.49, slope: float = 0.0) -> Columns:
    """Running means over an odd number of columns, of which at least the share `least` must be in view.

    `slope` is that of the rows over which a mean goes, elevation over azimuth. The noise is that of the mean: by that
    of the pixels, and by what the columns differ more than usual, half of them from the other half (at a wall).
    """
    from scipy.ndimage import uniform_filter1d

    known = np.isfinite(columns.light_e)
    light, share = np.where(known, columns.light_e, 0.0), known.astype(float)
    per_column = slope * (2 * np.pi / AZIMUTH_COLUMNS) / columns.step_rad
    rise = per_column * np.arange(-(width // 2), width // 2 + 1, dtype=np.float64)
    total, squares, share = (_mean_along(one, rise) for one in (light, np.square(light), share))
    mean = np.where(share > least, total / np.maximum(share, 1e-9), np.nan)
    pixel2 = np.square(columns.noise_e)
    width_px = width * 2 * np.pi / AZIMUTH_COLUMNS / columns.across_px_rad * np.cos(columns.elevation_rad)
    noise2 = pixel2 / np.maximum(width_px, 1.0)[:, None]
    if width > 1:
        scatter2 = np.maximum(squares / np.maximum(share, 1e-9) - np.square(np.nan_to_num(mean)), 0.0)
        nearby = uniform_filter1d(scatter2, 2 * round(SCATTER_PX * COLUMN_SAMPLES) + 1, axis=0)
        usual = np.nanmedian(np.where(share > least, nearby, np.nan) / np.maximum(pixel2, 1e-9))
        noise2 += np.maximum(nearby - USUAL_SCATTER * usual * pixel2, 0.0) / 2.0
    return replace(columns, light_e=mean, noise_e=np.sqrt(noise2))


def _mean_along(samples: Array, rise: Array) -> Array:
    """Means of samples (k, columns) over the columns beside each, `rise` (odd n,) samples higher; 0 beyond the ends."""
    from scipy.ndimage import uniform_filter1d

    if not rise.any():
        return np.asarray(uniform_filter1d(samples, len(rise), axis=1, mode="wrap"))
    reach = int(np.ceil(np.abs(rise).max())) + 1
    padded = np.pad(samples, ((reach, reach), (0, 0)))
    total = np.zeros_like(samples)
    for beside, up in zip(np.arange(len(rise)) - len(rise) // 2, rise, strict=True):
        low = int(np.floor(up))
        first, part = reach + low, up - low
        rows = (1.0 - part) * padded[first : first + len(samples)] + part * padded[first + 1 : first + 1 + len(samples)]
        total += np.roll(rows, -beside, axis=1)
    return total / len(rise)


def coarser(columns: Columns, pixels: int) -> Columns:
    """The columns with pixels that are means over so many `pixels` along a column, and samples as much farther apart.

    A mean with a part out of view is unknown. Across the columns the pixels are those of the image.
    """
    rows = len(columns.elevation_rad) // pixels * pixels

    def mean(samples: Array) -> Array:
        return np.asarray(samples[:rows].reshape(-1, pixels, *samples.shape[1:]).mean(axis=1))

    return Columns(
        mean(columns.elevation_rad), mean(columns.light_e), mean(columns.noise_e) / np.sqrt(pixels),
        columns.step_rad * pixels, columns.px_rad * pixels, columns.across_px_rad,
    )  # fmt: skip


def mean_above(columns: Columns, low_px: float, high_px: float) -> Array:
    """Mean (k, columns) of the samples from `low_px` to `high_px` above each elevation; nan where one is missing."""
    low, high = round(low_px * COLUMN_SAMPLES), round(high_px * COLUMN_SAMPLES)
    (sums, count), samples = columns.sums, len(columns.elevation_rad)
    first, last = (np.clip(np.arange(samples) + to, 0, samples) for to in (low, high))
    full = (count[last] - count[first]) == high - low
    return np.where(full, (sums[last] - sums[first]) / (high - low), np.nan)
