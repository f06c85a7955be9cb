"""Masked pixels filled with their surroundings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from startrack.core.kernels import njit
from startrack.core.types import Bools, TooFewStars
from startrack.detection.background import BLOCK_PX

Image = NDArray[np.float32]
MIN_GOOD_PX = 64  # of the 256 of a block: a quarter gives its level to an eighth of the noise


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
    _fill_blocks(filled, masked, good, source.astype(np.int64))
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
def _fill_blocks(image, masked, good, source) -> None:  # type: ignore[no-untyped-def]
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
