"""Observations of a simulated drive that follow the linear model of a track exactly."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from startrack.core.types import Array, Ints
from startrack.estimation.observations import FrameEstimate, Steps

HEIGHT_SIGMA_M = 5.0
POSTS_IN_PLAY, POSTS_KEPT = 8, 6  # of a frame, and of the frame before
STEP_M, STEP_SIGMA_M = 50.0, 1.0


@dataclass(frozen=True, eq=False)
class Drive:
    """Truth, observations and moves."""

    position_m: Array  # (n, 2)
    shared: Array  # (k,)
    height_error_m: Array  # (posts,)
    estimates: list[FrameEstimate]
    steps: Steps


def random_covariance(rng: np.random.Generator, size: int, scale: float) -> Array:
    """A positive definite matrix (size, size)."""
    half = rng.normal(size=(size, size + 3))
    return np.asarray(scale**2 * half @ half.T / (size + 3))


def simulate_drive(rng: np.random.Generator, frames: int, shared_count: int = 1) -> Drive:
    """A drive whose neighbouring frames depend on the same posts; its numbers are as on a 240 m map of 5 m errors."""
    p = 2 + shared_count
    position = np.cumsum(rng.normal(size=(frames, 2)) + np.array([STEP_M, 0.0]), axis=0)
    shared = rng.normal(size=shared_count)
    heights = HEIGHT_SIGMA_M * rng.normal(size=frames * POSTS_IN_PLAY)
    estimates, response_to_post = [], rng.normal(0.12, 0.06, (2, len(heights)))
    for k in range(frames):
        post = np.arange(POSTS_IN_PLAY) + k * (POSTS_IN_PLAY - POSTS_KEPT)
        by_post = np.vstack([response_to_post[:, post], rng.normal(0.0, 0.01, (shared_count, len(post)))])
        covariance = np.diag([4.0] * p)
        covariance[:2, :2] = random_covariance(rng, 2, 2.5)
        covariance[2:] *= 0.01
        covariance[2:, 2:] = random_covariance(rng, shared_count, 0.2) if shared_count else covariance[2:, 2:]
        covariance = 0.5 * (covariance + covariance.T)
        response = np.eye(p)
        response[:2, 2:] = rng.normal(0.0, 1.0, (2, shared_count))
        truth = np.concatenate([position[k], shared])
        noise = np.linalg.cholesky(covariance) @ rng.normal(size=p)
        mean = response @ truth + by_post @ heights[post] + noise
        whole = covariance + HEIGHT_SIGMA_M**2 * by_post @ by_post.T
        estimates.append(FrameEstimate(mean, whole, response, covariance, post, by_post))
    moves = np.diff(position, axis=0) + STEP_SIGMA_M * rng.normal(size=(frames - 1, 2))
    return Drive(position, shared, heights, estimates, Steps(moves, np.full(frames - 1, STEP_SIGMA_M)))


def with_slips(steps: Steps, which: Ints, slip_m: float) -> Steps:
    """The moves with a gross error to the east."""
    moves = steps.move_m.copy()
    moves[which, 0] += slip_m
    return replace(steps, move_m=moves)


def shifted(estimate: FrameEstimate, by_m: Array) -> FrameEstimate:
    """The observation of a position that is off by (2,)."""
    return replace(estimate, mean=estimate.mean + np.concatenate([by_m, np.zeros(estimate.parameters - 2)]))


def mean_nees(error_m: Array, covariance_m2: Array) -> float:
    """Mean normalised squared error of (n, 2) beside (n, 2, 2); 2 where both agree."""
    return float(np.einsum("ni,nij,nj->n", error_m, np.linalg.inv(covariance_m2), error_m).mean())
