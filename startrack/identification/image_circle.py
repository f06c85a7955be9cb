"""The image circle of a fisheye lens, found by its edge in the frame's background."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.types import Array

WORKED_ON_PX = 160  # longer side of the background that is looked at
DIRECTIONS = 72
OFF_CENTRE = 0.1  # of the frame's shorter side
SMALLEST, LARGEST = 0.28, 0.62  # radius over the frame's shorter side
RING = 0.05  # the edge lies between rings this part of the radius inside and outside
STEP_PX = 2.0
CONTRAST = 0.2  # of the two rings, at the median of the directions: moonlit photographs with trees reach 0.3
SEEN = 0.5  # of the directions must be in the frame
DARKEST_PERCENTILE = 0.5


@dataclass(frozen=True)
class ImageCircle:
    """What the lens lights up: pixels [px] of the frame."""

    centre_px: tuple[float, float]
    radius_px: float


def image_circle(background: NDArray[Any]) -> ImageCircle | None:
    """The bright disc in a background (H, W); None where no edge stands out, or the frame lies within the disc.

    Of all discs the one with the largest median contrast (bright - dark) / (bright + dark - 2 darkest) over its edge:
    walls and trees may hide almost half of it.
    """
    import cv2

    height, width = background.shape
    if min(height, width) < WORKED_ON_PX // 4:
        return None
    scale = max(height, width) / WORKED_ON_PX
    shape = max(round(width / scale), 1), max(round(height / scale), 1)
    small = np.asarray(cv2.resize(background.astype(np.float32), shape, interpolation=cv2.INTER_AREA), dtype=np.float32)
    small -= np.percentile(small, DARKEST_PERCENTILE)
    if float(small.max()) <= 0.0:
        return None
    middle, shorter = 0.5 * (np.array(shape) - 1), min(shape)
    best = _best(
        small, middle, OFF_CENTRE * shorter, np.arange(SMALLEST * shorter, LARGEST * shorter, STEP_PX), STEP_PX
    )
    if best is None:
        return None
    centre, radius, _ = best
    best = _best(small, centre, STEP_PX, radius + np.arange(-STEP_PX, STEP_PX + 0.1, 0.5), 0.5)
    if best is None or best[2] < CONTRAST:
        return None
    (x, y), radius, _ = best
    return ImageCircle((float((x + 0.5) * scale - 0.5), float((y + 0.5) * scale - 0.5)), radius * scale)


def _best(
    image: NDArray[Any], middle: Array, reach: float, radii: Array, step: float
) -> tuple[Array, float, float] | None:
    """Centre, radius and median contrast of the best disc of these radii with its centre within reach of `middle`."""
    turn = np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS
    around = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    shift = np.arange(-reach, reach + 0.5 * step, step)
    centres = middle + np.stack(np.meshgrid(shift, shift), axis=-1).reshape(-1, 2)
    bright = max(float(np.median(image[image > np.median(image)])), 1e-6)  # a reflex in the dark is no edge
    best = None
    for radius in radii:
        inner, _ = _sampled(image, centres[:, None] + (1 - RING) * radius * around)
        outer, seen = _sampled(image, centres[:, None] + (1 + RING) * radius * around)
        contrast = np.where(seen, (inner - outer) / np.maximum(inner + outer, bright), np.nan)
        enough = seen.mean(axis=1) >= SEEN
        if not enough.any():
            continue
        median = np.nanmedian(contrast[enough], axis=1) * np.sqrt(seen[enough].mean(axis=1))
        i = int(np.argmax(median))
        if best is None or median[i] > best[2]:
            best = (centres[enough][i], float(radius), float(median[i]))
    return best


def _sampled(image: NDArray[Any], xy_px: Array) -> tuple[Array, Any]:
    """Values of the nearest pixels, never below 0, and whether the places are in the image."""
    column, row = np.rint(xy_px).astype(np.int64).transpose(2, 0, 1)
    seen = (column >= 0) & (row >= 0) & (column < image.shape[1]) & (row < image.shape[0])
    values = image[np.clip(row, 0, image.shape[0] - 1), np.clip(column, 0, image.shape[1] - 1)]
    return np.maximum(values, 0.0), seen
