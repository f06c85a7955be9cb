"""Candidates for point sources: peaks of the matched filter, and the middles of saturated blobs."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from startrack.core.kernels import njit
from startrack.core.smooth_image import Image, SmoothImage
from startrack.core.types import Array, Ints
from startrack.detection.background import COARSE_PX, clipped_means, coarse_width, smooth_level
from startrack.detection.frame import Frame, radius_for, rows_at_a_time
from startrack.psf import filter_kernel

NO_PIXELS = np.zeros((0, 0), dtype=np.bool_)
MAX_STAMP_PIXELS = 2_500_000  # of all candidates together: bounds time and memory, for any content of the frame
MAX_BLOBS = 1000  # saturated; the largest
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
    level = _level_of_surroundings(frame, width)
    pixels, height, offset = _peaks_above(frame, lowest * squared, kernel, level)
    chosen = np.argsort(-height, kind="stable")[:most]
    peaks, start = pixels[chosen], (pixels + offset)[chosen]
    blobs = _saturated_blobs(frame.dead, margin)
    if known is not None:
        # Peaks on a known star are the PSF's misfit.
        away = cKDTree(known).query(start)[0] > OWN_RESIDUE_SIGMAS * sigma
        peaks, start = peaks[away], start[away]
        blobs = np.concatenate([known, blobs])
    column, row = peaks.T
    surround = level.at(row, column).astype(np.float64) * frame.noise.at(row, column)
    return Peaks(
        centres=np.concatenate([nearest_pixels(blobs, frame.shape, margin), peaks]),
        start_xy_px=np.concatenate([blobs, start]),
        surround=np.concatenate([np.zeros(len(blobs)), surround]),
        own_part=min(float(1.0 / squared**2) / width**2, 0.5),
    )


def nearest_pixels(xy_px: Array, shape: tuple[int, int], margin: int) -> Ints:
    """The pixels (n, 2) nearest to positions (n, 2) that lie `margin` inside a frame of this shape (H, W)."""
    return np.clip(np.rint(xy_px).astype(np.int64), margin, np.array([shape[1], shape[0]]) - 1 - margin)


def bright_pixels(frame: Frame, lowest: float, most: int) -> Ints:
    """Pixels (n, 2) brighter than `lowest` sigma and than their neighbours: the highest, none at the border.

    Hot pixels, none of whose neighbours is bright too, are left out.
    """
    pixels, level, _ = _peaks_above(frame, lowest)
    light, _ = frame.cut_light(pixels, 1)
    beside = np.maximum(light[:, 1, ::2].max(axis=1), light[:, ::2, 1].max(axis=1))
    pixels, level = (values[beside > np.float32(ONE_PIXEL_FRACTION) * light[:, 1, 1]] for values in (pixels, level))
    return pixels[np.argsort(-level, kind="stable")[:most]]


def _level_of_surroundings(frame: Frame, width: int) -> SmoothImage:
    """Level of the background that block medians miss, in units of the noise: the mean over boxes of a width [px]."""
    means = np.empty([-(-length // COARSE_PX) for length in frame.shape], dtype=np.float32)
    rows = rows_at_a_time(frame.shape)
    residuals = np.empty((rows, frame.shape[1]), dtype=np.float32)
    for top in range(0, frame.shape[0], rows):
        strip = residuals[: frame.shape[0] - top]
        frame.fill_residuals(strip, top)
        clipped_means(strip, means[top // COARSE_PX : -(-(top + rows) // COARSE_PX)])
    return smooth_level(means, width, frame.shape)


def _peaks_above(
    frame: Frame, lowest: float, kernel: Image | None = None, level: SmoothImage | None = None
) -> tuple[Ints, Array, Array]:
    """Local maxima above `lowest` of the residuals minus `level`, filtered by a `kernel` in x and in y.

    Returns their pixels (n, 2), heights, and the offsets (n, 2) [px] of the tops of parabolas through their neighbours.
    Those that need light from beyond the border are left out.
    """
    margin = 1 + (0 if kernel is None else len(kernel) // 2)
    (height, width), rows = frame.shape, rows_at_a_time(frame.shape)
    residuals, filtered = np.empty((2, rows + 2 * margin, width), dtype=np.float32)
    dead = NO_PIXELS if frame.dead is None else frame.dead
    found = [np.zeros((0, 5))]
    for first in range(0, height - 2 * margin, rows):
        strip = residuals[: height - first]
        frame.fill_residuals(strip, first, level)
        if kernel is not None:
            cv2.sepFilter2D(strip, -1, kernel, kernel, dst=filtered[: len(strip)])
            strip = filtered[: len(strip)]
        above = np.flatnonzero(strip[margin:-margin] > np.float32(lowest)) + margin * width
        peaks = np.empty((len(above), 5))
        found.append(peaks[: _collect_peaks(strip, above, margin, dead, first, peaks)])
    column, row, top, x, y = np.concatenate(found).T
    return np.stack([column, row], axis=1).astype(np.int64), top, np.stack([x, y], axis=1)


@njit(cache=True, nogil=True, error_model="numpy")
def _collect_peaks(image, above, margin, dead, first, peaks):  # type: ignore[no-untyped-def]
    """Fill peaks (n, 5) with column, row, height and offsets of the local maxima; return their number.

    They are looked for among the pixels `above` (n,), counted row by row, at least `margin` inside. The rows of the
    image are the frame's from `first` on.
    """
    count, width = 0, image.shape[1]
    for k in range(len(above)):
        i, j = above[k] // width, above[k] % width
        if j < margin or j >= width - margin or (len(dead) and dead[first + i, j]):
            continue
        value, highest = image[i, j], True
        for m in range(i - 1, i + 2):
            for n in range(j - 1, j + 2):
                highest = highest and value >= image[m, n]
        if highest:
            peaks[count, 0], peaks[count, 1], peaks[count, 2] = j, first + i, value
            peaks[count, 3] = _top(image[i, j - 1], value, image[i, j + 1])
            peaks[count, 4] = _top(image[i - 1, j], value, image[i + 1, j])
            count += 1
    return count


@njit(inline="always")
def _top(low, middle, high):  # type: ignore[no-untyped-def]
    """Offset [px] of the top of the parabola through three neighbours, at most half a pixel."""
    bend = low - np.float32(2.0) * middle + high
    return min(max(np.float32(0.5) * (low - high) / bend, -0.5), 0.5) if bend < 0.0 else 0.0


def _saturated_blobs(dead: NDArray[np.bool_] | None, margin: int) -> Array:
    """Middles (n, 2) [px] of the saturated blobs: bright stars whose own peak is a plateau."""
    if dead is None:
        return np.zeros((0, 2))
    height, width = dead.shape
    row, column = np.divmod(np.flatnonzero(dead), width)
    if not len(row):
        return np.zeros((0, 2))
    count, label = _group_touching(row, column)
    area = np.bincount(label, minlength=count)
    middle = np.stack([np.bincount(label, q, count) / np.maximum(area, 1) for q in (column, row)], axis=1)
    inside = (middle >= margin).all(axis=1) & (middle[:, 0] < width - margin) & (middle[:, 1] < height - margin)
    good = np.flatnonzero(inside & (area <= (2 * margin + 1) ** 2))
    chosen = good[np.argsort(-area[good], kind="stable")[:MAX_BLOBS]]
    return np.asarray(middle[chosen], dtype=np.float64)


def _group_touching(row: Ints, column: Ints) -> tuple[int, Ints]:
    """Number of groups of touching pixels (corners count), and the group (n,) of each pixel."""
    i, j = _without_gaps(row), _without_gaps(column)
    mask = np.zeros((i.max() + 1, j.max() + 1), dtype=np.uint8)
    mask[i, j] = 1
    count, labels = cv2.connectedComponents(mask)
    return count - 1, labels[i, j].astype(np.int64) - 1


def _without_gaps(at: Ints) -> Ints:
    """Indices (n,) in the same order, of which only neighbours differ by one, and none by much more."""
    kept = np.bincount(at, minlength=at.max() + 2) > 0
    kept[1:] |= kept[:-1].copy()
    return np.asarray(np.cumsum(kept)[at] - 1)
