"""Moves and frames that the rest of a track contradicts: wheel slip, wrong fixes, and the modes of ambiguous frames.

Every move and every frame is compared with its prediction by all the others. Its probability under its stated error is
weighed against that of a gross error. The worst one of a neighbourhood is left out first; then all are compared anew,
also those left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from startrack.core.types import Array, Bools, Ints
from startrack.estimation.observations import FrameEstimate, Observations, Steps
from startrack.estimation.trajectory import Smoothed, smooth

SLIP_PROBABILITY, SLIP_SIGMA_M = 0.05, 20.0  # of a move by wheel slip, and its size on each axis
WRONG_PROBABILITY, WRONG_SIGMA_M = 1e-3, 200.0  # of a frame, and the error of its position on each axis
EARLIER_NATS = 1e-6  # of two frames that contradict each other equally the later one is left out
DOUBTFUL_NEIGHBOURS = 2  # frames and moves to each side that one gross error makes doubtful
MAX_ROUNDS = 30


@dataclass(frozen=True, eq=False)
class RobustTrack:
    """The estimate without the moves and frames that contradict the others."""

    smoothed: Smoothed
    mode: Ints  # (n,) which mode of each frame is used; -1: none
    slipped: Bools  # (n - 1,)


def smooth_robustly(
    modes: Sequence[Sequence[FrameEstimate]], steps: Steps, height_sigma_m: float, *, may_slip: bool = True
) -> RobustTrack:
    """The estimate from frames with one mode each, several (ambiguous) or none (refused), and the moves between them.

    Moves are right unless they `may_slip`. Ambiguous frames are left out at first. Raises ValueError where no frame has
    a single mode.
    """
    mode = np.array([0 if len(of) == 1 else -1 for of in modes])
    slipped = np.zeros(len(modes) - 1, dtype=bool)
    known = np.isfinite(steps.sigma_m)
    placed = np.append(known, False) | np.insert(known, 0, False)  # frames with a known move
    tried, observations = set(), _chosen_observations(modes, mode, height_sigma_m)
    for _ in range(MAX_ROUNDS):
        found = smooth(observations, _widen_slipped_steps(steps, slipped))
        state = (tuple(mode), tuple(slipped))
        if state in tried:
            break
        tried.add(state)
        doubt_steps = step_doubt(found, steps) if may_slip else np.full(len(slipped), -np.inf)
        new_mode, doubt_frames = _frame_doubt(found, observations, modes, mode, placed)
        # Moves stand between frames: one line of doubts, frame, move, frame, ...
        doubt = np.full(2 * len(modes) - 1, -np.inf)
        doubt[::2], doubt[1::2] = doubt_frames, doubt_steps
        out = np.zeros(len(doubt), dtype=bool)
        out[::2], out[1::2] = mode < 0, slipped
        worst = _worst_nearby(np.where(out, -np.inf, doubt))
        now_out = (out & (doubt > 0.0)) | worst
        slipped = _improve_slips(found, steps, slipped) if not worst.any() else now_out[1::2]
        changed = np.where(now_out[::2], -1, np.where(mode < 0, new_mode, mode))
        if not (changed == mode).all():
            mode = changed
            observations = _chosen_observations(modes, mode, height_sigma_m)
    return RobustTrack(found, mode, slipped)


def step_doubt(found: Smoothed, steps: Steps) -> Array:
    """(n - 1,) logarithm of the odds that each move slipped; -inf where it is not known."""
    known = np.isfinite(steps.sigma_m)
    variance = found.step_variance_m2 + np.square(np.where(known, steps.sigma_m, 1.0))[:, None, None] * np.eye(2)
    odds = gross_log_odds(found.step_residual_m, variance, SLIP_SIGMA_M**2 * np.eye(2), SLIP_PROBABILITY)
    return np.where(known, odds, -np.inf)


def _improve_slips(found: Smoothed, steps: Steps, slipped: Bools) -> Bools:
    """The moves that slipped, each shifted to a neighbour or cancelled with one where that explains the track better.

    One gross error makes several moves doubtful, and the first one chosen hides the right one.
    """
    improved = slipped.copy()
    for k in np.flatnonzero(slipped).tolist():
        near = np.arange(max(k - 2 * DOUBTFUL_NEIGHBOURS, 0), min(k + 2 * DOUBTFUL_NEIGHBOURS + 1, len(slipped)))
        near = near[(near != k) & np.isfinite(steps.sigma_m[near])]
        near = near[(improved == slipped)[near]] if improved[k] else near[:0]
        gains = [_gain(found, steps, slipped, k, other) for other in near.tolist()]
        if gains and max(gains) > 0.0:
            other = near[int(np.argmax(gains))]
            improved[k], improved[other] = False, not slipped[other]
    return improved


def _gain(found: Smoothed, steps: Steps, slipped: Bools, here: int, there: int) -> float:
    """Logarithm of the odds that the move `here`, which counts as slipped, did not: `there` slipped, or neither."""
    pair, n = np.array([here, there]), len(found.position_m)
    difference = np.zeros((4, n, 2))
    for row, (step, axis) in enumerate((step, axis) for step in pair for axis in range(2)):
        difference[row, step, axis], difference[row, step + 1, axis] = -1.0, 1.0
    touched = np.unique([pair, pair + 1])
    part = difference[:, touched].reshape(4, -1)
    joint = found.joint_m2[touched][:, :, touched].reshape(2 * len(touched), -1)
    now = np.square(np.repeat(_widen_slipped_steps(steps, slipped).sigma_m[pair], 2))
    residual: Array = (steps.move_m - np.diff(found.position_m, axis=0))[pair].ravel()
    without = np.asarray(np.linalg.inv(np.linalg.inv(part @ joint @ part.T) - (1.0 - 1e-9) * np.diag(1.0 / now)))
    residual = np.asarray(residual + without @ (residual / now))
    changed = slipped.copy()
    changed[pair] = [False, not slipped[there]]
    then = np.square(np.repeat(_widen_slipped_steps(steps, changed).sigma_m[pair], 2))
    prior = 2.0 * float(np.log(1.0 / SLIP_PROBABILITY - 1.0)) if slipped[there] else 0.0
    return prior + float(log_normal(residual, without + np.diag(then)) - log_normal(residual, without + np.diag(now)))


def gross_log_odds(residual: Array, covariance: Array, gross: Array, probability: float) -> Array:
    """(...) logarithm of the odds that residuals (..., p) have a gross error, whose covariance is `gross` (p, p)."""
    odds = np.log(probability) - np.log1p(-probability)
    return np.asarray(odds + log_normal(residual, covariance + gross) - log_normal(residual, covariance))


def log_normal(residual: Array, covariance: Array) -> Array:
    """Logarithm of normal densities at residuals (..., 2) with covariances (..., 2, 2), less a constant."""
    chi2 = np.einsum("...i,...ij,...j->...", residual, np.linalg.inv(covariance), residual)
    return np.asarray(-0.5 * chi2 - 0.5 * np.linalg.slogdet(covariance)[1])


def _frame_doubt(
    found: Smoothed, observations: Observations, modes: Sequence[Sequence[FrameEstimate]], mode: Ints, placed: Bools
) -> tuple[Ints, Array]:
    """The best mode (n,) of each frame, and the logarithm of the odds (n,) that the frame is wrong in it.

    Frames that are not `placed` (n,) have no prediction of their position, only of the shared errors.
    """
    best, doubt = mode.copy(), np.full(len(mode), -np.inf)
    for number, (k, estimate) in enumerate(zip(observations.frames, observations.estimates, strict=True)):
        residual, covariance = found.frame_residual[number], found.frame_covariance[number]
        doubt[k] = wrong_log_odds(residual, covariance, estimate, placed=bool(placed[k])) + EARLIER_NATS * k
    for k in np.flatnonzero(mode < 0).tolist():
        predicted = [_mode_residual(found, k, one, observations.height_sigma_m) for one in modes[k]]
        odds = [wrong_log_odds(*r, e, placed=bool(placed[k])) for r, e in zip(predicted, modes[k], strict=True)]
        if odds:
            best[k], doubt[k] = int(np.argmin(odds)), min(odds) + EARLIER_NATS * k
    return best, doubt


def _mode_residual(found: Smoothed, k: int, estimate: FrameEstimate, height_sigma_m: float) -> tuple[Array, Array]:
    """Residual of an `estimate` of frame k beside a track `found` without it, and its covariance."""
    known = np.zeros((estimate.parameters, estimate.parameters))
    known[:2, :2], known[2:, 2:] = found.covariance_m2[k], found.shared_covariance
    response, posts = estimate.response, height_sigma_m * estimate.by_post
    covariance = response @ known @ response.T + estimate.noise + posts @ posts.T
    return estimate.mean - response @ np.append(found.position_m[k], found.shared), covariance


def wrong_log_odds(residual: Array, covariance: Array, estimate: FrameEstimate, *, placed: bool = True) -> float:
    """Logarithm of the odds that a frame is wrong, by the residual (p,) of its `estimate` with a covariance (p, p).

    Where the frame is not `placed`, its position is not predicted and says nothing.
    """
    wrong, part = wrong_covariance(estimate), slice(0 if placed else 2, None)
    if not placed and estimate.parameters == 2:
        return -np.inf
    return float(gross_log_odds(residual[part], covariance[part, part], wrong[part, part], WRONG_PROBABILITY))


def wrong_covariance(estimate: FrameEstimate) -> Array:
    """(p, p) by which the residual of a wrong frame varies beside that of a right one."""
    sigma = np.r_[WRONG_SIGMA_M, WRONG_SIGMA_M, np.ones(estimate.parameters - 2)]  # of shared errors, that of the prior
    return np.asarray((estimate.response * np.square(sigma)) @ estimate.response.T)


def _worst_nearby(doubt: Array) -> Bools:
    """Those above even odds that no neighbour exceeds."""
    padded = np.pad(doubt, 2 * DOUBTFUL_NEIGHBOURS, constant_values=-np.inf)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 4 * DOUBTFUL_NEIGHBOURS + 1)
    return np.asarray((doubt > 0.0) & (doubt >= windows.max(axis=1)))


def _widen_slipped_steps(steps: Steps, slipped: Bools) -> Steps:
    return replace(steps, sigma_m=np.where(slipped, np.hypot(steps.sigma_m, SLIP_SIGMA_M), steps.sigma_m))


def _chosen_observations(modes: Sequence[Sequence[FrameEstimate]], mode: Ints, height_sigma_m: float) -> Observations:
    chosen = [of[k] if k >= 0 else None for of, k in zip(modes, mode, strict=True)]
    if all(one is None for one in chosen):
        raise ValueError("no frame has a single position")
    return Observations.of(chosen, height_sigma_m)
