"""The position as it is known at each frame: of a drive by the filter, of a camera at rest by its exposures so far.

What contradicts the other frames is left out. Exposures at rest have one posterior, with the shared errors carried
once.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from startrack.applications.tracking.contradictions import (
    DOUBTFUL_NEIGHBOURS,
    SLIP_PROBABILITY,
    SLIP_SIGMA_M,
    WRONG_PROBABILITY,
    WRONG_SIGMA_M,
    RobustTrack,
    log_normal,
    smooth_robustly,
    wrong_covariance,
    wrong_log_odds,
)
from startrack.applications.tracking.frame_estimate import (
    FRAME_REACH_SIGMAS,
    LEAST_FRAME_HALF_M,
    FrameModel,
    largest_sigma,
    observe_together,
    sample_together,
)
from startrack.applications.tracking.observed_frame import ObservedFrame
from startrack.applications.tracking.track_errors import TrackErrors
from startrack.core.types import Array, BadInput
from startrack.estimation.observations import UNKNOWN_M, FrameEstimate, Observations, Steps
from startrack.estimation.trajectory import Smoothed, TrackFilter, smooth
from startrack.terrain import Terrain

CLEAR_NATS = 3.0  # by which a mode must be likelier than the other modes
SUSPECT_FRAMES = DOUBTFUL_NEIGHBOURS  # left out in a row, after which the frames before them are tried anew
RECENT_FRAMES = 30  # of these
STILL_M = 1e-3  # of a camera at rest from exposure to exposure, in the comparison of single fixes

Modes = Sequence[FrameEstimate]


class OnlineTrack:
    """Positions at the time of each frame; `add` in the order of time. Without contradictions a Kalman filter."""

    def __init__(self, shared_count: int, height_sigma_m: float) -> None:
        self.filter = TrackFilter(shared_count, height_sigma_m)
        self._added: list[tuple[Modes, Array, float]] = []
        self._judged: list[tuple[int, bool]] = []  # which mode is used (-1: none); whether the move before it slipped

    @property
    def mode(self) -> int:
        """Which mode of the last frame is used; -1: none."""
        return self._judged[-1][0]

    @property
    def is_first(self) -> bool:
        """Whether the last frame is used, and the only one so far."""
        return self.mode >= 0 and sum(mode >= 0 for mode, _ in self._judged) == 1

    def add(self, modes: Modes, move_m: Array, sigma_m: float) -> None:
        """One more frame, with one mode, several (ambiguous) or none (refused), after a move (2,) in enu.

        `sigma_m` is that of the move on each axis; infinite where it is not known.
        """
        self._added.append((modes, move_m, sigma_m))
        self._judged.append(self._judge(modes, move_m, sigma_m))
        self._take(-1)
        recent = [m for (m, _), (of, *_) in zip(self._judged, self._added, strict=True) if of][-SUSPECT_FRAMES:]
        if recent == [-1] * SUSPECT_FRAMES:
            self._try_anew()

    def _judge(self, modes: Modes, move_m: Array, sigma_m: float) -> tuple[int, bool]:
        """The mode to use (-1: none), and whether the move before it slipped."""
        if not modes:
            return -1, False
        self.filter.predict(move_m, 0.0)
        wide = self.filter.covariance_m2[0, 0] > 1e3 * WRONG_SIGMA_M**2 or not np.isfinite(sigma_m)
        if wide:  # no position is predicted
            doubts = [wrong_log_odds(*self.filter.innovation(mode)[:2], mode, placed=False) for mode in modes]
            self.filter.predict(-move_m, 0.0)
            return (0 if len(modes) == 1 and doubts[0] < 0.0 else -1), False
        found = []
        for number, mode in enumerate(modes):
            residual, covariance, _ = self.filter.innovation(mode)
            covariance[[0, 1], [0, 1]] += sigma_m**2
            wider = covariance.copy()
            wider[[0, 1], [0, 1]] += SLIP_SIGMA_M**2
            share = np.log(mode.weight)
            right = np.log(1.0 - SLIP_PROBABILITY - WRONG_PROBABILITY) + log_normal(residual, covariance)
            slip = np.log(SLIP_PROBABILITY) + log_normal(residual, wider)
            wrong = np.log(WRONG_PROBABILITY) + log_normal(residual, covariance + wrong_covariance(mode))
            found += [(share + right, number, False), (share + slip, number, True), (share + wrong, -1, False)]
        self.filter.predict(-move_m, 0.0)
        best = max(found)
        others = [f[0] for f in found if f[1] not in (best[1], -1)]
        if others and max(others) > best[0] - CLEAR_NATS:
            return -1, False
        return best[1], best[2]

    def _take(self, k: int) -> None:
        """Filter frame k as it is judged."""
        (modes, move_m, sigma_m), (mode, slipped) = self._added[k], self._judged[k]
        self.filter.predict(move_m, np.hypot(sigma_m, SLIP_SIGMA_M) if slipped else sigma_m)
        if mode >= 0:
            self.filter.update(modes[mode])

    def _try_anew(self) -> None:
        """Frame by frame the last frames contradict: find out with the smoother which are wrong."""
        first = max(len(self._added) - RECENT_FRAMES, 0)
        modes, moves, sigmas = zip(*self._added[first:], strict=True)
        steps = Steps(np.array(moves[1:]).reshape(-1, 2), np.array(sigmas[1:]))
        try:
            found = smooth_robustly(modes, steps, self.filter.height_sigma_m)
        except ValueError:  # no frame with a single position
            return
        slipped = [self._judged[first][1], *found.slipped.tolist()]
        self._judged[first:] = zip(found.mode.tolist(), slipped, strict=True)
        self.filter = TrackFilter(self.filter.shared_count, self.filter.height_sigma_m)
        for k in range(len(self._added)):
            self._take(k)


def filter_positions(
    modes: Sequence[Modes], steps: Steps, shared_count: int, height_sigma_m: float
) -> tuple[Array, Array]:
    """Positions (n, 2) and covariances (n, 2, 2), each by the frames up to its own."""
    track, position, covariance = OnlineTrack(shared_count, height_sigma_m), [], []
    moves, sigmas = np.vstack([np.zeros(2), steps.move_m]), [0.0, *steps.sigma_m.tolist()]
    for of, move, sigma in zip(modes, moves, sigmas, strict=True):
        track.add(of, move, sigma)
        position.append(track.filter.position_m)
        covariance.append(track.filter.covariance_m2)
    return np.array(position), np.array(covariance)


def positions_at_rest(
    frames: Sequence[ObservedFrame], terrain: Terrain, errors: TrackErrors
) -> tuple[RobustTrack, Array, Array]:
    """The one position by all exposures, and positions (n, 2) and covariances (n, 2, 2) by each with those before it.

    Single fixes that contradict the others are left out. Errors that exposures share are carried once, those of each
    image apart. Raises ValueError where no exposure has a position, and BadInput (inconsistent_evidence) where half of
    those with a single position or more are elsewhere.
    """
    n = len(frames)
    still = Steps(np.zeros((n - 1, 2)), np.full(n - 1, STILL_M))
    agreeing = smooth_robustly([frame.modes for frame in frames], still, terrain.height_sigma_m, may_slip=False)
    single = np.array([len(frame.modes) == 1 for frame in frames])
    agree, count = np.count_nonzero(single & (agreeing.mode >= 0)), np.count_nonzero(single)
    if count > 1 and 2 * agree <= count:
        raise BadInput(
            "inconsistent_evidence",
            f"only {agree} of {count} images agree on one position: has the camera moved? Then leave --at-rest out",
        )
    position, covariance = np.zeros((n, 2)), np.repeat([UNKNOWN_M**2 * np.eye(2)], n, axis=0)

    def take(k: int, estimate: FrameEstimate) -> Smoothed:
        found = smooth(Observations.of([estimate], terrain.height_sigma_m), Steps.unknown(1))
        position[k:], covariance[k:] = found.position_m[0], found.covariance_m2[0]
        return found

    first, *later = np.flatnonzero(agreeing.mode >= 0).tolist()
    found, reference = take(first, frames[first].modes[agreeing.mode[first]]), agreeing.smoothed.position_m[0]
    half = max(FRAME_REACH_SIGMAS * largest_sigma(found.covariance_m2[0]), LEAST_FRAME_HALF_M)
    models: list[FrameModel] = []
    for k in (first, *later):
        evidence = frames[k].evidence
        if evidence is not None:
            models.append(FrameModel.of_evidence(evidence, terrain, errors, reference, half))
        if k != first:
            points = sample_together(models, reference, agreeing.smoothed.covariance_m2[0])
            found = take(k, observe_together(models, points))
    return RobustTrack(found, agreeing.mode, agreeing.slipped), position, covariance
