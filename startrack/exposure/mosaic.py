"""Colour mosaics (Bayer): raw files of colour cameras (DNG, CR2, NEF, ARW, ...), and one level and gain for all pixels.

Raw files are read by LibRaw: the sensor's own counts, not developed. A demosaiced picture has correlated noise and a
binned one half the resolution; both harm faint stars more than a small difference in noise between pixels does. The
colours of the pixels need not be known, only that the pattern repeats every 2 pixels.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from io import BytesIO

import numpy as np
from numpy.typing import NDArray

from startrack.core.errors import how_to_install
from startrack.core.statistics import robust_sigma
from startrack.core.types import Array
from startrack.exposure.decoding import Decoded, bad_image, check_size

STDERR = 2  # its file descriptor
Picture = NDArray[np.float32]

MOSAIC_WARNING = "colour mosaic: its four kinds of pixels are brought to one level and one gain"
PHASE_BLOCK_PX = 32  # of a phase's own pixels: the background is smooth over that
STAR_BOX_PX = 4  # holds each phase four times
STAR_SIGMAS = 8.0
MIN_STAR_PIXELS = 400  # of each phase, to estimate its gain
GAIN_LIMITS = 0.2, 5.0
NEARLY_SATURATED_1 = 0.9  # of the saturation
PHASES = ((0, 0), (0, 1), (1, 0), (1, 1))


def decode(raw: bytes) -> Decoded:
    """The mosaic as the sensor gave it, without its masked border, black level not subtracted.

    No time is taken from it: such cameras write local times. Raises BadInput bad_image if it is damaged, if its pixels
    are no 2 x 2 mosaic, or if rawpy (extra `raw`) is not installed.
    """
    if find_spec("rawpy") is None:
        raise bad_image(f"is a camera raw file, which needs rawpy: {how_to_install('raw')}")
    import rawpy

    with _discard_stderr(), rawpy.imread(BytesIO(raw)) as file:
        check_size(file.sizes.width, file.sizes.height)
        if file.raw_type is not rawpy.RawType.Flat:
            raise bad_image("holds colours in layers; startrack reads mosaics")
        pattern = file.raw_pattern
        if pattern is not None and pattern.shape != (2, 2):
            raise bad_image(f"has a mosaic of {pattern.shape[0]} x {pattern.shape[1]}; startrack reads 2 x 2")
        pixels = file.raw_image_visible.astype(np.float32)
        white = float(file.white_level)
    return Decoded(pixels_adu=pixels, saturation_adu=white, mosaic=pattern is not None)


@contextmanager
def _discard_stderr() -> Iterator[None]:
    """Discard what LibRaw, which has no switch for it, prints about a damaged file: the exception has the cause."""
    sys.stderr.flush()
    kept, nowhere = os.dup(STDERR), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, STDERR)
        yield
    finally:
        os.dup2(kept, STDERR)
        os.close(kept)
        os.close(nowhere)


def equalize_mosaic(pixels_adu: Picture, saturation_adu: float | None) -> Picture:
    """The mosaic `pixels_adu` (H, W) scaled to one level and gain; pixels at `saturation_adu` stay saturated."""
    if min(pixels_adu.shape) < 4 * PHASE_BLOCK_PX:
        return pixels_adu  # too small to hold stars of every phase
    levels = [_block_medians(pixels_adu[i::2, j::2]) for i, j in PHASES]
    common = np.asarray(np.mean(levels, axis=0), dtype=np.float32)
    excess = np.empty_like(pixels_adu)
    for (i, j), level in zip(PHASES, levels, strict=True):
        phase = pixels_adu[i::2, j::2]
        excess[i::2, j::2] = phase - _upsample(level, phase.shape)
    saturated = None if saturation_adu is None else pixels_adu >= saturation_adu
    gains = _gains(excess, None if saturation_adu is None else pixels_adu > NEARLY_SATURATED_1 * saturation_adu)
    for (i, j), gain in zip(PHASES, gains, strict=True):
        phase = excess[i::2, j::2]
        phase /= np.float32(gain)
        phase += _upsample(common, phase.shape)
    if saturated is not None and saturation_adu is not None:
        excess[saturated] = np.maximum(excess[saturated], np.float32(saturation_adu))
    return excess


def _block_medians(phase: Picture) -> Picture:
    """Medians of the blocks of one kind of pixels."""
    rows, columns = (n // PHASE_BLOCK_PX for n in phase.shape)
    blocks = phase[: rows * PHASE_BLOCK_PX, : columns * PHASE_BLOCK_PX].reshape(
        rows, PHASE_BLOCK_PX, columns, PHASE_BLOCK_PX
    )
    return np.asarray(np.median(blocks.swapaxes(1, 2).reshape(rows, columns, -1), axis=2), dtype=np.float32)


def _upsample(level: Picture, shape: tuple[int, ...]) -> Picture:
    import cv2

    return np.asarray(cv2.resize(level, (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR), dtype=np.float32)


def _gains(excess: Picture, spoilt: NDArray[np.bool_] | None) -> Array:
    """Gain of each phase (4,), their mean 1, from star pixels, each with the same weight whatever its star's flux."""
    import cv2

    local = cv2.blur(excess, (STAR_BOX_PX, STAR_BOX_PX))
    stars = local > np.median(local) + STAR_SIGMAS * max(robust_sigma(local), 1e-6)
    if spoilt is not None and spoilt.any():
        stars &= cv2.dilate(spoilt.astype(np.uint8), np.ones((9, 9), np.uint8)) == 0
    ratio = np.where(stars, excess / np.where(stars, local, 1.0), 0.0)
    found = np.array([np.count_nonzero(stars[i::2, j::2]) for i, j in PHASES])
    if found.min() < MIN_STAR_PIXELS:
        return np.ones(4)
    gains = np.array([ratio[i::2, j::2].sum(dtype=np.float64) for i, j in PHASES]) / found
    return np.clip(gains / gains.mean(), *GAIN_LIMITS)
