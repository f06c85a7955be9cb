"""Pixels that do not count: dead parts of the sensor, and masked pixels, which are filled with their surroundings.

A dead part is a rectangle that holds one value in a frame that is noisy elsewhere.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from startrack.core.kernels import njit
from startrack.core.types import Bools, TooFewStars
from startrack.detection.background import BLOCK_PX, MIN_NOISE_STEPS, Image, smallest_step

PROBE_PX, STRIDE_PX = 8, 64  # of the tiles that are looked at first: dead parts of 72 px and more hold one
MOST_EQUAL = 0.8  # of the tiles: with more of one value the noise is removed
MIN_SIDE_PX = PROBE_PX + 1  # of a rectangle of noise no 81 pixels are equal
MIN_PART = 0.004  # of the image; smaller constant blocks occur behind JPEG compression
MIN_FILLED = 0.95  # of the rectangle about a part: saturated stars and dark ground are no rectangles
MIN_GOOD_PX = BLOCK_PX**2 // 4  # of a block: a quarter gives its level to an eighth of the noise


def find_dead_parts(pixels_adu: NDArray[np.float32]) -> Bools | None:
    """The pixels (H, W) in rectangles of one value, below the highest one, of a frame that is noisy elsewhere.

    None where there are none.
    """
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

    shape = tuple(-(-length // BLOCK_PX) for length in image.shape)
    good = np.empty(shape, dtype=np.int64)
    _count_good(masked, good)
    poor = good < MIN_GOOD_PX
    if poor.all():
        raise TooFewStars("the mask leaves too few pixels of the frame")
    source = distance_transform_edt(poor, return_distances=False, return_indices=True)
    filled = np.array(image)
    _fill_from_blocks(filled, masked, good, source.astype(np.int64))
    return filled


@njit(cache=True, nogil=True)
def _count_good(masked, good) -> None:  # type: ignore[no-untyped-def]
    """Fill good (rows, columns) with the number of pixels of each block that are not masked."""
    good[:] = 0
    for y in range(masked.shape[0]):
        row = y // BLOCK_PX
        for x in range(masked.shape[1]):
            good[row, x // BLOCK_PX] += not masked[y, x]


@njit(cache=True, nogil=True)
def _fill_from_blocks(image, masked, good, source) -> None:  # type: ignore[no-untyped-def]
    """Replace masked pixels of the image by those of the block `source` (2, rows, columns), one after another."""
    height, width = image.shape
    values = np.empty(BLOCK_PX * BLOCK_PX, image.dtype)
    for row in range(good.shape[0]):
        bottom = min((row + 1) * BLOCK_PX, height)
        for column in range(good.shape[1]):
            right = min((column + 1) * BLOCK_PX, width)
            if good[row, column] == (bottom - row * BLOCK_PX) * (right - column * BLOCK_PX):
                continue
            top, left = source[0, row, column] * BLOCK_PX, source[1, row, column] * BLOCK_PX
            count = 0
            for y in range(top, min(top + BLOCK_PX, height)):
                for x in range(left, min(left + BLOCK_PX, width)):
                    if not masked[y, x]:
                        values[count] = image[y, x]
                        count += 1
            next_value = 0
            for y in range(row * BLOCK_PX, bottom):
                for x in range(column * BLOCK_PX, right):
                    if masked[y, x]:
                        image[y, x] = values[next_value]
                        next_value = (next_value + 1) % count
