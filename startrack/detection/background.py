"""Smooth background and pixel noise of an exposure, and the image circle of a fisheye, whose edge shows in it."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from startrack.core.types import Array, Image, ImageCircle, SmoothImage
from startrack.kernels.library import kernel

BAND_PIXELS = 2**18
BLOCK_PX = 16  # side of the blocks for a PSF up to 1.5 WIDEST_PX
WIDEST_PX = 1.4
STEEP_FRACTION = 0.03  # of the blocks
MIN_NOISE_STEPS = 1.0  # noise in units of the smallest step below which the pixels hold too few values for quantiles
LOW_QUANTILE, HIGH_QUANTILE = 0.05, 0.65  # quantiles of the pixels between which the noise is measured
CLIPPED_SIGMA = 2.5  # beyond, a value is no noise
# From -1/2 to 1/2 evenly, in an order without a pattern: 101 is a prime, so that each number comes once.
ORDER = np.arange(BLOCK_PX**2) * 101 % BLOCK_PX**2
PART_STEPS = ((ORDER - 0.5 * (len(ORDER) - 1)) / len(ORDER)).astype(np.float32).reshape(BLOCK_PX, BLOCK_PX)
REDUCED_SIDE_PX = 160  # longer side of the reduced background
EDGE_POINTS = 72  # in which the edge is looked for
LARGEST_OFFSET_1 = 0.1  # of the centre from the frame's, over the shorter side
SMALLEST_RADIUS_1, LARGEST_RADIUS_1 = 0.28, 0.62  # over the frame's shorter side
RING_1 = 0.05  # of the radius: distance of the rings inside and outside the edge
DISC_STEP_PX = 2.0
MIN_CONTRAST_1 = 0.2  # median over the directions; moonlit photographs with trees reach 0.3
MIN_SEEN_1 = 0.5  # of the directions that lie in the frame
DARKEST_PERCENTILE = 0.5


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


def _measure_blocks(
    image: Image, side: int, quantum: float, measure: Callable[[Image], tuple[Image, ...]]
) -> list[Image]:
    """The results (blocks,) of `measure` for the ordered pixels (blocks, BLOCK_PX^2) of square blocks, row by row.

    Medians of whole numbers are whole numbers, and a spread would be wrong by up to half a step in 8-bit images: the
    same pattern of part-steps, of mean zero, is added to every block; its variance must be subtracted.

    A few rows of blocks at a time fit into the processor's cache.
    """
    rows, columns = (-(-length // side) for length in image.shape)
    at_a_time, image = max(1, BAND_PIXELS // (columns * BLOCK_PX**2)), np.ascontiguousarray(image)
    blocks, bands = np.empty((at_a_time, columns, BLOCK_PX, BLOCK_PX), dtype=np.float32), []
    for first in range(0, rows, at_a_time):
        band = blocks[: rows - first]
        _fill_blocks(image, side, first, np.float32(quantum) * PART_STEPS, band)
        ordered = band.reshape(-1, BLOCK_PX**2)
        ordered.sort(axis=1)
        bands.append(measure(ordered))
    return [np.concatenate(parts) for parts in zip(*bands, strict=True)]


def _median_and_spread(ordered: Image) -> tuple[Image, Image]:
    """Medians (blocks,) of ordered pixels (blocks, n), and the standard deviations (blocks,) of their noise."""
    middle = ordered.shape[1] // 2
    return np.float32(0.5) * (ordered[:, middle - 1] + ordered[:, middle]), ordered @ _scale_weights()


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
    """Smallest step between the values of an `image` (H, W): the noise cannot be below its rounding error."""
    values = np.unique(image[:: max(1, image.shape[0] // 64), :: max(1, image.shape[1] // 64)])
    step = float(np.diff(values).min()) if len(values) > 1 else 1.0
    return max(step, 1e-6)


_fill_blocks = kernel(
    "fill_blocks", "image: float32[height, width]", "side: int64", "first: int64", "part_steps: float32[px, px]",
    "blocks: out float32[rows, columns, px, px]",
)  # fmt: skip


def image_circle(background: NDArray[Any]) -> ImageCircle | None:
    """The bright disc in a background (H, W); None without a clear edge, or where the frame lies within the disc.

    It is the disc with the largest median contrast (bright - dark) / (bright + dark - 2 darkest) across its edge, of
    which walls and trees may hide almost half.
    """
    import cv2

    height, width = background.shape
    if min(height, width) < REDUCED_SIDE_PX // 4:
        return None
    scale = max(height, width) / REDUCED_SIDE_PX
    shape = max(round(width / scale), 1), max(round(height / scale), 1)
    small = np.asarray(cv2.resize(background.astype(np.float32), shape, interpolation=cv2.INTER_AREA), dtype=np.float32)
    small -= np.percentile(small, DARKEST_PERCENTILE)
    if float(small.max()) <= 0.0:
        return None
    middle, shorter = 0.5 * (np.array(shape) - 1), min(shape)
    radii = np.arange(SMALLEST_RADIUS_1 * shorter, LARGEST_RADIUS_1 * shorter, DISC_STEP_PX)
    best = _best_disc(small, middle, LARGEST_OFFSET_1 * shorter, radii, DISC_STEP_PX)
    if best is None:
        return None
    radii = best[1] + np.arange(-DISC_STEP_PX, DISC_STEP_PX + 0.1, 0.5)
    best = _best_disc(small, best[0], DISC_STEP_PX, radii, 0.5)
    if best is None or best[2] < MIN_CONTRAST_1:
        return None
    (x, y), radius, _ = best
    return ImageCircle((float((x + 0.5) * scale - 0.5), float((y + 0.5) * scale - 0.5)), radius * scale)


def _best_disc(
    image: NDArray[Any], middle: Array, offset: float, radii: Array, step: float
) -> tuple[Array, float, float] | None:
    """Centre, radius and median contrast of the best disc of these radii, its centre up to `offset` from `middle`."""
    direction = np.arange(EDGE_POINTS) * 2 * np.pi / EDGE_POINTS
    around = np.stack([np.cos(direction), np.sin(direction)], axis=1)
    shift = np.arange(-offset, offset + 0.5 * step, step)
    centres = middle + np.stack(np.meshgrid(shift, shift), axis=-1).reshape(-1, 2)
    # A faint reflection in the dark is no edge.
    bright = max(float(np.median(image[image > np.median(image)])), 1e-6)
    best = None
    for radius in radii:
        inner, _ = _sample(image, centres[:, None] + (1 - RING_1) * radius * around)
        outer, seen = _sample(image, centres[:, None] + (1 + RING_1) * radius * around)
        contrast = np.where(seen, (inner - outer) / np.maximum(inner + outer, bright), np.nan)
        enough = seen.mean(axis=1) >= MIN_SEEN_1
        if not enough.any():
            continue
        median = np.nanmedian(contrast[enough], axis=1) * np.sqrt(seen[enough].mean(axis=1))
        i = int(np.argmax(median))
        if best is None or median[i] > best[2]:
            best = (centres[enough][i], float(radius), float(median[i]))
    return best


def _sample(image: NDArray[Any], xy_px: Array) -> tuple[Array, Any]:
    """Values of the nearest pixels, at least 0, and whether the positions lie in the image."""
    column, row = np.rint(xy_px).astype(np.int64).transpose(2, 0, 1)
    seen = (column >= 0) & (row >= 0) & (column < image.shape[1]) & (row < image.shape[0])
    values = image[np.clip(row, 0, image.shape[0] - 1), np.clip(column, 0, image.shape[1] - 1)]
    return np.maximum(values, 0.0), seen
