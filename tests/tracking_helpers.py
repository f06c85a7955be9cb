"""Observations of a simulated drive that follow the linear model of a track exactly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta

import numpy as np

from startrack.applications.tracking import ObservedFrame, Odometry, TrackErrors
from startrack.core.types import Array, Ints
from startrack.estimation.observations import FrameEstimate, Steps
from startrack.frames import R_body_enu_from_heading_pitch_roll, quat_xyzw_from_R
from startrack.localization.likelihood.shared_errors import SharedErrors
from startrack.terrain import ShapeError

HEIGHT_SIGMA_M = 5.0
POSTS_IN_PLAY, POSTS_KEPT = 8, 6  # of a frame, and of the frame before
STEP_M, STEP_SIGMA_M = 50.0, 1.0
START, EVERY_S = datetime(2030, 6, 1, tzinfo=UTC), 900.0
SHARED = TrackErrors(SharedErrors((ShapeError(name="bias_rad", fact="horizon_sigma_deg", sigma=1e-3),)))


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
        estimates.append(FrameEstimate(mean, whole, response, covariance, post, HEIGHT_SIGMA_M * by_post))
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


def attitudes(rng: np.random.Generator, frames: int) -> list[Array]:
    """From enu to the body, turning as it drives."""
    heading = np.cumsum(rng.normal(0.0, 0.2, frames))
    return [R_body_enu_from_heading_pitch_roll(a, *rng.normal(0.0, 0.03, 2)) for a in heading]


def odometry_of(position_m: Array, R_body_enu: list[Array]) -> Odometry:
    """Without errors, in a frame of its own."""
    R_own_enu = R_body_enu_from_heading_pitch_roll(1.0, 0.0, 0.0)
    return Odometry(
        time_s=START.timestamp() + EVERY_S * np.arange(len(position_m)),
        position_m=np.column_stack([position_m, np.zeros(len(position_m))]) @ R_own_enu.T + [5.0, -7.0, 1.0],
        quat_xyzw=np.array([quat_xyzw_from_R(R_own_enu @ R.T) for R in R_body_enu]),
    )


def observed(estimates: Sequence[FrameEstimate], R_body_enu: Sequence[Array]) -> list[ObservedFrame]:
    """Frames with one mode each."""
    return [
        ObservedFrame(f"frame-{k}", START + timedelta(seconds=EVERY_S * k), R, (e,), None)
        for k, (e, R) in enumerate(zip(estimates, R_body_enu, strict=True))
    ]
