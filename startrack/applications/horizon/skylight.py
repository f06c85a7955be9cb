"""Where the sky's light stops: steps of the brightness along columns of constant azimuth, to a part of a pixel.

At a step the brightness below departs from the sky's, extrapolated from above. Ground may be darker or brighter. A step
need not be the skyline: trees have inner edges, the sky has clouds and reflections. The posterior weighs them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from startrack.applications.horizon.columns import (
    SAMPLES_PER_PX,
    Columns,
    average_columns,
    mean_above,
    remove_points,
    sample_columns,
)
from startrack.applications.horizon.edges import measure_edges
from startrack.applications.horizon.grid import COLUMNS
from startrack.camera import Camera
from startrack.core.types import Array, Bools, Ints

GAP_PX = 1.0  # on either side of the step: the blurred edge
SKY_PX, GROUND_PX = 4.0, 3.0  # lengths of the averages above and below
MAX_SLOPE_1 = 0.08  # change of the sky's brightness over SKY_PX, relative to it
MIN_SIGNIFICANCE = 3.0
PEAK_PX = 2.0  # a step is the most significant within this distance
RELATIVE_ERROR = 0.02  # of the extrapolated sky, of its brightness above the darkest pixels
DARKEST_PERCENT = 0.5
HIGHEST_STEP_RAD = np.radians(45.0)  # above, columns are narrower than pixels and see the same features
LEVEL_RAD, ABOVE_RAD = np.radians(2.0), np.radians(20.0)  # for the brightness of the sky above a step


@dataclass(frozen=True)
class Steps:
    """Steps of the brightness (n), from all columns."""

    column: Ints
    elevation_rad: Array
    sigma_rad: Array
    contrast: Array  # brightness below minus above, relative to the brightest sky above
    significance: Array


def find_steps(
    image_e: NDArray[np.float32], noise_e: NDArray[np.float32], lost: NDArray[np.uint8], camera: Camera,
    R_cam_enu: Array, *, widths: tuple[int, ...], stars_px: Array, glare_px: Array,
) -> list[Steps]:  # fmt: skip
    """All significant steps of an image (H, W) [e], for each width of columns averaged.

    `noise_e`: of its pixels; `lost`: those that are left out (`lost_pixels`), like the light of stars, of radii
    `glare_px` (m,) around `stars_px` (m, 2).
    """
    columns = sample_columns(remove_points(image_e, noise_e), noise_e, lost, (stars_px, glare_px), camera, R_cam_enu)
    return [_steps_of(average_columns(columns, width), width) for width in widths]


def _steps_of(columns: Columns, width: int) -> Steps:
    """The steps of columns that are means over `width`."""
    width_px = width * 2 * np.pi / COLUMNS / columns.px_rad
    dark = float(np.nanpercentile(columns.light_e, DARKEST_PERCENT))
    at_ground = _level_above(columns, GAP_PX, 2 * GAP_PX + GROUND_PX / 2, dark)
    below = mean_above(columns, -GAP_PX - GROUND_PX, -GAP_PX)
    difference = below - at_ground
    noise = columns.noise_e / np.sqrt(max(width_px, 1.0))
    sigma = np.sqrt(
        np.square(noise) * (6.0 / SKY_PX + 1.0 / GROUND_PX) + np.square(RELATIVE_ERROR * (at_ground - dark))
    )
    significance = np.abs(difference) / sigma
    peak = _is_peak(significance, round(PEAK_PX * SAMPLES_PER_PX)) & (significance > MIN_SIGNIFICANCE)
    peak &= columns.elevation_rad[:, None] < HIGHEST_STEP_RAD
    row, column = np.nonzero(peak)
    elevation, sigma_px, good = measure_edges(columns, row, column, noise)
    contrast = difference[row, column] / np.maximum(_sky_level(columns)[row, column] - dark, 1e-9)
    sigma_rad = sigma_px * columns.px_rad
    return Steps(column[good], elevation[good], sigma_rad[good], contrast[good], significance[row, column][good])


def _level_above(columns: Columns, gap_px: float, distance_px: float, dark_e: float) -> Array:
    """The sky's brightness (k, columns) extrapolated downwards by `distance_px` from `gap_px` above each elevation.

    The slope is limited: where the samples above are ground themselves, they are no measure of the sky's slope.
    """
    near = mean_above(columns, gap_px, gap_px + SKY_PX)
    far = mean_above(columns, gap_px + SKY_PX, gap_px + 2 * SKY_PX)
    limit = MAX_SLOPE_1 * np.maximum(near - dark_e, 0.0)
    return near + np.clip(near - far, -limit, limit) * (distance_px + SKY_PX / 2) / SKY_PX


def _sky_level(columns: Columns) -> Array:
    """Largest mean (k, columns) of LEVEL_RAD within ABOVE_RAD above each elevation."""
    from scipy.ndimage import maximum_filter1d

    mean = mean_above(columns, 0.0, LEVEL_RAD / columns.px_rad)
    size = round(ABOVE_RAD / columns.step_rad)
    return np.asarray(maximum_filter1d(np.nan_to_num(mean), size, axis=0, origin=-(size // 2), mode="constant"))


def _is_peak(values: Array, half: int) -> Bools:
    """Whether each value (k, columns) is the largest within `half` samples along its column."""
    from scipy.ndimage import maximum_filter1d

    clean = np.nan_to_num(values)
    return (clean > 0) & (clean == maximum_filter1d(clean, 2 * half + 1, axis=0))
