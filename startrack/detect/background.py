"""Smooth background and pixel noise of an exposure, robust against stars and steps."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

BLOCK_PX = 16
MAD_TO_SIGMA = 1.4826
COARSE_PX = 4  # the local level is a mean over squares of this side
CLIPPED_SIGMA = np.float32(2.5)
Image = NDArray[np.float32]


def background_and_noise(image: Image) -> tuple[Image, Image]:
    """Background (H, W) and standard deviation of one pixel (H, W), in the image's unit.

    Medians over blocks, median-filtered so that stars, tracks and saturated blobs drop out but a step (the skyline, the
    edge of the image circle) stays within a block; interpolated bilinearly. Weak where a bright extended source fills
    several blocks.
    """
    blocks = _blocks(image)
    level = _median(blocks)
    # Every other pixel is enough for the spread (10 % per block before the median filter over 25 blocks).
    spread = MAD_TO_SIGMA * _median(np.abs(blocks[:, ::2] - level[:, None]))
    shape = -(-image.shape[0] // BLOCK_PX), -(-image.shape[1] // BLOCK_PX)
    level_map = cv2.medianBlur(level.reshape(shape), 3)
    spread_map = cv2.medianBlur(spread.reshape(shape), 5)
    quantum = _quantisation_sigma(image)
    return _enlarge(level_map, image.shape), np.maximum(_enlarge(spread_map, image.shape), quantum)


def local_level(standardised: Image, width_px: int) -> Image:
    """Mean over a box of residuals in units of the noise, stars clipped: what the block medians missed, such as a slope.

    Boxes are made of whole squares of COARSE_PX, which costs a third of the time and no more than their coarseness.
    """
    height, width = standardised.shape
    clipped = np.clip(standardised, -CLIPPED_SIGMA, CLIPPED_SIGMA)
    small = -(-width // COARSE_PX), -(-height // COARSE_PX)
    below, right = -height % COARSE_PX, -width % COARSE_PX
    if below or right:
        clipped = np.asarray(cv2.copyMakeBorder(clipped, 0, below, 0, right, cv2.BORDER_REFLECT_101))
    coarse = cv2.resize(clipped, small, interpolation=cv2.INTER_AREA)
    side = coarse_width(width_px)
    smooth = cv2.boxFilter(coarse, -1, (side, side), borderType=cv2.BORDER_REFLECT)
    full: Any = cv2.resize(smooth, (small[0] * COARSE_PX, small[1] * COARSE_PX), interpolation=cv2.INTER_LINEAR)
    return full[:height, :width]


def coarse_width(width_px: int) -> int:
    """The odd number of COARSE_PX nearest to a width [px]."""
    return 2 * int(round(width_px / COARSE_PX - 1) // 2) + 1 if width_px > COARSE_PX else 1


def _median(rows: Image) -> Image:
    """Medians (n,) of rows (n, even): numpy's sort of short rows is many times faster than its median."""
    ordered = np.sort(rows, axis=1)
    middle = rows.shape[1] // 2
    return 0.5 * (ordered[:, middle - 1] + ordered[:, middle])


def _blocks(image: Image) -> Image:
    """(blocks, BLOCK_PX^2): the image cut into square blocks, its border reflected to fill the last ones."""
    height, width = image.shape
    below, right = -height % BLOCK_PX, -width % BLOCK_PX
    if below or right:
        image = np.asarray(cv2.copyMakeBorder(image, 0, below, 0, right, cv2.BORDER_REFLECT_101), dtype=np.float32)
    rows, columns = image.shape[0] // BLOCK_PX, image.shape[1] // BLOCK_PX
    cut = image.reshape(rows, BLOCK_PX, columns, BLOCK_PX).transpose(0, 2, 1, 3)
    return np.ascontiguousarray(cut).reshape(rows * columns, BLOCK_PX * BLOCK_PX)


def _enlarge(block_map: NDArray[Any], shape: tuple[int, ...]) -> Image:
    """Bilinear interpolation between block centres to the full image."""
    rows, columns = block_map.shape
    full: Any = cv2.resize(block_map, (columns * BLOCK_PX, rows * BLOCK_PX), interpolation=cv2.INTER_LINEAR)
    return full[: shape[0], : shape[1]]


def _quantisation_sigma(image: Image) -> np.float32:
    """Rounding noise of the smallest step between pixel values: the noise cannot be below it."""
    values = np.unique(image[:: max(1, image.shape[0] // 64), :: max(1, image.shape[1] // 64)])
    step = float(np.diff(values).min()) if len(values) > 1 else 1.0
    return np.float32(max(step, 1e-6) / np.sqrt(12.0))
