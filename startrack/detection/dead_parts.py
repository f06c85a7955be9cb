"""Dead parts of a sensor: rectangles of a noisy frame that hold one value each."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from startrack.core.types import Bools, Mask
from startrack.detection.background import smallest_step

TILE_PX, STRIDE_PX = 8, 64  # of the tiles that are looked at first: dead parts of 72 px and more hold one
MIN_STEPS = 1.0  # standard deviation of the noise, in steps of the values: below it a calm sky has one value too
MOST_EQUAL = 0.8  # of the tiles: with more of one value the noise is removed
MIN_SIDE_PX = 9  # of a rectangle of noise no 81 pixels are equal
MIN_PART = 0.004  # of the image; smaller constant blocks occur behind JPEG compression
MIN_FILLED = 0.95  # of the rectangle about a part: saturated stars and dark ground are no rectangles


def find_dead_parts(pixels_adu: NDArray[np.float32]) -> Bools | None:
    """The pixels (H, W) in rectangles of one value, below the highest one, of a frame that is noisy elsewhere.

    None where there are none.
    """
    corners = np.lib.stride_tricks.sliding_window_view(pixels_adu, (TILE_PX, TILE_PX))[::STRIDE_PX, ::STRIDE_PX]
    tiles = corners.reshape(-1, TILE_PX * TILE_PX)
    equal = np.ptp(tiles, axis=1) == 0
    if not equal.any() or equal.mean() > MOST_EQUAL:
        return None
    if np.median(tiles[~equal].std(axis=1)) < MIN_STEPS * smallest_step(pixels_adu):
        return None
    found = np.zeros(pixels_adu.shape, dtype=bool)
    for left, top, width, height in _rectangles(_equal_pixels(pixels_adu)):
        part = np.s_[top : top + height + 1, left : left + width + 1]  # a pixel is compared with the next ones
        if width * height >= MIN_PART * pixels_adu.size and pixels_adu[top, left] < pixels_adu.max():
            found[part] = True
    return found if found.any() else None


def with_dead_parts(mask: Mask | None, dead: Bools | None) -> Mask | None:
    """The `mask` with `dead` pixels (H, W) masked too."""
    if dead is None:
        return mask
    given = mask or Mask(masked=np.zeros_like(dead), sha256="")
    return replace(given, masked=given.masked | dead, dead_part=float(dead.mean()))


def _equal_pixels(pixels_adu: NDArray[np.float32]) -> NDArray[np.uint8]:
    """1 (H - 1, W - 1) in squares of pixels each of which equals the next ones to the right and below."""
    here = pixels_adu[:-1, :-1]
    equal = ((here == pixels_adu[:-1, 1:]) & (here == pixels_adu[1:, :-1])).view(np.uint8)
    square = np.ones((MIN_SIDE_PX, MIN_SIDE_PX), np.uint8)
    return np.asarray(cv2.morphologyEx(equal, cv2.MORPH_OPEN, square), dtype=np.uint8)


def _rectangles(flags: NDArray[np.uint8]) -> list[tuple[int, int, int, int]]:
    """Left, top, width and height of the connected parts of `flags` that fill their rectangles."""
    count, _, stats, _ = cv2.connectedComponentsWithStats(flags, connectivity=4)
    parts = stats[1:count]
    filled = parts[:, cv2.CC_STAT_AREA] >= MIN_FILLED * parts[:, cv2.CC_STAT_WIDTH] * parts[:, cv2.CC_STAT_HEIGHT]
    return [(int(left), int(top), int(width), int(height)) for left, top, width, height, _ in parts[filled]]
