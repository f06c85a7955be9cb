"""The position as it is known at each frame: of a drive by the filter, of a camera at rest by its exposures so far.

What contradicts the other frames is left out. Exposures at rest have one posterior, with the shared errors carried
once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from startrack.applications.tracking.contradictions import RobustTrack, conclude, disagrees
from startrack.applications.tracking.explanations import WINDOW, Explanations, explain
from startrack.applications.tracking.frame_estimate import (
    FRAME_REACH_SIGMAS,
    LEAST_FRAME_HALF_M,
    FrameModel,
    largest_sigma,
    observe_together,
    sample_together,
)
from startrack.applications.tracking.moves import FREEDOMS, LEG_FREEDOMS, Moves
from startrack.applications.tracking.observed_frame import ObservedFrame
from startrack.applications.tracking.track_errors import SIZE_ROUNDS, TrackErrors
from startrack.core.types import Array, BadInput, Ints
from startrack.estimation.observations import UNKNOWN_M, FrameEstimate, Steps
from startrack.estimation.trajectory import Smoothed, TrackFilter, mixed_normal, smooth
from startrack.localization import AMBIGUOUS_MASS
from startrack.terrain import Terrain

STILL_M = 1e-3  # of a camera at rest from exposure to exposure, in the comparison of single fixes

Modes = Sequence[FrameEstimate]


class OnlineTrack:
    """Positions at the time of each frame; `add` in the order of time. Without contradictions a Kalman filter."""

    def __init__(self, shared_count: int, window: int = WINDOW) -> None:
        """With `shared_count` errors that frames share; `window`: as of `Explanations`."""
        self._start = TrackFilter.start(shared_count, FREEDOMS, LEG_FREEDOMS)
        self.filter = self._start[:]
        self._before, self._number = self._start[:], 0  # of the settled frames; their kind of odometry
        self._first = 0  # frame of the first move
        self._has_used = False  # whether a frame before the last one is used
        self.is_vouched = True  # whether explanations of another position of the last frame are unlikely together
        self.compared = Explanations(shared_count, window=window)
        self._modes: list[Modes] = []  # of the frames that are not settled
        self._decided: list[tuple[object, ...]] = []  # of each of them that the filter has

    @property
    def mode(self) -> int:
        """Which mode of the last frame is used; -1: none."""
        return int(self._best.mode[-1]) if self.is_vouched else -1

    @property
    def position_m(self) -> Array:
        """(2,) of the last frame, by all moves that it may have made."""
        return self._of_last[0]

    @property
    def covariance_m2(self) -> Array:
        """(2, 2) of the last frame, by all moves that it may have made."""
        return self._of_last[1]

    @property
    def _of_last(self) -> tuple[Array, Array]:
        """Where the filter differs from the explanation it follows, by posts, the variants differ alike."""
        best, (parts, share) = self._best, self._best.parts
        position, covariance = mixed_normal(
            [one.position_m for one in parts], [one.covariance_m2 for one in parts], share
        )
        sizes, axes = np.linalg.eigh(covariance - best.covariance_m2)
        more = (axes * np.maximum(sizes, 0.0)) @ axes.T
        return self.filter.position_m + position - best.position_m, self.filter.covariance_m2 + more

    @property
    def is_first(self) -> bool:
        """Whether the last frame is used, and the only one so far."""
        return self.mode >= 0 and not self._has_used

    @property
    def first(self) -> int:
        """Number of the first frame that `moves` must have when the next one is added."""
        return self.compared.first

    def add(self, modes: Modes, moves: Sequence[Moves], first: int = 0) -> None:
        """One more frame, with one mode, several (ambiguous) or none (refused).

        `moves` are as for `Explanations.add`, from the frame `first` on, at most that of the property.
        """
        settled, self._first = self.compared.settled, first
        self.compared.add(modes, moves, first)
        self._modes.append(modes)
        self._settle(settled)
        self._best, *others = self.compared.ranked()
        self._follow_best(settled)
        best = self._best
        self._has_used |= bool(best.mode[:-1].max(initial=-1) >= 0)
        away = [disagrees(best.position_m, best.covariance_m2, o.position_m, o.covariance_m2) for o in others]
        doubt = sum(one.share for one, is_away in zip(others, away, strict=True) if is_away)
        self.is_vouched = doubt <= AMBIGUOUS_MASS

    def _settle(self, first: int) -> None:
        """The filter that begins anew has the settled frames from this number on, as they are settled."""
        likeliest = self.compared.likeliest
        steps, now = likeliest.steps, self.compared.settled
        if now > first and likeliest.number != self._number:  # errors in standard deviations of another odometry
            self._before.forget_moves()
            self._number = likeliest.number
        for number in range(first, now):
            _take(self._before, steps, number - self._first, self._modes[number - first], likeliest.mode)

    def _follow_best(self, settled: int) -> None:
        """Take into the filter what the likeliest explanation says of frames from number `settled` on."""
        best, steps, begin = self._best, self._best.steps, settled - self._first
        turned_by = np.where(best.anchor > 0, best.anchor + self._first, 0).tolist()
        moved = [(), *zip(best.kind.tolist(), turned_by, [best.number] * len(best.kind), strict=True)]
        decided = [(best.keeps_settled, mode, *m) for mode, m in zip(best.mode.tolist(), moved, strict=True)][begin:]
        done, more = len(self._decided), self.compared.settled - settled
        if decided[:done] != self._decided:  # another explanation of these frames is likelier now
            self.filter, done = (self._before if best.keeps_settled else self._start)[:], more
            if best.number != self._number:
                self.filter.forget_moves()
        for k in range(done, len(decided)):
            _take(self.filter, steps, begin + k, self._modes[k], best.mode)
        self._decided, self._modes = decided[more:], self._modes[more:]


def _take(track: TrackFilter, steps: Steps, at: int, modes: Modes, mode: Ints) -> None:
    """Take the move to the frame at this index, and its mode that is right."""
    if at:
        track.predict(steps, at - 1)
    if mode[at] >= 0:
        track.update(modes[mode[at]])


@dataclass(frozen=True, eq=False)
class Filtered:
    """Positions of n frames, each by the frames up to its own."""

    position_m: Array  # (n, 2)
    covariance_m2: Array  # (n, 2, 2); of a position about which explanations differ, that of an unknown one
    mode: Ints  # (n,) used then; -1: none
    alone: list[int]  # the frames whose position is by their image alone
    compared: Explanations  # of all frames


def filter_positions(modes: Sequence[Modes], moves: Sequence[Moves], shared_count: int) -> Filtered:
    """The positions by frames of these `modes`, of which none is settled; `moves` are those of `explain`."""
    track, position, covariance, alone, mode = OnlineTrack(shared_count, len(modes)), [], [], [], []
    for k, of in enumerate(modes):
        track.add(of, [one.part(0, k + 1) for one in moves])
        position.append(track.position_m)
        covariance.append(track.covariance_m2 if track.is_vouched else UNKNOWN_M**2 * np.eye(2))
        alone += [k] if track.is_first else []
        mode.append(track.mode)
    return Filtered(np.array(position), np.array(covariance), np.array(mode), alone, track.compared)


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
    terrain = terrain.with_steepness(next((frame.steepness_1 for frame in frames if frame.modes), 1.0))
    errors, modes = errors.on(terrain), [[errors.place(one) for one in frame.modes] for frame in frames]
    names = [frame.name for frame in frames]
    agreeing = conclude(modes, explain(modes, [Moves.of(still)], may_slip=False), names)
    single = np.array([len(frame.modes) == 1 for frame in frames])
    agree, count = np.count_nonzero(single & (agreeing.mode >= 0)), np.count_nonzero(single)
    if count > 1 and 2 * agree <= count:
        raise BadInput(
            "inconsistent_evidence",
            f"only {agree} of {count} images agree on one position: has the camera moved? Then leave --at-rest out",
        )
    position, covariance = np.zeros((n, 2)), np.repeat([UNKNOWN_M**2 * np.eye(2)], n, axis=0)

    def take(k: int, estimate: FrameEstimate) -> Smoothed:
        found = smooth([errors.place(estimate)], Steps.unknown(1))
        for _ in range(SIZE_ROUNDS if errors.bends else 0):
            placed = errors.place(estimate, found.position_m[0], found.shared)
            found = smooth([placed], Steps.unknown(1))
        position[k:], covariance[k:] = found.position_m[0], found.covariance_m2[0]
        return found

    first, *later = np.flatnonzero(agreeing.mode >= 0).tolist()
    one = frames[first].modes[agreeing.mode[first]]
    found, reference, spread = take(first, one), agreeing.smoothed.position_m[0], agreeing.smoothed.covariance_m2[0]
    if errors.bends:  # models have positions before these are scaled with the crater
        reference, spread = one.mean[:2], one.covariance[:2, :2]
    half = max(FRAME_REACH_SIGMAS * largest_sigma(found.covariance_m2[0]), LEAST_FRAME_HALF_M)
    models: list[FrameModel] = []
    for k in (first, *later):
        evidence = frames[k].evidence
        if evidence is not None:
            models.append(FrameModel.of_evidence(evidence, terrain, errors, reference, half))
        if k != first:
            points = sample_together(models, reference, spread)
            found = take(k, observe_together(models, points))
    return replace(agreeing, smoothed=found), position, covariance
