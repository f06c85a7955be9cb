"""Smooth background and pixel noise of an exposure, robust against stars and steps."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import cv2
import numpy as np

from startrack.core.kernels import REORDERED_SUMS, njit
from startrack.core.smooth_image import Image, SmoothImage

BAND_PIXELS = 2**18
BLOCK_PX = 16  # side of the blocks for a PSF up to 1.5 WIDEST_PX
WIDEST_PX = 1.4
STEEP_FRACTION = 0.03  # of the blocks
MIN_NOISE_STEPS = 1.0  # noise in units of the smallest step below which the pixels hold too few values for quantiles
LOW_QUANTILE, HIGH_QUANTILE = 0.05, 0.65  # quantiles of the pixels between which the noise is measured
COARSE_PX = BLOCK_PX // 4  # the local level is a mean over squares of this side
CLIPPED_SIGMA = 2.5  # beyond, a value is no noise
# From -1/2 to 1/2 evenly, in an order without a pattern: 101 is a prime, so that each number comes once.
ORDER = np.arange(BLOCK_PX**2) * 101 % BLOCK_PX**2
PART_STEPS = ((ORDER - 0.5 * (len(ORDER) - 1)) / len(ORDER)).astype(np.float32).reshape(BLOCK_PX, BLOCK_PX)


def background_and_noise(image: Image, quantum: float, sigma_px: float) -> tuple[SmoothImage, SmoothImage]:
    """Background and standard deviation of one pixel of an image (H, W), both in its unit.

    `quantum` is the smallest step of the image's values. Medians over blocks (larger for a wide PSF, so that no star
    fills one), median-filtered so that stars, tracks and saturated blobs drop out but a step (the skyline, the edge of
    the image circle) stays within a block; interpolated bilinearly. Weak where a bright extended source fills several
    blocks.
    """
    side = block_side(sigma_px)
    shape = -(-image.shape[0] // side), -(-image.shape[1] // side)
    level, spread = _measure_blocks(image, side, quantum, _median_and_spread)
    level_map = cv2.medianBlur(level.reshape(shape), 3)
    spread_map = cv2.medianBlur(spread.reshape(shape), 5)
    background = SmoothImage.from_blocks(level_map, side, image.shape)
    # Blocks between which the level changes by more than the noise: a slope within a block is no noise.
    rows, columns = np.abs(np.diff(level_map, axis=0)), np.abs(np.diff(level_map, axis=1))
    steep = [step > spread for step, spread in ((rows, spread_map[1:]), (columns, spread_map[:, 1:]))]
    if max(float(np.mean(s)) if s.size else 0.0 for s in steep) > STEEP_FRACTION:
        _, spread = _measure_blocks(image - background.whole(), side, quantum, _median_and_spread)
        spread_map = np.minimum(spread_map, cv2.medianBlur(spread.reshape(shape), 5))
    rounding = quantum**2 / 12.0
    if np.median(spread_map) < MIN_NOISE_STEPS * quantum:
        few = np.float32(4 * quantum)  # the quantiles of little more than one value do not show the noise

        def measure_spread(ordered: Image) -> tuple[Image]:
            middle = ordered[:, ordered.shape[1] // 2, None]
            return (np.clip(ordered, middle - few, middle + few).std(axis=1),)

        (spread,) = _measure_blocks(image, side, quantum, measure_spread)
        spread_map = cv2.medianBlur(spread.reshape(shape), 5)
    noise_map = np.sqrt(np.maximum(np.square(spread_map) - rounding, rounding), dtype=np.float32)
    return background, SmoothImage.from_blocks(noise_map, side, image.shape)


def block_side(sigma_px: float) -> int:
    """Side [px] of the blocks for a PSF of this width."""
    return BLOCK_PX * max(1, round(sigma_px / WIDEST_PX))


def smooth_level(means: Image, width_px: int, shape: tuple[int, ...]) -> SmoothImage:
    """Mean over a box of residuals (H, W), from their `clipped_means`: the background that block medians miss.

    Boxes are made of whole squares of COARSE_PX, which costs a third of the time and no more than their coarseness.
    """
    side = coarse_width(width_px)
    smooth = cv2.boxFilter(means, -1, (side, side), borderType=cv2.BORDER_REFLECT)
    return SmoothImage.from_blocks(np.asarray(smooth, dtype=np.float32), COARSE_PX, shape)


@njit(cache=True, nogil=True, fastmath=REORDERED_SUMS, error_model="numpy")
def clipped_means(values, means):  # type: ignore[no-untyped-def]
    """Fill means (h, w) with those of squares of COARSE_PX of the values (H, W), at the borders of what there is.

    Values beyond CLIPPED_SIGMA count as zero, not as the nearest value: stars are all on one side.
    """
    height, width = values.shape
    zero, limit = np.float32(0.0), np.float32(CLIPPED_SIGMA)
    column = np.empty(width, np.float32)
    for i in range(means.shape[0]):
        top, bottom = i * COARSE_PX, min((i + 1) * COARSE_PX, height)
        column[:] = zero
        for y in range(top, bottom):
            for x in range(width):
                value = values[y, x]
                column[x] += value if abs(value) <= limit else zero
        for j in range(means.shape[1]):
            first, last = j * COARSE_PX, min((j + 1) * COARSE_PX, width)
            total = zero
            for x in range(first, last):
                total += column[x]
            means[i, j] = total / np.float32((bottom - top) * (last - first))


def coarse_width(width_px: int) -> int:
    """The odd number of COARSE_PX nearest to a width [px]."""
    return 2 * int(round(width_px / COARSE_PX - 1) // 2) + 1 if width_px > COARSE_PX else 1


def _measure_blocks(
    image: Image, side: int, quantum: float, measure: Callable[[Image], tuple[Image, ...]]
) -> list[Image]:
    """The results (blocks,) of `measure` for the ordered pixels (n, BLOCK_PX^2) of square blocks, row by row.

    A few rows of blocks at a time fit into the processor's cache.
    """
    rows = side * max(1, BAND_PIXELS * (side // BLOCK_PX) ** 2 // (side * image.shape[1]))
    bands = [
        measure(np.sort(_blocks(image[top : top + rows], side, quantum), axis=1))
        for top in range(0, image.shape[0], rows)
    ]
    return [np.concatenate(parts) for parts in zip(*bands, strict=True)]


def _median_and_spread(ordered: Image) -> tuple[Image, Image]:
    middle = ordered.shape[1] // 2
    return np.float32(0.5) * (ordered[:, middle - 1] + ordered[:, middle]), ordered @ _scale_weights()


def _blocks(image: Image, side: int, quantum: float) -> Image:
    """(blocks, BLOCK_PX^2): the image cut into square blocks, its border reflected to fill the last ones.

    Of larger blocks some pixels, spread evenly, are enough: squares of two by two, for colour filters' sake.

    Medians of whole numbers are whole numbers, and a spread would be wrong by up to half a step in 8-bit images: the
    same pattern of part-steps, of mean zero, is added to every block; its variance must be subtracted.
    """
    height, width = image.shape
    below, right = -height % side, -width % side
    if below or right:
        image = np.asarray(cv2.copyMakeBorder(image, 0, below, 0, right, cv2.BORDER_REFLECT_101), dtype=np.float32)
    blocks = np.empty((image.shape[0] // side, image.shape[1] // side, BLOCK_PX, BLOCK_PX), dtype=np.float32)
    _fill_blocks(np.ascontiguousarray(image), side, np.float32(quantum) * PART_STEPS, blocks)
    return blocks.reshape(-1, BLOCK_PX**2)


@njit(cache=True, nogil=True)
def _fill_blocks(image, side, part_steps, blocks):  # type: ignore[no-untyped-def]
    """Fill blocks (rows, columns, BLOCK_PX, BLOCK_PX) with squares of two by two of the image, and the part-steps."""
    apart = 2 * side // BLOCK_PX  # the squares
    for i in range(blocks.shape[0]):
        for r in range(BLOCK_PX):
            line, steps = image[i * side + r // 2 * apart + r % 2], part_steps[r]
            for j in range(blocks.shape[1]):
                block, part = blocks[i, j, r], line[j * side : (j + 1) * side]
                if apart == 2:  # the whole block
                    for c in range(BLOCK_PX):
                        block[c] = part[c] + steps[c]
                else:
                    for c in range(BLOCK_PX):
                        block[c] = part[c // 2 * apart + c % 2] + steps[c]


@cache
def _scale_weights() -> Image:
    """Weights of the ordered pixels of a block whose sum is the standard deviation of the noise.

    The slope of the normal quantile plot between two quantiles, by least squares: as sharp as the median absolute
    deviation, and half as much misled by stars, which are all on one side.
    """
    from scipy.special import ndtri

    part = (np.arange(BLOCK_PX**2) + 0.625) / (BLOCK_PX**2 + 0.25)
    expected = np.where((part > LOW_QUANTILE) & (part < HIGH_QUANTILE), ndtri(part), 0.0)
    inside = expected != 0.0
    expected[inside] -= expected[inside].mean()
    return (expected / np.sum(np.square(expected))).astype(np.float32)


def smallest_step(image: Image) -> float:
    """Smallest step between pixel values: the noise cannot be below its rounding error."""
    values = np.unique(image[:: max(1, image.shape[0] // 64), :: max(1, image.shape[1] // 64)])
    step = float(np.diff(values).min()) if len(values) > 1 else 1.0
    return max(step, 1e-6)
