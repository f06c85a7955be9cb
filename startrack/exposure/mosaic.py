"""Colour mosaics (Bayer): the four kinds of pixels brought to one level and one gain, the geometry left as it is.

A demosaiced picture has correlated noise, a binned one half the resolution: both harm faint stars more than pixels that
differ a little in noise do. Which colour a pixel has need not be known: only that the pattern repeats every 2 pixels.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from startrack.types import Array

Picture = NDArray[np.float32]

MOSAIC_WARNING = "colour mosaic: its four kinds of pixels are brought to one level and one gain"
BLOCK_PX = 32  # of a phase's own pixels: the background is smooth over that
STAR_BOX_PX = 4  # holds each phase four times
STAR_SIGMAS = 8.0
FEWEST_STAR_PIXELS = 400  # of each phase, to know its gain
GAIN_LIMITS = 0.2, 5.0
NEARLY_SATURATED = 0.9
PHASES = ((0, 0), (0, 1), (1, 0), (1, 1))


def evened(pixels_adu: Picture, saturation_adu: float | None) -> Picture:
    """The mosaic (H, W) [ADU] as if all pixels had the same filter; saturated pixels stay saturated."""
    if min(pixels_adu.shape) < 4 * BLOCK_PX:
        return pixels_adu  # too small to hold stars of every phase
    levels = [_level(pixels_adu[i::2, j::2]) for i, j in PHASES]
    common = np.asarray(np.mean(levels, axis=0), dtype=np.float32)
    excess = np.empty_like(pixels_adu)
    for (i, j), level in zip(PHASES, levels, strict=True):
        phase = pixels_adu[i::2, j::2]
        excess[i::2, j::2] = phase - _stretched(level, phase.shape)
    saturated = None if saturation_adu is None else pixels_adu >= saturation_adu
    gains = _gains(excess, None if saturation_adu is None else pixels_adu > NEARLY_SATURATED * saturation_adu)
    for (i, j), gain in zip(PHASES, gains, strict=True):
        phase = excess[i::2, j::2]
        phase /= np.float32(gain)
        phase += _stretched(common, phase.shape)
    if saturated is not None and saturation_adu is not None:
        excess[saturated] = np.maximum(excess[saturated], np.float32(saturation_adu))
    return excess


def _level(phase: Picture) -> Picture:
    """Medians of its blocks."""
    rows, columns = (n // BLOCK_PX for n in phase.shape)
    blocks = phase[: rows * BLOCK_PX, : columns * BLOCK_PX].reshape(rows, BLOCK_PX, columns, BLOCK_PX)
    return np.asarray(np.median(blocks.swapaxes(1, 2).reshape(rows, columns, -1), axis=2), dtype=np.float32)


def _stretched(level: Picture, shape: tuple[int, ...]) -> Picture:
    import cv2

    return np.asarray(cv2.resize(level, (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR), dtype=np.float32)


def _gains(excess: Picture, spoilt: NDArray[np.bool_] | None) -> Array:
    """Gain of each phase (4,), their mean 1, from the stars: every star pixel counts alike, whatever its star's light.

    All 1 where there are too few stars to tell.
    """
    import cv2

    local = cv2.blur(excess, (STAR_BOX_PX, STAR_BOX_PX))
    middle = np.median(local)
    sigma = 1.4826 * float(np.median(np.abs(local - middle)))
    stars = local > middle + STAR_SIGMAS * max(sigma, 1e-6)
    if spoilt is not None and spoilt.any():
        stars &= cv2.dilate(spoilt.astype(np.uint8), np.ones((9, 9), np.uint8)) == 0
    ratio = np.where(stars, excess / np.where(stars, local, 1.0), 0.0)
    found = np.array([np.count_nonzero(stars[i::2, j::2]) for i, j in PHASES])
    if found.min() < FEWEST_STAR_PIXELS:
        return np.ones(4)
    gains = np.array([ratio[i::2, j::2].sum(dtype=np.float64) for i, j in PHASES]) / found
    return np.clip(gains / gains.mean(), *GAIN_LIMITS)
