"""The image circle of a fisheye lens, whose edge shows in the background of the frame."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.core.types import Array, ImageCircle

REDUCED_SIDE_PX = 160  # longer side of the reduced background
EDGE_POINTS = 72  # in which the edge is looked for
LARGEST_OFFSET_1 = 0.1  # of the centre from the frame's, over the shorter side
SMALLEST_RADIUS_1, LARGEST_RADIUS_1 = 0.28, 0.62  # over the frame's shorter side
RING_1 = 0.05  # of the radius: distance of the rings inside and outside the edge
DISC_STEP_PX = 2.0
MIN_CONTRAST_1 = 0.2  # median over the directions; moonlit photographs with trees reach 0.3
MIN_SEEN_1 = 0.5  # of the directions that lie in the frame
DARKEST_PERCENTILE = 0.5


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
