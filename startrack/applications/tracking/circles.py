"""Circles that hold a part of a Gaussian in two dimensions."""

from __future__ import annotations

import numpy as np

from startrack.core.types import Array

DIRECTIONS = 256  # over half a turn
STEPS = 60  # of bisection: to the last digit


def radius_holding(covariance_m2: Array, probability: float) -> Array:
    """Radii (n,) [m] of the circles that hold a `probability` of Gaussians with covariances (n, 2, 2).

    In polar coordinates the part within r is 1 - mean over directions u of exp(-r^2 / (2 |L u|^2)), with L L^T the
    covariance and u uniform in the plane where the Gaussian is round. Infinite where the covariance is.
    """
    known = np.isfinite(covariance_m2).all(axis=(1, 2))
    radius = np.full(len(covariance_m2), np.inf)
    variance = np.linalg.eigvalsh(covariance_m2[known])
    angle = np.pi * (np.arange(DIRECTIONS) + 0.5) / DIRECTIONS
    along = np.maximum(variance[:, :1] * np.cos(angle) ** 2 + variance[:, 1:] * np.sin(angle) ** 2, 1e-300)
    low, high = np.zeros(len(variance)), np.sqrt(-2.0 * np.log(1.0 - probability) * np.maximum(variance[:, 1], 1e-300))
    for _ in range(STEPS):
        middle = 0.5 * (low + high)
        inside = 1.0 - np.exp(-0.5 * np.square(middle)[:, None] / along).mean(axis=1)
        low, high = np.where(inside < probability, middle, low), np.where(inside < probability, high, middle)
    radius[known] = high
    return radius
