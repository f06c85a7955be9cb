"""Frames whose stars are streaks: detection of such frames, and the middles of the streaks."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from startrack.core.limits import check_time
from startrack.core.types import Array, Bools, Ints
from startrack.core.values import Rows, array
from startrack.detection.background import CLIPPED_SIGMA
from startrack.detection.fit import BRIGHT_STAR_SNR
from startrack.detection.frame import LIGHT_AND_NOISE, Frame
from startrack.detection.psf_width import MAX_BRIGHT_SOURCES
from startrack.kernels.library import kernel

SMOOTH_PX = 1.0
MIN_AREA_PX, MAX_AREA_PX = 12, 20_000
MIN_STREAKS = 6  # streaks of similar direction and length
LONG_PX, SLENDER = 4.5, 2.5  # shortest streak, and its length over its width
SAME_DIRECTION, SAME_LENGTH = np.cos(np.radians(15.0)), 0.3
ELONGATION_RADIUS_PX, ELONGATION_SIGMAS = 7, 4.0
ELONGATION = 2.2  # variance along a source [px^2], and over that across it
IN_LINE_FRACTION = 0.45
STREAKED_FRACTION = 0.6  # of the bright blobs


@dataclass(frozen=True, kw_only=True)
class Streaks(Rows):
    """Streaks, brightest first."""

    xy_px: Array = array("n", 2)  # centroids
    covariance_px2: Array = array("n", 2, 2)
    flux: Array = array("n")
    flux_sigma: Array = array("n")
    length_px: float  # typical
    width_px: float  # typical standard deviation across

    @property
    def psf_sigma_px(self) -> float:
        """Standard deviation of the whole streak, the typical one."""
        return float(np.hypot(self.width_px, self.length_px / np.sqrt(12.0)))


def are_elongated(frame: Frame, centres: Ints) -> bool:
    """Whether the highest peaks (n, 2) are parts of elongated sources: a quick test."""
    height, width = frame.shape
    margin = np.minimum(centres, np.array([width, height]) - 1 - centres).min(axis=1)
    centres = centres[margin >= ELONGATION_RADIUS_PX][:MAX_BRIGHT_SOURCES]
    if len(centres) < MIN_STREAKS:
        return False
    signal, variance = frame.cut_light(centres, ELONGATION_RADIUS_PX)
    signal = np.where(signal > ELONGATION_SIGMAS * np.sqrt(variance), signal, np.float32(0.0))
    offset = np.arange(-ELONGATION_RADIUS_PX, ELONGATION_RADIUS_PX + 1, dtype=np.float32)
    x, y = (q.ravel() for q in np.meshgrid(offset, offset))
    total, xx, xy, yy = (signal.reshape(len(signal), -1) @ np.stack([np.ones_like(x), x * x, x * y, y * y], axis=1)).T
    xx, xy, yy = (q / np.maximum(total, 1e-9) for q in (xx, xy, yy))
    trace, spread = xx + yy, np.hypot(xx - yy, 2.0 * xy)
    long = (trace + spread) > ELONGATION * (trace - spread + 0.2)
    return bool(np.mean(long & (trace + spread > 2.0 * ELONGATION)) > 0.5)


def find_streaks(frame: Frame) -> Streaks | None:
    """The frame's streaks if most of its bright sources are streaks similar to their neighbours; else None.

    The centroid of a streak is the star's position at mid-exposure if rotation and transparency were constant; a
    hundredth of the length is added to its error for variations. Particle tracks have random directions and lengths,
    and are rejected.
    """
    check_time()
    height, width = frame.shape
    whole = np.empty(frame.shape, np.float32)
    _fill_residuals(*frame.light_and_noise, whole)
    if frame.dead is not None:
        whole = np.where(frame.dead, np.float32(50.0), whole)
    smooth = cv2.GaussianBlur(whole, (0, 0), SMOOTH_PX)
    quiet = 1.0 / np.sqrt(4.0 * np.pi * SMOOTH_PX**2)
    mask = (smooth > CLIPPED_SIGMA * 2.0 * quiet).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask)
    left, top, wide, high, area = stats.T
    off_border = (left > 1) & (top > 1) & (left + wide < width - 1) & (top + high < height - 1)
    rows, columns = np.nonzero(cv2.dilate(mask, np.ones((3, 3), np.uint8)))
    label = cv2.dilate(labels.astype(np.float32), np.ones((3, 3), np.uint8))[rows, columns].astype(np.int64)
    signal = (frame.image[rows, columns] - frame.background.at(rows, columns)).astype(np.float64)
    variance = np.square(frame.noise.at(rows, columns).astype(np.float64))
    variance += frame.source_noise.per_unit * np.maximum(signal, 0.0)
    check_time()
    blobs = _moments(label, np.stack([columns, rows], axis=1).astype(np.float64), signal, variance, count)
    flux, flux_sigma, xy, spread, covariance = blobs
    bright = (area >= MIN_AREA_PX) & (area <= MAX_AREA_PX) & off_border & (flux > BRIGHT_STAR_SNR * flux_sigma)
    bright[0] = False
    which = np.flatnonzero(bright)
    if len(which) < MIN_STREAKS:
        return None
    values, vectors = np.linalg.eigh(spread[which])
    length = np.sqrt(12.0 * np.maximum(values[:, 1] - values[:, 0], 0.0))
    across = np.sqrt(np.maximum(values[:, 0], 0.1))
    streaked = (length > LONG_PX) & (length > SLENDER * across)
    if streaked.sum() < MIN_STREAKS or streaked.mean() < STREAKED_FRACTION:
        return None
    which, length, across, along = which[streaked], length[streaked], across[streaked], vectors[streaked][:, :, 1]
    alike = _resemble_neighbours(xy[which], along, length)
    if alike.sum() < MIN_STREAKS or alike.mean() < STREAKED_FRACTION:
        return None
    which, length, across = which[alike], length[alike], across[alike]
    order = np.argsort(-flux[which], kind="stable")
    which, length = which[order], length[order]
    uneven = np.einsum("ni,nj->nij", along[alike][order], along[alike][order]) * np.square(0.01 * length)[:, None, None]
    return Streaks(
        xy_px=xy[which], covariance_px2=covariance[which] + uneven, flux=flux[which], flux_sigma=flux_sigma[which],
        length_px=float(np.median(length)), width_px=float(np.median(across)),
    )  # fmt: skip


def _moments(label: Ints, xy: Array, signal: Array, variance: Array, count: int) -> tuple[Array, ...]:
    """Flux (count,), its sigma, middle (count, 2), second moments (count, 2, 2), covariance of the middle."""

    def sum_by_label(values: Array) -> Array:
        return np.bincount(label, values, count).astype(np.float64)

    flux = np.maximum(sum_by_label(signal), 1e-9)
    middle = np.stack([sum_by_label(signal * xy[:, 0]), sum_by_label(signal * xy[:, 1])], axis=1) / flux[:, None]
    off = xy - middle[label]
    spread, covariance = np.empty((count, 2, 2)), np.empty((count, 2, 2))
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
        spread[:, i, j] = sum_by_label(signal * off[:, i] * off[:, j]) / flux
        covariance[:, i, j] = sum_by_label(variance * off[:, i] * off[:, j]) / flux**2
    covariance += 1e-4 * np.eye(2)  # 0.01 px for the edges of the mask
    return flux, np.sqrt(np.maximum(sum_by_label(variance), 1e-12)), middle, spread, covariance


def _resemble_neighbours(xy: Array, along: Array, length: Array) -> Bools:
    """Whether streaks (n,) have the direction and length of one of the three nearest others."""
    from scipy.spatial import cKDTree

    _, near = cKDTree(xy).query(xy, k=min(4, len(xy)))
    off = xy[near[:, 1:]] - xy[:, None]
    off /= np.maximum(np.linalg.norm(off, axis=-1, keepdims=True), 1e-9)
    # Parts of one long edge lie in line with their direction; neighbouring stars do so in one of six cases.
    in_line = np.abs(np.einsum("ni,nki->nk", along, off)) > SAME_DIRECTION
    if in_line[:, 0].mean() > IN_LINE_FRACTION:
        return np.zeros(len(xy), dtype=bool)
    parallel = np.abs(np.einsum("ni,nki->nk", along, along[near[:, 1:]])) > SAME_DIRECTION
    as_long = np.abs(np.log(length[near[:, 1:]] / length[:, None])) < SAME_LENGTH
    return np.asarray((parallel & as_long).any(axis=1))


_fill_residuals = kernel("fill_residuals", *LIGHT_AND_NOISE, "residuals: out float32[height, width]")
