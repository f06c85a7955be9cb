"""The position as it is known at each frame: of a drive by the filter, of a camera at rest by its exposures so far.

What contradicts the other frames is left out. Exposures at rest have one posterior, with the shared errors carried
once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from startrack.applications.tracking.contradictions import (
    SLIP_PROBABILITY,
    SLIP_SIGMA_M,
    WRONG_PROBABILITY,
    WRONG_SIGMA_M,
    log_normal,
    smooth_robustly,
    wrong_covariance,
    wrong_log_odds,
)
from startrack.applications.tracking.frame_estimate import FRAME_REACH_SIGMAS, LEAST_FRAME_HALF_M, observe_together
from startrack.applications.tracking.frame_model import FrameModel, sample_together
from startrack.applications.tracking.observed_frame import ObservedFrame
from startrack.applications.tracking.track_errors import TrackErrors
from startrack.core.types import Array, BadInput, Ints
from startrack.estimation.filter import TrackFilter
from startrack.estimation.observations import UNKNOWN_M, FrameEstimate, Observations, Steps
from startrack.estimation.smoother import Smoothed, smooth
from startrack.terrain import Terrain

CLEAR_NATS = 3.0  # by which a mode must be likelier than the other modes
SUSPECT_FRAMES = 2  # left out in a row, after which the frames before them are tried anew
RECENT_FRAMES = 30  # of these
STILL_M = 1e-3  # of a camera at rest from exposure to exposure, in the comparison of single fixes

Modes = Sequence[FrameEstimate]


class OnlineTrack:
    """Positions at the time of each frame; `add` in the order of time. Without contradictions a Kalman filter."""

    def __init__(self, shared_count: int, height_sigma_m: float) -> None:
        self._start = shared_count, height_sigma_m
        self._filter = TrackFilter(*self._start)
        self._added: list[tuple[Modes, Array, float]] = []
        self._mode: list[int] = []
        self._slipped: list[bool] = []  # the move before each frame

    @property
    def position_m(self) -> Array:
        """(2,) of the last frame."""
        return self._filter.position_m

    @property
    def covariance_m2(self) -> Array:
        """(2, 2) of the last frame."""
        return self._filter.covariance_m2

    @property
    def mode(self) -> int:
        """Which mode of the last frame is used; -1: none."""
        return self._mode[-1]

    @property
    def is_first(self) -> bool:
        """Whether the last frame is used, and the only one so far."""
        return self.mode >= 0 and sum(mode >= 0 for mode in self._mode) == 1

    def add(self, modes: Modes, move_m: Array, sigma_m: float) -> None:
        """One more frame, with one mode, several (ambiguous) or none (refused), after a move (2,) in enu.

        `sigma_m` is that of the move on each axis; infinite where it is not known.
        """
        self._added.append((modes, move_m, sigma_m))
        mode, slipped = self._judge(modes, move_m, sigma_m)
        self._take(modes, move_m, sigma_m, mode, slipped)
        self._mode.append(mode)
        self._slipped.append(slipped)
        recent = [m for m, added in zip(self._mode, self._added, strict=True) if added[0]][-SUSPECT_FRAMES:]
        if recent == [-1] * SUSPECT_FRAMES:
            self._try_anew()

    def _judge(self, modes: Modes, move_m: Array, sigma_m: float) -> tuple[int, bool]:
        """The mode to use (-1: none), and whether the move before it slipped."""
        if not modes:
            return -1, False
        self._filter.predict(move_m, 0.0)
        wide = self._filter.covariance_m2[0, 0] > 1e3 * WRONG_SIGMA_M**2 or not np.isfinite(sigma_m)
        if wide:  # no position is predicted
            doubts = [wrong_log_odds(*self._filter.innovation(mode), mode, placed=False) for mode in modes]
            self._filter.predict(-move_m, 0.0)
            return (0 if len(modes) == 1 and doubts[0] < 0.0 else -1), False
        found = []
        for number, mode in enumerate(modes):
            residual, covariance = self._filter.innovation(mode)
            covariance[[0, 1], [0, 1]] += sigma_m**2
            wider = covariance.copy()
            wider[[0, 1], [0, 1]] += SLIP_SIGMA_M**2
            share = np.log(mode.weight)
            right = np.log(1.0 - SLIP_PROBABILITY - WRONG_PROBABILITY) + log_normal(residual, covariance)
            slip = np.log(SLIP_PROBABILITY) + log_normal(residual, wider)
            wrong = np.log(WRONG_PROBABILITY) + log_normal(residual, covariance + wrong_covariance(mode))
            found += [(share + right, number, False), (share + slip, number, True), (share + wrong, -1, False)]
        self._filter.predict(-move_m, 0.0)
        best = max(found)
        others = [f[0] for f in found if f[1] not in (best[1], -1)]
        if others and max(others) > best[0] - CLEAR_NATS:
            return -1, False
        return best[1], best[2]

    def _take(self, modes: Modes, move_m: Array, sigma_m: float, mode: int, slipped: bool) -> None:
        self._filter.predict(move_m, np.hypot(sigma_m, SLIP_SIGMA_M) if slipped else sigma_m)
        if mode >= 0:
            self._filter.update(modes[mode])

    def _try_anew(self) -> None:
        """Frame by frame the last frames contradict: find out with the smoother which are wrong."""
        first = max(len(self._added) - RECENT_FRAMES, 0)
        recent = self._added[first:]
        moves = np.array([move for _, move, _ in recent[1:]]).reshape(-1, 2)
        steps = Steps(moves, np.array([sigma for _, _, sigma in recent[1:]]))
        try:
            found = smooth_robustly([modes for modes, _, _ in recent], steps, self._start[1])
        except ValueError:  # no frame with a single position
            return
        self._mode[first:] = found.mode.tolist()
        self._slipped[first + 1 :] = found.slipped.tolist()
        self._filter = TrackFilter(*self._start)
        for (modes, move_m, sigma_m), mode, slipped in zip(self._added, self._mode, self._slipped, strict=True):
            self._take(modes, move_m, sigma_m, mode, slipped)


def filter_positions(
    modes: Sequence[Modes], steps: Steps, shared_count: int, height_sigma_m: float
) -> tuple[Array, Array]:
    """Positions (n, 2) and covariances (n, 2, 2), each by the frames up to its own."""
    track, position, covariance = OnlineTrack(shared_count, height_sigma_m), [], []
    for k, of in enumerate(modes):
        move, sigma = (np.zeros(2), 0.0) if k == 0 else (steps.move_m[k - 1], float(steps.sigma_m[k - 1]))
        track.add(of, move, sigma)
        position.append(track.position_m)
        covariance.append(track.covariance_m2)
    return np.array(position), np.array(covariance)


@dataclass(frozen=True, eq=False)
class AtRest:
    """Position after each exposure, and by all."""

    position_m: Array  # (n, 2)
    covariance_m2: Array  # (n, 2, 2)
    smoothed: Smoothed  # of one position, by all exposures
    mode: Ints  # (n,) which mode of each exposure agrees with the others; -1: none


def positions_at_rest(frames: Sequence[ObservedFrame], terrain: Terrain, errors: TrackErrors) -> AtRest:
    """The position by the first exposures together, for each number of them.

    Single fixes that contradict the others are left out. Errors that exposures share are carried once, those of each
    image apart. Raises ValueError where no exposure has a position, and BadInput (inconsistent_evidence) where half of
    those with a single position or more are elsewhere.
    """
    n = len(frames)
    still = Steps(np.zeros((n - 1, 2)), np.full(n - 1, STILL_M))
    agreeing = smooth_robustly([frame.modes for frame in frames], still, terrain.height_sigma_m, may_slip=False)
    mode, by_fixes = agreeing.mode, agreeing.smoothed
    _require_rest(frames, mode)
    position, covariance = np.zeros((n, 2)), np.repeat([UNKNOWN_M**2 * np.eye(2)], n, axis=0)

    def take(k: int, estimate: FrameEstimate) -> Smoothed:
        found = smooth(Observations.of([estimate], terrain.height_sigma_m), Steps.unknown(1))
        position[k:], covariance[k:] = found.position_m[0], found.covariance_m2[0]
        return found

    first, *later = np.flatnonzero(mode >= 0).tolist()
    found = take(first, frames[first].modes[mode[first]])
    reference = by_fixes.position_m[0]
    half = max(FRAME_REACH_SIGMAS * float(np.sqrt(np.linalg.eigvalsh(found.covariance_m2[0])[1])), LEAST_FRAME_HALF_M)
    models: list[FrameModel] = []
    for k in (first, *later):
        evidence = frames[k].evidence
        if evidence is not None:
            models.append(FrameModel.of_evidence(evidence, terrain, errors, reference, half))
        if k != first:
            points = sample_together(models, reference, by_fixes.covariance_m2[0])
            found = take(k, observe_together(models, points))
    return AtRest(position, covariance, found, mode)


def _require_rest(frames: Sequence[ObservedFrame], mode: Ints) -> None:
    single = np.array([len(frame.modes) == 1 for frame in frames])
    agree, count = int(np.sum(single & (mode >= 0))), int(np.sum(single))
    if count > 1 and 2 * agree <= count:
        raise BadInput(
            "inconsistent_evidence",
            f"only {agree} of {count} images agree on one position: has the camera moved? Then leave --at-rest out",
        )
