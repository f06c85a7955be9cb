"""Bright blobs of an exposure: its brightest stars, whatever the shape of their tops, and what else is as bright."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.core.types import Array, Bools, Detections, Ints, Rows, array
from startrack.detection.frame import radius_for
from startrack.detection.peaks import ONE_PIXEL_FRACTION, group_touching

HEIGHT_1 = 0.5  # of the frame's highest light above the background, which the pixels of a blob exceed
SURROUND_1 = HEIGHT_1 / 2  # of it: more light than that around a blob is glare, lit ground or a wall
LOOKS = 16  # in which the light around a blob is looked up
RING_PX = np.array([(x, y) for y in (-1, 0, 1) for x in (-1, 0, 1) if x or y])


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
