"""Photon transfer: the variance of the difference of two frames grows with their light by one over the gain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.types import Array, Exposure

BLOCK_PX = 32
GOOD_1 = 0.1  # relative error of the gain that is still a measurement
FEWEST_BLOCKS = 60
CLIP_SIGMA = 3.0
CLIPS = 8
CORE_SIGMA = 2.0
CORE_VARIANCE_1 = 0.773741  # of a Gaussian cut off there: 1 - 2 c phi(c) / (2 Phi(c) - 1)


@dataclass(frozen=True)
class Transfer:
    """Variance [ADU^2] of one pixel = level / gain + offset."""

    gain_e_per_adu: float
    gain_sigma: float
    offset_adu2: float

    def read_noise_e(self, bias_adu: float) -> float | None:
        """Noise without light [e]; None where the line passes below zero at the bias."""
        squared = self.gain_e_per_adu**2 * (self.offset_adu2 + bias_adu / self.gain_e_per_adu)
        return float(np.sqrt(squared)) if squared > 0 else None


def photon_transfer(pairs: list[tuple[Exposure, Exposure]]) -> Transfer | None:
    """Gain from pairs of frames; None where there is no pair or too little range of light.

    Where the sky has moved between the two, faint stars below the detection limit add to the variance: by some per
    cent in deep wide-field frames, and the gain comes out as much too low.
    """
    levels, variances = [], []
    for a, b in pairs:
        level, variance = _blocks(a.pixels_adu.astype(np.float64), b.pixels_adu.astype(np.float64))
        levels.append(level)
        variances.append(variance)
    if not levels:
        return None
    level, variance = np.concatenate(levels), np.concatenate(variances)
    good = variance > 0
    return _line(level[good], variance[good]) if good.sum() >= FEWEST_BLOCKS else None


def _blocks(a: Array, b: Array) -> tuple[Array, Array]:
    """Mean level (n,) of one frame [ADU] and mean variance (n,) of one pixel [ADU^2], block by block.

    Differences of neighbours in the difference of the frames: neither the sky's slope nor the pixels' own sensitivity
    is in them, and medians do not see the stars.
    """
    height, width = (n // BLOCK_PX * BLOCK_PX for n in a.shape)

    def cut(image: Array) -> Array:
        rows = image[:height, :width].reshape(height // BLOCK_PX, BLOCK_PX, width // BLOCK_PX, BLOCK_PX)
        return rows.transpose(0, 2, 1, 3).reshape(-1, BLOCK_PX, BLOCK_PX)

    step = np.diff(cut(a - b), axis=2).reshape(-1, BLOCK_PX * (BLOCK_PX - 1))
    step -= np.median(step, axis=1, keepdims=True)
    variance = np.square(1.4826 * np.median(np.abs(step), axis=1))
    for _ in range(CLIPS):  # towards the core: what stars add lies outside
        core = np.square(step) < CORE_SIGMA**2 * variance[:, None]
        variance = np.sum(np.square(step) * core, axis=1) / np.maximum(core.sum(axis=1), 1) / CORE_VARIANCE_1
    level = 0.5 * np.median(cut(a) + cut(b), axis=(1, 2))
    return level, variance / 4.0


def _line(level: Array, variance: Array) -> Transfer | None:
    """Robust straight line through the blocks."""
    weight = np.ones(len(level))
    for _ in range(12):
        design = np.stack([level, np.ones_like(level)], axis=1)
        normal = design.T @ (weight[:, None] * design)
        slope, offset = np.linalg.solve(normal + 1e-12 * np.trace(normal) * np.eye(2), design.T @ (weight * variance))
        fitted = np.maximum(slope * level + offset, 1e-3 * np.median(variance))
        relative = (variance - fitted) / fitted
        spread = max(1.4826 * float(np.median(np.abs(relative))), 1e-6)
        weight = np.where(np.abs(relative) < CLIP_SIGMA * spread, 1.0 / (fitted * spread) ** 2, 0.0)
        if np.count_nonzero(weight) < FEWEST_BLOCKS:
            return None
    error = float(np.sqrt(np.linalg.inv(design.T @ (weight[:, None] * design))[0, 0]))
    if slope <= 0 or error > GOOD_1 * slope:
        return None
    return Transfer(float(1.0 / slope), float(error / slope**2), float(offset))
