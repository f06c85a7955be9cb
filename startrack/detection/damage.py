"""Pixels that are not what the sensor saw: dead parts, masked pixels, and noise that processing changed.

A dead part is a rectangle that holds one value in a frame that is noisy elsewhere. Clipping, filtering and coarse steps
show in the noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from startrack.camera import Camera
from startrack.core.statistics import NORMAL_BY_MEDIAN
from startrack.core.types import Array, Bools, Exposure, Image, Ints, TooFewStars
from startrack.detection.background import BLOCK_PX, CLIPPED_SIGMA, MIN_NOISE_STEPS, smallest_step
from startrack.kernels.library import kernel

PROBE_PX, STRIDE_PX = BLOCK_PX // 2, 4 * BLOCK_PX  # of the tiles looked at first: dead parts of 72 px hold one
LOST_NOISE = "the noise is lost (rounding, compression or a filter)"
MOST_EQUAL = 0.8  # of the tiles: with more of one value the noise is lost
MIN_SIDE_PX = PROBE_PX + 1  # of a rectangle of noise no 81 pixels are equal
MIN_PART = 0.004  # of the image; smaller constant blocks occur behind JPEG compression
MIN_FILLED = 0.95  # of the rectangle about a part: saturated stars and dark ground are no rectangles
MIN_GOOD_PX = BLOCK_PX**2 // 4  # of a block: a quarter gives its level to an eighth of the noise
TILES = 16  # of BLOCK_PX across the image, and the least number of tiles that tell: 65,536 pixels, 2 ms
CLIPPED_PART = 0.01  # of the pixels that hold the lowest value; a sensor's noise: below 0.001
CORRELATION = 0.15  # of neighbouring pixels; at most 0.0 in rendered frames, 0.09 in a real one, 0.36 behind filters
FILTERED_CORRELATION = 2 * CORRELATION  # from here on the image itself is filtered, not noise added to the sensor's
COARSE_STEPS = 0.5  # noise in steps of the values below which rounding rules
HIGHEST_SIGMAS = 1.0  # of the noise, for the correlation; the lowest is CLIPPED_SIGMA
FAR_PX = 7  # farther than any filter's kernel reaches
ROUNDED = (
    "the noise is below half a step of the pixel values, whose rounding hides faint stars: give raw or 16-bit "
    "pictures, a stack of such, or a longer exposure"
)
FEW_STARS_PERCENTILE = 25.0  # of the tiles' correlations
ORIGINAL = "give the frame as the sensor recorded it"


@dataclass(frozen=True)
class Damage:
    """Damage that processing did to the noise of an exposure."""

    cause: str  # in words, with a number
    has_levels: bool  # the levels of extended light, and their errors, are as the pixels show them

    @property
    def message(self) -> str:
        """Cause, and what to give instead, in one line."""
        return f"{self.cause}; {ORIGINAL}"


def find_damage(exposure: Exposure, camera: Camera | None = None) -> Damage | None:
    """The damage that shows in tiles of an `exposure` within the image circle of a `camera`; None: none shows.

    Tiles of one value (a masked border, a dead part) are left out, unless nearly all are. Clipping shows in the counts
    as recorded, filtering in the counts corrected by dark frame and flat field, whose patterns are no noise.
    """
    if min(exposure.size_px) < 2 * BLOCK_PX:
        return None
    corners = _tile_corners(exposure.recorded_adu, camera)
    tiles = _tiles_at(exposure.recorded_adu, corners)
    equal = np.ptp(tiles, axis=(1, 2)) == 0
    if len(tiles) >= TILES and MOST_EQUAL < equal.mean() < 1.0 and (tiles[equal] == tiles.min()).all():
        return Damage(f"{LOST_NOISE}: {100 * equal.mean():.0f} % of the image has one value", False)
    tiles, corners = tiles[~equal], corners[~equal]
    if len(tiles) < TILES:
        return None
    ordered, _, sigma = _order_values(tiles)
    lowest = ordered[:, 0].min()
    clipped = float(np.mean(ordered == lowest))
    steps = np.diff(ordered[:: max(1, len(ordered) // 16)], axis=1)
    if clipped > CLIPPED_PART and np.median(sigma) > COARSE_STEPS * steps[steps > 0].min():
        cause = f"values are clipped at {lowest:g} ADU: {100 * clipped:.0f} % of the pixels hold this value"
        return Damage(cause, False)
    noisy = sigma > 0
    if np.count_nonzero(noisy) < len(tiles) / 2:
        cause = f"{LOST_NOISE}: most pixels of {100 * np.mean(~noisy):.0f} % of the image are equal"
        return Damage(cause, False)
    correlation = _neighbour_correlation(_tiles_at(exposure.pixels_adu, corners[noisy]))
    if correlation > CORRELATION:
        cause = f"the image is filtered or compressed: neighbouring pixels correlate by {correlation:.2f}"
        return Damage(cause, correlation < FILTERED_CORRELATION)
    return None


def is_rounded(noise: Image, step: float) -> bool:
    """Whether rounding to this `step` hides stars: most of the `noise` (H, W), in its unit, is below half a step."""
    return bool(np.median(noise) < COARSE_STEPS * step)


def _tile_corners(pixels_adu: NDArray[np.float32], camera: Camera | None) -> Ints:
    """First pixels (n, 2), x and y, of tiles on a regular grid, without those that touch a dead part."""
    height, width = pixels_adu.shape
    top, left = (np.linspace(0, n - BLOCK_PX, min(TILES, n // BLOCK_PX)).astype(int) for n in (height, width))
    corners = np.stack(np.meshgrid(left, top), axis=-1).reshape(-1, 2)
    if camera is not None:
        ends = np.array([(0, 0), (0, 1), (1, 0), (1, 1)]) * (BLOCK_PX - 1.0)
        corners = corners[camera.angle_rad(corners[:, None] + ends).max(axis=1) < camera.max_angle_rad]
    dead = find_dead_parts(pixels_adu)
    return np.asarray(corners if dead is None else corners[~_tiles_at(dead, corners).any(axis=(1, 2))])


def _tiles_at(pixels: NDArray[Any], corners: Ints) -> NDArray[Any]:
    """Tiles (n, side, side) whose first pixels are `corners` (n, 2), x and y."""
    windows = np.lib.stride_tricks.sliding_window_view(pixels, (BLOCK_PX, BLOCK_PX))
    return np.asarray(windows[corners[:, 1], corners[:, 0]])


def _order_values(tiles: NDArray[np.float32]) -> tuple[NDArray[np.float32], Array, Array]:
    """Values (n, m) of each tile in order, their middle (n,), and the sigma (n,) of the noise by their quartiles."""
    ordered = np.sort(tiles.reshape(len(tiles), -1), axis=1)
    low, middle, high = (ordered[:, k * BLOCK_PX**2 // 4] for k in (1, 2, 3))
    return ordered, np.asarray(middle), np.asarray(0.5 * NORMAL_BY_MEDIAN * (high - low))


def _neighbour_correlation(tiles: NDArray[np.float32]) -> float:
    """Correlation of pixels with the next ones in rows and columns: that of the tiles with few stars.

    Stars, on one side of the noise, are clipped; what pixels seven apart share (slopes) is taken out.
    """
    _, middle, sigma = _order_values(tiles)
    noisy = sigma > 0
    z = (tiles[noisy] - middle[noisy, None, None]) / sigma[noisy, None, None]
    z = np.clip(z, -CLIPPED_SIGMA, HIGHEST_SIGMAS)
    z -= z.mean(axis=(1, 2), keepdims=True)
    near, far = (
        0.5 * ((z[:, :, d:] * z[:, :, :-d]).mean(axis=(1, 2)) + (z[:, d:] * z[:, :-d]).mean(axis=(1, 2)))
        for d in (1, FAR_PX)
    )
    found = (near - far) / np.maximum(np.mean(np.square(z), axis=(1, 2)) - far, 1e-9)
    return float(np.percentile(found, FEW_STARS_PERCENTILE))


def find_dead_parts(pixels_adu: NDArray[np.float32]) -> Bools | None:
    """The pixels (H, W) in rectangles of one value, below the highest one, of a frame that is noisy elsewhere.

    None where there are none, as in a frame with a side shorter than PROBE_PX.
    """
    if min(pixels_adu.shape) < PROBE_PX:
        return None
    corners = np.lib.stride_tricks.sliding_window_view(pixels_adu, (PROBE_PX, PROBE_PX))[::STRIDE_PX, ::STRIDE_PX]
    tiles = corners.reshape(-1, PROBE_PX**2)
    equal = np.ptp(tiles, axis=1) == 0
    if not equal.any() or equal.mean() > MOST_EQUAL:
        return None
    # A calm sky has one value too.
    if np.median(tiles[~equal].std(axis=1)) < MIN_NOISE_STEPS * smallest_step(pixels_adu):
        return None
    here = pixels_adu[:-1, :-1]
    same = ((here == pixels_adu[:-1, 1:]) & (here == pixels_adu[1:, :-1])).view(np.uint8)
    squares = cv2.morphologyEx(same, cv2.MORPH_OPEN, np.ones((MIN_SIDE_PX, MIN_SIDE_PX), np.uint8))
    count, _, stats, _ = cv2.connectedComponentsWithStats(squares, connectivity=4)
    found = np.zeros(pixels_adu.shape, dtype=bool)
    for left, top, width, height, area in stats[1:count].tolist():
        is_part = area >= MIN_FILLED * width * height and width * height >= MIN_PART * pixels_adu.size
        if is_part and pixels_adu[top, left] < pixels_adu.max():
            found[top : top + height + 1, left : left + width + 1] = True  # a pixel is compared with the next ones
    return found if found.any() else None


def fill_masked(image: Image, masked: Bools) -> Image:
    """The image (H, W) with each masked pixel replaced by a good one of its block, or of the nearest good block.

    Level and noise beside the masked pixels are then those of the good ones: the background needs no mask.
    Raises TooFewStars (no_stars) where no block has enough good pixels.
    """
    from scipy.ndimage import distance_transform_edt

    rows, columns = (np.arange(0, length, BLOCK_PX) for length in image.shape)
    good = np.add.reduceat(np.add.reduceat(~masked, rows, axis=0, dtype=np.int64), columns, axis=1)
    poor = good < MIN_GOOD_PX
    if poor.all():
        raise TooFewStars("the mask leaves too few pixels of the frame")
    source = distance_transform_edt(poor, return_distances=False, return_indices=True)
    filled = np.array(image, order="C")
    _fill_from_blocks(
        filled, np.ascontiguousarray(masked), good, source.astype(np.int64), BLOCK_PX, np.empty(BLOCK_PX**2, np.float32)
    )
    return filled


_fill_from_blocks = kernel(
    "fill_from_blocks", "image: out float32[height, width]", "masked: bool[height, width]",
    "good: int64[rows, columns]", "source: int64[2, rows, columns]", "side: int64", "values: out float32[room]",
)  # fmt: skip
