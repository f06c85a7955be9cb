"""Gain by photon transfer: the variance of the difference of two frames grows with their level by one over the gain.

Source: Janesick 2007, Photon Transfer, SPIE Press.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.core.types import Array, Exposure

BLOCK_PX = 32
LARGEST_GAIN_ERROR_1 = 0.1  # relative
MIN_BLOCKS = 60
CLIP_SIGMA = 3.0
CLIPS = 8
CORE_SIGMA = 2.0
CORE_VARIANCE_1 = 0.773741  # of a Gaussian truncated there: 1 - 2 c phi(c) / (2 Phi(c) - 1)


@dataclass(frozen=True)
class PhotonTransfer:
    """Line of the photon transfer: variance [ADU^2] of one pixel = level / gain + offset."""

    gain_e_per_adu: float
    gain_sigma: float
    offset_adu2: float

    def read_noise_e(self, bias_adu: float) -> float | None:
        """Read noise [e]; None where the line is negative at the bias."""
        squared = self.gain_e_per_adu**2 * (self.offset_adu2 + bias_adu / self.gain_e_per_adu)
        return float(np.sqrt(squared)) if squared > 0 else None


def fit_photon_transfer(pairs: list[tuple[Exposure, Exposure]]) -> PhotonTransfer | None:
    """Photon transfer of pairs of frames; None without a pair, or with too small a range of levels.

    From the counts as recorded: after a flat field, variance and level would differ by its sensitivity.

    Where the sky has moved between the two frames, stars below the detection limit add to the variance, by some per
    cent in deep wide-field frames; the gain is then as much too low.
    """
    levels, variances = [], []
    for a, b in pairs:
        level, variance = _block_statistics(a.recorded_adu.astype(np.float64), b.recorded_adu.astype(np.float64))
        levels.append(level)
        variances.append(variance)
    if not levels:
        return None
    level, variance = np.concatenate(levels), np.concatenate(variances)
    good = variance > 0
    return _fit_line(level[good], variance[good]) if good.sum() >= MIN_BLOCKS else None


def _block_statistics(a: Array, b: Array) -> tuple[Array, Array]:
    """Median level (n,) of one frame [ADU] and variance (n,) of one pixel [ADU^2], block by block.

    The variance is that of differences between neighbouring pixels in the difference of the frames, which the slope of
    the sky and the sensitivities of the pixels do not affect; clipping excludes the stars.
    """
    height, width = (n // BLOCK_PX * BLOCK_PX for n in a.shape)

    def split_blocks(image: Array) -> Array:
        rows = image[:height, :width].reshape(height // BLOCK_PX, BLOCK_PX, width // BLOCK_PX, BLOCK_PX)
        return rows.transpose(0, 2, 1, 3).reshape(-1, BLOCK_PX, BLOCK_PX)

    step = np.diff(split_blocks(a - b), axis=2).reshape(-1, BLOCK_PX * (BLOCK_PX - 1))
    step -= np.median(step, axis=1, keepdims=True)
    variance = np.square(1.4826 * np.median(np.abs(step), axis=1))
    for _ in range(CLIPS):  # clipped to the core of the distribution, without stars
        core = np.square(step) < CORE_SIGMA**2 * variance[:, None]
        variance = np.sum(np.square(step) * core, axis=1) / np.maximum(core.sum(axis=1), 1) / CORE_VARIANCE_1
    level = 0.5 * np.median(split_blocks(a) + split_blocks(b), axis=(1, 2))
    return level, variance / 4.0


def _fit_line(level: Array, variance: Array) -> PhotonTransfer | None:
    """Robust straight line of variance over level (n,)."""
    weight = np.ones(len(level))
    for _ in range(12):
        design = np.stack([level, np.ones_like(level)], axis=1)
        normal = design.T @ (weight[:, None] * design)
        slope, offset = np.linalg.solve(normal + 1e-12 * np.trace(normal) * np.eye(2), design.T @ (weight * variance))
        fitted = np.maximum(slope * level + offset, 1e-3 * np.median(variance))
        relative = (variance - fitted) / fitted
        spread = max(1.4826 * float(np.median(np.abs(relative))), 1e-6)
        weight = np.where(np.abs(relative) < CLIP_SIGMA * spread, 1.0 / (fitted * spread) ** 2, 0.0)
        if np.count_nonzero(weight) < MIN_BLOCKS:
            return None
    error = float(np.sqrt(np.linalg.inv(design.T @ (weight[:, None] * design))[0, 0]))
    if slope <= 0 or error > LARGEST_GAIN_ERROR_1 * slope:
        return None
    return PhotonTransfer(float(1.0 / slope), float(error / slope**2), float(offset))
