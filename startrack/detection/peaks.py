"""Candidates for point sources: peaks of the matched filter, saturated blobs, and bright blobs of any shape."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from startrack.core.types import Array, Bools, Detections, Image, Ints, Rows, array
from startrack.detection.background import BLOCK_PX, CLIPPED_SIGMA
from startrack.detection.frame import LIGHT_AND_NOISE, Frame, lie_inside, radius_for
from startrack.kernels.library import kernel
from startrack.psf import filter_kernel

HEIGHT_1 = 0.5  # of the frame's highest light above the background, which the pixels of a blob exceed
SURROUND_1 = HEIGHT_1 / 2  # of it: more light than that around a blob is glare, lit ground or a wall
LOOKS = 16  # in which the light around a blob is looked up
RING_PX = np.array([(x, y) for y in (-1, 0, 1) for x in (-1, 0, 1) if x or y])
COARSE_PX = BLOCK_PX // 4  # the local level is a mean over squares of this side
TAPS, WORD_PX = 4, 64  # taps on one side of the filter, and pixels of a row, that the kernel takes together
PIXELS_PER_PEAK = 64  # room for peaks: more of them are looked for again
ONE_TAP = np.ones(1, dtype=np.float32)
MAX_STAMP_PIXELS = 2_500_000  # of all candidates together: bounds time and memory, for any content of the frame
MAX_BLOBS = 1000  # saturated; the largest
OWN_RESIDUE_SIGMAS = 1.5
ONE_PIXEL_FRACTION = 0.15  # of a peak's light beside it; a star of 0.45 px has 0.18
SIDES_PX, EDGE_FRACTION = 3, 0.5  # off a peak; by how much more of its light one side may have than another


@dataclass(frozen=True, kw_only=True)
class Blobs(Rows):
    """Groups of touching bright pixels."""

    xy_px: Array = array("n", 2)  # middle of the light
    light_e: Array = array("n")  # as of `light_at`
    saturated: Bools = array("n", dtype=np.bool_)  # one of the pixels is
    compact: Bools = array("n", dtype=np.bool_)  # dark around, as a star; more than a hot pixel
    pixels: Ints = array("m", 2, dtype=np.int64)  # (x, y) of all pixels of all blobs
    blob: Ints = array("m", dtype=np.int64)  # of each of them


def find_blobs(sources: Detections) -> Blobs:
    """Groups of touching pixels, saturated or brighter than HEIGHT_1 of the highest light in the frame of `sources`."""
    image, dead, background = sources.image_e, sources.dead, sources.background
    masked = np.zeros_like(dead) if sources.mask is None else sources.mask.masked
    top, lowest = float(image.max()), float(background.rows.min())
    row, column = np.divmod(np.flatnonzero(image > lowest + HEIGHT_1 * (top - lowest)), image.shape[1])
    level = background.at(row, column)
    light = image[row, column] - level
    bright = (light > HEIGHT_1 * (top - level)) | dead[row, column]  # in the Moon the background is as bright
    bright &= ~masked[row, column]
    row, column, light = row[bright], column[bright], light[bright].astype(np.float64)
    pixels = np.stack([column, row], axis=-1)
    count, blob = group_touching(row, column) if len(row) else (0, np.zeros(0, dtype=np.int64))
    total = np.bincount(blob, light, count)
    xy_px = np.stack([np.bincount(blob, light * at, count) / total for at in (column, row)], axis=-1)
    reach_px = np.zeros(count)
    np.maximum.at(reach_px, blob, np.hypot(*(pixels - xy_px[blob]).T))
    saturated = np.zeros(count, dtype=bool)
    saturated[blob[dead[row, column]]] = True
    return Blobs(
        xy_px=xy_px, light_e=light_at(sources, xy_px), saturated=saturated,
        compact=_are_compact(sources, xy_px, reach_px, top), pixels=pixels, blob=blob,
    )  # fmt: skip


def light_at(sources: Detections, xy_px: Array) -> Array:
    """Light (n,) above the background in the disc about each of `xy_px` (n, 2), as the image of `sources` has it.

    It grows with a star's brightness, saturated or not.
    """
    return np.asarray(_light(sources, np.rint(xy_px)[:, None] + disc_px(sources)).sum(axis=1), dtype=np.float64)


def disc_px(sources: Detections) -> Array:
    """Offsets (n, 2) of the pixels of a disc as wide as the fits of the `sources`."""
    radius = radius_for(sources.psf_sigma_px)
    offset = np.stack(np.meshgrid(*2 * [np.arange(-radius, radius + 1.0)]), axis=-1).reshape(-1, 2)
    return np.asarray(offset[np.hypot(*offset.T) <= radius])


def _are_compact(sources: Detections, xy_px: Array, reach_px: Array, top: float) -> Bools:
    """Whether blobs (n,) that reach `reach_px` (n,) from their middles are dark around, and no hot pixels."""
    turn = np.arange(LOOKS) * 2 * np.pi / LOOKS
    around_px = (reach_px + radius_for(sources.psf_sigma_px))[:, None, None] * np.stack(
        [np.cos(turn), np.sin(turn)], -1
    )
    middle = np.rint(xy_px)
    around = np.median(_light(sources, np.rint(xy_px[:, None] + around_px)), axis=1)
    above = _light(sources, middle[:, None])[:, 0]
    beside = _light(sources, middle[:, None] + RING_PX).mean(axis=1)
    level = sources.background.at(*_indices(sources, middle)[::-1])
    return np.asarray((around < SURROUND_1 * (top - level)) & (beside > ONE_PIXEL_FRACTION * above))


def _light(sources: Detections, pixels: Array) -> Array:
    """Light (...) above the background in pixels (..., 2) (x, y), those beyond the border at the border."""
    x, y = _indices(sources, pixels)
    return np.asarray(sources.image_e[y, x] - sources.background.at(y, x))


def _indices(sources: Detections, pixels: Array) -> tuple[Ints, Ints]:
    """Columns and rows (...) of pixels (..., 2) (x, y), those beyond the border at the border."""
    height, width = sources.image_e.shape
    x, y = np.clip(pixels, 0, (width - 1, height - 1)).astype(np.int64).transpose(-1, *range(pixels.ndim - 1))
    return x, y


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
    total = kernel.sum(dtype=np.float64) ** 2
    beside = _squares_beside(6 * margin + 1)
    pixels, height, offset, level = _peaks_above(frame, lowest * squared, kernel, beside, total)
    chosen = np.argsort(-height, kind="stable")[:most]
    peaks, start = pixels[chosen], (pixels + offset)[chosen]
    column, row = peaks.T
    surround = level[chosen] / total * frame.noise.at(row, column)
    blobs = _saturated_blobs(frame.dead, margin)
    if known is not None:
        # Peaks on a known star are the PSF's misfit.
        away = cKDTree(known).query(start)[0] > OWN_RESIDUE_SIGMAS * sigma
        peaks, start, surround = peaks[away], start[away], surround[away]
        blobs = np.concatenate([known, blobs])
    return Peaks(
        centres=np.concatenate([nearest_pixels(blobs, frame.shape, margin), peaks]),
        start_xy_px=np.concatenate([blobs, start]),
        surround=np.concatenate([np.zeros(len(blobs)), surround]),
        own_part=min(float(1.0 / squared**2) / (COARSE_PX * (2 * beside + 1)) ** 2, 0.5),
    )


def nearest_pixels(xy_px: Array | Ints, shape: tuple[int, int], margin: int) -> Ints:
    """The pixels (n, 2) nearest to positions (n, 2) that lie `margin` inside a frame of this shape (H, W).

    The frame has such pixels, or there are no positions.
    """
    return np.clip(np.rint(xy_px).astype(np.int64), margin, np.array([shape[1], shape[0]]) - 1 - margin)


def bright_pixels(frame: Frame, lowest: float, most: int) -> Ints:
    """Pixels (n, 2) brighter than `lowest` sigma and than their neighbours: the highest, none near the border.

    Left out are hot pixels, none of whose neighbours is bright too, and peaks at the edge of a bright sky, on one side
    of which there is more light than on another.
    """
    pixels, height, *_ = _peaks_above(frame, lowest, ONE_TAP)
    r = SIDES_PX
    inside = lie_inside(pixels, frame.shape, r)
    pixels, height = pixels[inside], height[inside]
    light, _ = frame.cut_light(pixels, r)
    peak, sides = light[:, r, r], [light[:, :: 2 * r].mean(axis=2), light[:, :, :: 2 * r].mean(axis=1)]
    beside = np.maximum(light[:, r, r - 1 : r + 2 : 2].max(axis=1), light[:, r - 1 : r + 2 : 2, r].max(axis=1))
    is_star = beside > np.float32(ONE_PIXEL_FRACTION) * peak
    is_star &= np.ptp(np.concatenate(sides, axis=1), axis=1) < np.float32(EDGE_FRACTION) * peak
    return pixels[is_star][np.argsort(-height[is_star], kind="stable")[:most]]


def _squares_beside(width_px: int) -> int:
    """Squares of COARSE_PX on each side of the middle one of a box whose width is nearest to one [px].

    Whole squares cost a third of the time and no more than their coarseness.
    """
    return max(int(round(width_px / COARSE_PX - 1) // 2), 0)


def _peaks_above(
    frame: Frame, lowest: float, kernel: Image, beside: int = 0, level_factor: float = 0.0
) -> tuple[Ints, Image, Image, Image]:
    """Local maxima above `lowest` of the residuals, filtered by a `kernel` in x and in y, less a level by a factor.

    The level is the background that block medians miss, in units of the noise: the mean over a box of squares, so many
    `beside` the middle one. Returns pixels (n, 2), heights, the offsets (n, 2) [px] of the tops of parabolas through
    their neighbours, and the level (n,) times the factor. Those that need light from beyond the border are left out.
    """
    (height, width), radius = frame.shape, len(kernel) // 2
    reach = -(-radius // TAPS) * TAPS
    taps = np.zeros(reach + 1, np.float32)
    taps[: radius + 1] = kernel[radius:]
    lag = max(reach, COARSE_PX * (beside + 2) if level_factor else 0)
    squares, columns = -(-height // COARSE_PX), -(-width // COARSE_PX)
    longest = max(width + 2 * reach, columns * COARSE_PX, columns + 2 * beside)
    stride = -(-longest // WORD_PX) * WORD_PX
    scratch = np.empty((lag + 2 * reach + 11, stride), np.float32), np.empty((squares, columns), np.float32)
    dead = np.zeros((0, width), np.bool_) if frame.dead is None else frame.dead
    room = count = height * width // PIXELS_PER_PEAK
    while count >= room:
        room = count + 1
        pixels, values = np.empty((room, 2), np.int64), np.empty((room, 4), np.float32)
        count = _find_maxima(
            *frame.light_and_noise, taps, COARSE_PX, beside, CLIPPED_SIGMA, level_factor, lowest, dead, radius + 1,
            *scratch, pixels, values,
        )  # fmt: skip
    return pixels[:count], values[:count, 0], values[:count, 1:3], values[:count, 3]


def _saturated_blobs(dead: NDArray[np.bool_] | None, margin: int) -> Array:
    """Middles (n, 2) [px] of the saturated blobs: bright stars whose own peak is a plateau."""
    if dead is None:
        return np.zeros((0, 2))
    height, width = dead.shape
    row, column = np.divmod(np.flatnonzero(dead), width)
    if not len(row):
        return np.zeros((0, 2))
    count, label = group_touching(row, column)
    area = np.bincount(label, minlength=count)
    middle = np.stack([np.bincount(label, q, count) / np.maximum(area, 1) for q in (column, row)], axis=1)
    inside = (middle >= margin).all(axis=1) & (middle[:, 0] < width - margin) & (middle[:, 1] < height - margin)
    good = np.flatnonzero(inside & (area <= (2 * margin + 1) ** 2))
    chosen = good[np.argsort(-area[good], kind="stable")[:MAX_BLOBS]]
    return np.asarray(middle[chosen], dtype=np.float64)


def group_touching(row: Ints, column: Ints) -> tuple[int, Ints]:
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


_find_maxima = kernel(
    "find_maxima", *LIGHT_AND_NOISE, "taps: float32[reach + 1]", "coarse: int64", "beside: int64", "clipped: float32",
    "level_factor: float32", "lowest: float32", "dead: bool[dead_rows, width]", "margin: int64",
    "rows: out float32[count, stride]", "means: out float32[squares >= 1, columns >= 1]", "pixels: out int64[room, 2]",
    "values: out float32[room, 4]", result="int64",
)  # fmt: skip
