"""All frames of a track together: generalised least squares with the errors that they share.

Given all observations, the estimates of the errors of the map's posts follow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.core.types import Array, Ints
from startrack.estimation.observations import Observations, Steps, inverse

SIGMAS_95 = float(np.sqrt(-2.0 * np.log(0.05)))  # half axes of the ellipse that holds 95 % of a Gaussian
DIRECTIONS = 256  # over half a turn
BISECTIONS = 60  # to the last digit


@dataclass(frozen=True, eq=False)
class Smoothed:
    """The estimate by all observations."""

    position_m: Array  # (n, 2)
    covariance_m2: Array  # (n, 2, 2)
    shared: Array  # (k,) in standard deviations of their priors
    shared_covariance: Array  # (k, k)
    joint_m2: Array  # (n, 2, n, 2) covariance of all positions
    step_residual_m: Array  # (n - 1, 2) of each move, where the other data predict it
    step_variance_m2: Array  # (n - 1, 2, 2) of that prediction
    frame_residual: Array  # (frames, 2 + k) of the observations used, where the others predict them
    frame_covariance: Array  # (frames, 2 + k, 2 + k) of that residual
    post: Ints  # (c,) numbers of the posts that the observations depend on
    post_error_m: Array  # (c,)
    post_sigma_m: Array  # (c,)


def smooth(observations: Observations, steps: Steps) -> Smoothed:
    """The best positions and shared errors, with their covariances. Cost: the third power of the number of frames."""
    n, known = observations.count, np.isfinite(steps.sigma_m)
    weight = np.where(known, 1.0 / np.square(np.where(known, steps.sigma_m, 1.0)), 0.0)
    information, target = observations.information.copy(), observations.target.copy()
    for axis in range(2):
        left, right = 2 * np.arange(n - 1) + axis, 2 * np.arange(n - 1) + 2 + axis
        for a, b, sign in ((left, left, 1.0), (right, right, 1.0), (left, right, -1.0), (right, left, -1.0)):
            information[a, b] += sign * weight
        np.subtract.at(target, left, weight * steps.move_m[:, axis])
        np.add.at(target, right, weight * steps.move_m[:, axis])
    covariance = inverse(information)
    best = covariance @ target
    blocks = covariance[: 2 * n, : 2 * n].reshape(n, 2, n, 2)
    frame = np.arange(n)
    residual, variance = _predicted_steps(best[: 2 * n].reshape(n, 2), blocks, steps, weight)
    pull = observations.inverse_covariance @ observations.value - observations.weighted_design @ best
    pulls, spread = _predicted_frames(observations, pull, covariance)
    error, sigma = _posts(observations, pull, covariance)
    return Smoothed(
        best[: 2 * n].reshape(n, 2), blocks[frame, :, frame], best[2 * n :], covariance[2 * n :, 2 * n :], blocks,
        residual, variance, pulls, spread, observations.posts, error, sigma,
    )  # fmt: skip


def _predicted_steps(position_m: Array, blocks: Array, steps: Steps, weight: Array) -> tuple[Array, Array]:
    """Residuals (n - 1, 2) and covariances (n - 1, 2, 2) of the moves by all data but the move itself."""
    here = np.arange(len(weight))
    covariance = blocks[here, :, here] + blocks[here + 1, :, here + 1] - blocks[here, :, here + 1]
    covariance -= blocks[here + 1, :, here]
    residual = steps.move_m - np.diff(position_m, axis=0)
    # Just less than the whole weight: a move that nothing else predicts stays invertible.
    without = np.linalg.inv(np.linalg.inv(covariance) - (1.0 - 1e-9) * weight[:, None, None] * np.eye(2))
    return np.asarray(residual + np.einsum("n,nij,nj->ni", weight, without, residual)), np.asarray(without)


def _predicted_frames(observations: Observations, pull: Array, covariance: Array) -> tuple[Array, Array]:
    """Residuals (frames, p) and their covariances (frames, p, p) of the observations by all data but each itself.

    With P = V^-1 - V^-1 A H^-1 A^T V^-1 the residual of a block is P_ii^-1 (P m)_i, and P_ii^-1 its covariance.
    """
    p, count = observations.size, len(observations.frames)
    spread = observations.weighted_design @ covariance
    residual, variance = np.empty((count, p)), np.empty((count, p, p))
    for k in range(count):
        part = slice(p * k, p * (k + 1))
        within = observations.inverse_covariance[part, part] - spread[part] @ observations.weighted_design[part].T
        variance[k] = np.linalg.pinv(within, hermitian=True)
        residual[k] = variance[k] @ pull[part]
    return residual, variance


def _posts(observations: Observations, pull: Array, covariance: Array) -> tuple[Array, Array]:
    """Errors (c,) of the posts and their standard deviations (c,) [m]."""
    G = observations.by_post
    weighted = np.asarray(G.T @ observations.weighted_design)
    gain = np.asarray((G.T @ observations.inverse_covariance) * G.T.toarray()).sum(axis=1)
    gain -= np.einsum("ci,ij,cj->c", weighted, covariance, weighted, optimize=True)
    sigma = observations.height_sigma_m
    return sigma * np.asarray(G.T @ pull), sigma * np.sqrt(np.maximum(1.0 - gain, 0.0))


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
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        inside = 1.0 - np.exp(-0.5 * np.square(middle)[:, None] / along).mean(axis=1)
        low, high = np.where(inside < probability, middle, low), np.where(inside < probability, high, middle)
    radius[known] = high
    return radius
