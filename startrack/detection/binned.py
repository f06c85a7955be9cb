"""Frames with squares of pixels added together: a wide PSF loses nothing there that is needed to find its stars."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from startrack.detection.fit import PointFits
from startrack.detection.frame import Frame, Image
from startrack.detection.peaks import Peaks
from startrack.types import Bools

WIDE_PX = 1.8  # from here up the pixels are smaller than need be


def pixels_together(sigma_px: float) -> int:
    """Side of the squares: a power of two that leaves a PSF of 0.9 px or more."""
    return 1 if sigma_px < WIDE_PX else int(2 ** np.floor(np.log2(2.0 * sigma_px / WIDE_PX)))


def binned(frame: Frame, side: int) -> Frame:
    """The frame of the sums of squares (what does not fill a square at the right and below is left out).

    A square is unusable where any of its pixels is.
    """
    if side == 1:
        return frame
    height, width = (side * (length // side) for length in frame.shape)
    whole = slice(0, height), slice(0, width)
    dead = None
    if frame.dead is not None:
        dead = np.asarray(frame.dead[whole].reshape(height // side, side, width // side, side).any(axis=(1, 3)))
    found = None if frame.found is None else _sums(frame.found[whole], side)
    # Background and noise are smooth: one pixel of a square is as good as their mean.
    middle = slice(side // 2, height, side), slice(side // 2, width, side)
    background = frame.background[middle] * np.float32(side**2)
    noise = frame.noise[middle] * np.float32(side)
    return Frame(_sums(frame.image[whole], side), background, noise, dead, frame.light_noise, found)


def _sums(image: Image, side: int) -> Image:
    size = image.shape[1] // side, image.shape[0] // side
    small: Any = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return np.asarray(small * np.float32(side * side), dtype=np.float32)


def in_pixels(fits: PointFits, side: int) -> PointFits:
    """Fits in a binned frame as they are in the frame itself: places and their errors; levels per pixel."""
    if side == 1:
        return fits
    unit = np.array([side, side, 1.0, 1.0 / side**2])
    return replace(
        fits,
        xy_px=side * fits.xy_px + 0.5 * (side - 1),
        level=fits.level / side**2,
        surround=fits.surround / side**2,
        covariance=fits.covariance * np.outer(unit, unit),
    )


def peaks_in_pixels(peaks: Peaks, side: int, shape: tuple[int, int], margin: int) -> Peaks:
    """Peaks of a binned frame as candidates of the frame itself, of this shape (H, W), `margin` off its border."""
    if side == 1:
        return peaks
    start = side * peaks.start_xy_px + 0.5 * (side - 1)
    pixels = np.clip(np.rint(start).astype(np.int64), margin, np.array([shape[1], shape[0]]) - 1 - margin)
    return Peaks(pixels, start, peaks.surround / side**2, peaks.own_part)


def any_dead(dead: Bools) -> Bools | None:
    """The mask, or None where no pixel is unusable."""
    return dead if dead.any() else None
