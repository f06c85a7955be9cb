"""Where point sources may be: peaks of the matched filter, and the middles of saturated blobs."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from startrack.detect.background import COARSE_PX, coarse_width, local_level
from startrack.detect.frame import Frame, Image, radius_for
from startrack.psf import filter_kernel
from startrack.types import Array, Ints

FIRST_PASS_SNR = 4.3  # below the final threshold: a star between pixels shows up to 15 % less in the filtered image
AROUND = [(-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)]


@dataclass(frozen=True)
class Peaks:
    """Candidates (n), saturated blobs first, then by the height of their peak."""

    centres: Ints  # (n, 2) pixels (x, y)
    start_xy_px: Array  # (n, 2) first guess of the place
    surround: Array  # (n,) level of the surroundings, the source's own light in it
    own_part: float  # part of a source's matched-filter light that the level of the surroundings takes away


def find_peaks(frame: Frame, sigma: float, most: int) -> Peaks:
    """Local maxima of the matched-filter SNR above FIRST_PASS_SNR, at most `most` of them: the highest."""
    margin = radius_for(sigma)
    width = 2 * (4 * margin // 2) + 1
    standardised = cv2.divide(frame.residual, frame.noise)
    level = local_level(standardised, width)
    kernel = filter_kernel(sigma)
    squared = float(np.sum(kernel.astype(np.float64) ** 2))
    np.subtract(standardised, level, out=standardised)
    snr = cv2.sepFilter2D(standardised, -1, kernel, kernel, dst=standardised, borderType=cv2.BORDER_REFLECT)
    flat = np.flatnonzero(snr > np.float32(FIRST_PASS_SNR * squared))
    rows, columns = np.divmod(flat, snr.shape[1])
    rows, columns = _inside(frame, rows, columns, margin)
    height = snr[rows, columns]
    highest = np.ones(len(rows), dtype=bool)
    for down, right in AROUND:
        highest &= height >= snr[rows + down, columns + right]
    rows, columns, height = rows[highest], columns[highest], height[highest]
    if len(rows) > most:
        chosen = np.sort(np.argpartition(-height, most)[:most])
        rows, columns, height = rows[chosen], columns[chosen], height[chosen]
    order = np.argsort(-height, kind="stable")
    peaks = np.stack([columns[order], rows[order]], axis=1).astype(np.int64)
    start = peaks + _parabola(snr, peaks)
    blobs = _saturated_blobs(frame.dead, margin)[:most]
    centres = np.concatenate([blobs, peaks])
    return Peaks(
        centres=centres,
        start_xy_px=np.concatenate([blobs.astype(np.float64), start]),
        surround=_at(level, centres) * _at(frame.noise, centres),
        own_part=min(float(1.0 / squared**2) / (COARSE_PX * coarse_width(width)) ** 2, 0.5),
    )


def _at(image: Image, centres: Ints) -> Array:
    return np.asarray(image[centres[:, 1], centres[:, 0]].astype(np.float64))


def _inside(frame: Frame, rows: Ints, columns: Ints, margin: int) -> tuple[Ints, Ints]:
    height, width = frame.residual.shape
    good = (rows >= margin) & (rows < height - margin) & (columns >= margin) & (columns < width - margin)
    if frame.dead is not None:
        good &= ~frame.dead[rows, columns]
    return rows[good], columns[good]


def _parabola(filtered: Image, peaks: Ints) -> Array:
    """Offsets (n, 2) [px] of the top of parabolas through the peaks and their neighbours in x and in y."""
    x, y = peaks[:, 0], peaks[:, 1]
    offset = np.zeros((len(peaks), 2))
    middle = filtered[y, x]
    for axis, (low, high) in enumerate(
        [(filtered[y, x - 1], filtered[y, x + 1]), (filtered[y - 1, x], filtered[y + 1, x])]
    ):
        bend = low - 2 * middle + high
        offset[:, axis] = np.divide(0.5 * (low - high), bend, out=np.zeros_like(bend), where=bend < 0)
    return np.clip(offset, -0.5, 0.5)


def _saturated_blobs(dead: NDArray[np.bool_] | None, margin: int) -> Ints:
    """Middle pixels (n, 2) of the saturated blobs: bright stars whose own peak is a plateau."""
    if dead is None:
        return np.zeros((0, 2), dtype=np.int64)
    count, _, stats, centroids = cv2.connectedComponentsWithStats(dead.astype(np.uint8))
    height, width = dead.shape
    middle = np.rint(centroids[1:count]).astype(np.int64)
    inside = (middle >= margin).all(axis=1) & (middle[:, 0] < width - margin) & (middle[:, 1] < height - margin)
    compact = stats[1:count, cv2.CC_STAT_AREA] <= (2 * margin + 1) ** 2
    return middle[inside & compact]
