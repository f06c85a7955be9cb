"""Candidates for point sources: peaks of the matched filter, and the middles of saturated blobs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from startrack.core.kernels import njit
from startrack.core.types import Array, Ints
from startrack.detection.background import COARSE_PX, coarse_width, local_level
from startrack.detection.frame import Frame, Image, radius_for
from startrack.psf import filter_kernel

PEAK_ROWS = 320
MAX_STAMP_PIXELS = 2_500_000  # of all candidates together: bounds time and memory, for any content of the frame
MAX_BLOBS = 1000  # saturated; the largest
MAX_DEAD_GROUPED_PX = 20_000  # pixels up to which they are grouped without looking at the whole mask
OWN_RESIDUE_SIGMAS = 1.5
ONE_PIXEL_FRACTION = 0.15  # of a peak's light beside it; a star of 0.45 px has 0.18


@dataclass(frozen=True)
class Peaks:
    """Candidates (n), saturated blobs first, then by the height of their peak."""

    centres: Ints  # (n, 2) pixels (x, y)
    start_xy_px: Array  # (n, 2) first guess of the position
    surround: Array  # (n,) level of the surroundings, part of the source's own light in it
    own_part: float  # part of a source's matched-filter light that the level of the surroundings takes away


def find_peaks(frame: Frame, sigma: float, lowest: float, most: int, known: Array | None = None) -> Peaks:
    """Local maxima of the matched-filter SNR above `lowest`, at most `most` of them: the highest.

    `known` (m, 2): positions of stars whose light `frame.found` holds; they come first, then the other peaks.
    """
    from scipy.spatial import cKDTree

    margin = radius_for(sigma)
    most = min(most, MAX_STAMP_PIXELS // (2 * margin + 1) ** 2)
    kernel = filter_kernel(sigma)
    squared = float(np.sum(kernel.astype(np.float64) ** 2))
    width = COARSE_PX * coarse_width(6 * margin + 1)
    pad = COARSE_PX * -(-(width // 2 + 2 * COARSE_PX + len(kernel)) // COARSE_PX)
    strips = [
        _strip_peaks(frame, slice(top, min(top + PEAK_ROWS, frame.shape[0])), pad, kernel, lowest * squared, width)
        for top in range(0, frame.shape[0], PEAK_ROWS)
    ]
    pixels, height, offset, level = (np.concatenate(part) for part in zip(*strips, strict=True))
    chosen = np.argsort(-height, kind="stable")[:most]
    peaks, start, surround = pixels[chosen], (pixels + offset)[chosen], level[chosen]
    blobs = _saturated_blobs(frame.dead, margin)
    if known is not None:
        # Peaks on a known star are the PSF's misfit.
        away = cKDTree(known).query(start)[0] > OWN_RESIDUE_SIGMAS * sigma
        peaks, start, surround = peaks[away], start[away], surround[away]
        blobs = np.concatenate([known, blobs])
    noise = frame.noise[peaks[:, 1], peaks[:, 0]].astype(np.float64)
    return Peaks(
        centres=np.concatenate([nearest_pixels(blobs, frame.shape, margin), peaks]),
        start_xy_px=np.concatenate([blobs, start]),
        surround=np.concatenate([np.zeros(len(blobs)), surround * noise]),
        own_part=min(float(1.0 / squared**2) / width**2, 0.5),
    )


def nearest_pixels(xy_px: Array, shape: tuple[int, int], margin: int) -> Ints:
    """The pixels (n, 2) nearest to positions (n, 2) that lie `margin` inside a frame of this shape (H, W)."""
    return np.clip(np.rint(xy_px).astype(np.int64), margin, np.array([shape[1], shape[0]]) - 1 - margin)


def bright_pixels(frame: Frame, lowest: float, most: int, margin: int) -> Ints:
    """Pixels (n, 2) brighter than `lowest` sigma and than their neighbours: the highest, `margin` (1 or more) inside.

    Hot pixels, none of whose neighbours is bright too, are left out.
    """
    height, width = frame.shape
    found, level = [], []
    for top in range(margin, height - margin, PEAK_ROWS):
        rows = slice(top, min(top + PEAK_ROWS, height - margin))
        limit = cv2.scaleAdd(frame.noise[rows], lowest, frame.background[rows])
        row, column = np.divmod(np.flatnonzero(frame.image[rows] > limit), width)
        inside = (column >= margin) & (column < width - margin)
        pixels = np.stack([column, row + top], axis=1)[inside]
        light = frame.data(pixels, 1) / frame.noise[pixels[:, 1], pixels[:, 0], None, None]
        own = light[:, 1, 1]
        highest = (own[:, None, None] >= light).all(axis=(1, 2))
        beside = np.maximum(light[:, 1, ::2].max(axis=1), light[:, ::2, 1].max(axis=1))
        highest &= beside > np.float32(ONE_PIXEL_FRACTION) * own
        found.append(pixels[highest])
        level.append(own[highest])
    pixels = np.concatenate(found) if found else np.zeros((0, 2), dtype=np.int64)
    if not len(pixels):
        return pixels
    if frame.dead is not None:
        alive = ~frame.dead[pixels[:, 1], pixels[:, 0]]
        pixels, level = pixels[alive], [np.concatenate(level)[alive]]
    return pixels[np.argsort(-np.concatenate(level), kind="stable")[:most]]


def _strip_peaks(
    frame: Frame, rows: slice, pad: int, kernel: Image, lowest: float, width: int
) -> tuple[Ints, Array, Array, Array]:
    """Peaks of some rows: pixels (n, 2), heights, offsets (n, 2) of the tops [px], levels of the surroundings [sigma].

    Strip by strip everything stays in the processor's cache.
    """
    first = max(rows.start - pad, 0)
    standardised = frame.standardise(slice(first, rows.stop + pad))
    level = local_level(standardised, width)
    above = cv2.subtract(standardised, level, dst=standardised)
    filtered = cv2.sepFilter2D(above, -1, kernel, kernel, borderType=cv2.BORDER_REFLECT)
    own = filtered[rows.start - first : rows.stop - first]
    row, column = np.divmod(np.flatnonzero(own > np.float32(lowest)), own.shape[1])
    row += rows.start
    (height, right), margin = frame.shape, len(kernel) // 2 + 1
    good = (row >= margin) & (row < height - margin) & (column >= margin) & (column < right - margin)
    if frame.dead is not None:
        good &= ~frame.dead[row, column]
    row -= first
    _require_highest(filtered, row, column, good)
    row, column = row[good], column[good]
    offset = _parabola(filtered, row, column)
    pixels = np.stack([column, row + first], axis=1).astype(np.int64)
    return pixels, filtered[row, column].astype(np.float64), offset, level[row, column].astype(np.float64)


@njit(cache=True, nogil=True)
def _require_highest(image, row, column, good):  # type: ignore[no-untyped-def]
    """Clear those of good (n,) whose pixel any of its eight neighbours exceeds."""
    for k in range(len(good)):
        if good[k]:
            y, x = row[k], column[k]
            for i in range(y - 1, y + 2):
                for j in range(x - 1, x + 2):
                    good[k] = good[k] and image[y, x] >= image[i, j]


def _parabola(filtered: Any, y: Ints, x: Ints) -> Array:
    """Offsets (n, 2) [px] of the top of parabolas through the peaks and their neighbours in x and in y."""
    offset = np.zeros((len(x), 2))
    middle = filtered[y, x]
    neighbours = ((filtered[y, x - 1], filtered[y, x + 1]), (filtered[y - 1, x], filtered[y + 1, x]))
    for axis, (low, high) in enumerate(neighbours):
        bend = low - 2 * middle + high
        offset[:, axis] = np.divide(0.5 * (low - high), bend, out=np.zeros_like(bend), where=bend < 0)
    return np.clip(offset, -0.5, 0.5)


def _saturated_blobs(dead: NDArray[np.bool_] | None, margin: int) -> Array:
    """Middles (n, 2) [px] of the saturated blobs: bright stars whose own peak is a plateau."""
    if dead is None:
        return np.zeros((0, 2))
    height, width = dead.shape
    row, column = np.divmod(np.flatnonzero(dead), width)
    if not len(row):
        return np.zeros((0, 2))
    if len(row) > MAX_DEAD_GROUPED_PX:  # large areas: the whole mask
        count, labels, _, _ = cv2.connectedComponentsWithStats(dead.astype(np.uint8))
        label = labels[row, column].astype(np.int64) - 1
        count -= 1
    else:
        count, label = _group_touching(row, column)
    area = np.bincount(label, minlength=count)
    middle = np.stack([np.bincount(label, q, count) / np.maximum(area, 1) for q in (column, row)], axis=1)
    inside = (middle >= margin).all(axis=1) & (middle[:, 0] < width - margin) & (middle[:, 1] < height - margin)
    good = np.flatnonzero(inside & (area <= (2 * margin + 1) ** 2))
    chosen = good[np.argsort(-area[good], kind="stable")[:MAX_BLOBS]]
    return np.asarray(middle[chosen], dtype=np.float64)


def _group_touching(row: Ints, column: Ints) -> tuple[int, Ints]:
    """Number of groups of touching pixels (corners count) among a few, and the group (n,) of each pixel."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    pixels = np.stack([row, column], axis=1)
    i, j = cKDTree(pixels).query_pairs(1.5, output_type="ndarray").T
    graph = coo_matrix((np.ones(len(i), dtype=np.int8), (i, j)), shape=(len(pixels), len(pixels)))
    count, label = connected_components(graph, directed=False)
    return int(count), label.astype(np.int64)
