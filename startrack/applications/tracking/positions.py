"""Positions of a track by its explanations: at the time of each frame, by all frames, and of a camera at rest."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from startrack.applications.tracking.explanations import WINDOW, Explanation, Explanations, explain
from startrack.applications.tracking.frame_estimate import (
    FRAME_REACH_SIGMAS,
    LEAST_FRAME_HALF_M,
    FrameModel,
    largest_sigma,
    observe_together,
    sample_together,
)
from startrack.applications.tracking.observed_frame import ObservedFrame
from startrack.applications.tracking.odometry import FREEDOMS, LEG_FREEDOMS, Moves
from startrack.applications.tracking.track_errors import DEPTH, SIZE_ROUNDS, WIDTH, TrackErrors
from startrack.core.types import Array, BadInput, Bools, Ints
from startrack.estimation.observations import UNKNOWN_M, FrameEstimate, Steps
from startrack.estimation.trajectory import Smoothed, TrackFilter, mix_smoothed, mixed_normal, smooth
from startrack.localization import AMBIGUOUS_MASS
from startrack.terrain import Terrain

CHI2_999 = float(-2.0 * np.log(0.001))  # within which a normal error in the plane is with 99.9 %
NAMED_FRAMES = 4  # of a group in a message
STILL_M = 1e-3  # of a camera at rest from exposure to exposure, in the comparison of single fixes
SIZES = {DEPTH: "depth_m", WIDTH: "diameter_m"}  # errors of a crater, and the fact of each
MOST_SIZE_SIGMAS = 4.0  # of the logarithms of a crater's depth and width: what its file states is wrong beyond
STILL_MOVES_M = 0.01  # expanded about a crater's size anew, until no position moves by more

Modes = Sequence[FrameEstimate]


class OnlineTrack:
    """Positions at the time of each frame, added in the order of time. Without contradictions a Kalman filter."""

    def __init__(self, shared_count: int, window: int = WINDOW) -> None:
        """Begin with `shared_count` shared errors; frames that `window` others with a position follow are settled."""
        self.filter = TrackFilter.start(shared_count, FREEDOMS, LEG_FREEDOMS)
        self._before = self.filter[:], self.filter[:]  # of the settled frames: of both drives
        self._number = 0  # their kind of odometry
        self._first = 0  # frame of the first move
        self._has_used = False  # whether a frame before the last one is used
        self.is_vouched = True  # whether explanations of another position of the last frame are unlikely together
        self.compared = Explanations(shared_count, window=window)
        self._modes: list[Modes] = []  # of the frames that are not settled
        self._decided: list[tuple[object, ...]] = []  # of each of them that the filter has

    def add(self, modes: Modes, moves: Sequence[Moves], first: int = 0) -> None:
        """Add one more frame, with one mode, several (ambiguous) or none (refused).

        `moves` are by each kind of odometry, from frame number `first`, at most that of the property, to this one.
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

    @property
    def first(self) -> int:
        """Number of the first frame that `moves` must have when the next one is added."""
        return self.compared.first

    @property
    def mode(self) -> int:
        """Number of the mode of the last frame that is used; -1: none."""
        return int(self._best.mode[-1]) if self.is_vouched else -1

    @property
    def is_first(self) -> bool:
        """Whether the last frame is used, and the only one so far."""
        return self.mode >= 0 and not self._has_used

    @property
    def position(self) -> tuple[Array, Array]:
        """Position (2,) of the last frame and its covariance (2, 2), by all moves that it may have made.

        About a position of which explanations differ nothing is known. Where the filter differs from the explanation it
        follows, by posts, the variants differ alike.
        """
        best, (parts, share) = self._best, self._best.parts
        found = mixed_normal([one.position_m for one in parts], [one.covariance_m2 for one in parts], share)
        sizes, axes = np.linalg.eigh(found[1] - best.covariance_m2)
        more = (axes * np.maximum(sizes, 0.0)) @ axes.T
        covariance_m2 = known_m2(self.filter.covariance_m2 + more, self.is_vouched)
        return self.filter.position_m + found[0] - best.position_m, covariance_m2

    def _settle(self, first: int) -> None:
        """Take the frames that settled, from number `first` on, into the filters from which tracking begins anew."""
        now = self.compared.settled
        if now == first:
            return
        for state, one in zip(self._before, self.compared.likeliest, strict=True):
            steps = one.steps
            if one.number != self._number:  # errors in standard deviations of another odometry
                state.forget_moves()
            for number in range(first, now):
                _take(state, steps, number - self._first, self._modes[number - first], one.mode)
        self._number = one.number

    def _follow_best(self, settled: int) -> None:
        """Take into the filter what the likeliest explanation says of frames from number `settled` on."""
        best, steps, begin = self._best, self._best.steps, settled - self._first
        turned_by = np.where(best.anchor > 0, best.anchor + self._first, 0).tolist()
        moved = [(), *zip(best.kind.tolist(), turned_by, [best.number] * len(best.kind), strict=True)]
        decided = [(best.drive, mode, *m) for mode, m in zip(best.mode.tolist(), moved, strict=True)][begin:]
        done, more = len(self._decided), self.compared.settled - settled
        if decided[:done] != self._decided:  # another explanation of these frames is likelier now
            self.filter, done = self._before[best.drive][:], more
            if best.number != self._number:
                self.filter.forget_moves()
        for k in range(done, len(decided)):
            _take(self.filter, steps, begin + k, self._modes[k], best.mode)
        self._decided, self._modes = decided[more:], self._modes[more:]


def _take(track: TrackFilter, steps: Steps, at: int, modes: Modes, mode: Ints) -> None:
    """Take the move to the frame at index `at` into the filter, and the mode of the frame that is right."""
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
    alone: Ints  # (n,) the frame by whose image alone it is; -1: by several
    compared: Explanations  # of all frames


def filter_positions(modes: Sequence[Modes], moves: Sequence[Moves], shared_count: int) -> Filtered:
    """The positions by frames of these `modes`, of which none is settled; `moves` are by each kind of odometry."""
    n, track = len(modes), OnlineTrack(shared_count, len(modes))
    mode, alone = np.full((2, n), -1)
    found = Filtered(np.zeros((n, 2)), np.zeros((n, 2, 2)), mode, alone, track.compared)
    for k, of in enumerate(modes):
        track.add(of, moves)
        (found.position_m[k], found.covariance_m2[k]), mode[k] = track.position, track.mode
        alone[k] = k if track.is_first else -1
    return found


@dataclass(frozen=True, eq=False)
class RobustTrack:
    """The estimate without the moves and frames that contradict the others."""

    smoothed: Smoothed  # where explanations of another position are likely together, nothing is known
    mode: Ints  # (n,) which mode of each frame is used; -1: none
    best: Explanation  # with the moves, and the legs that slipped; odometry with a fault is left out

    @property
    def attitude_fits(self) -> Bools:
        """Whether the attitude of each frame (n,) turns the move after it."""
        return np.append(self.best.anchor == np.arange(1, len(self.mode)), True)


def conclude(modes: Sequence[Modes], compared: Explanations, names: Sequence[str] = ()) -> RobustTrack:
    """The estimate from frames with one mode each, several (ambiguous) or none (refused).

    Args:
        modes: those of n frames, in the order of time.
        compared: their explanations, with the moves between all of them.
        names: those of the frames, for messages; empty: their numbers from 1.

    Raises:
        ValueError: no frame has a mode.
        BadInput: inconsistent_evidence where two groups of frames contradict each other, and neither is clearly right.
    """
    if not any(modes):
        raise ValueError("no frame has a single position")
    best, *others = compared.ranked()
    found = _smooth(modes, best, best.mode)
    doubt, rival = _doubt(modes, best, found, others)
    vouched = doubt <= AMBIGUOUS_MASS
    mode = np.where(vouched, best.mode, -1)
    if found is None or (mode < 0).all():
        texts = [_group(one, names, has_odometry=compared.has_odometry) for one in (best, rival or best)]
        what = "contradict each other" if compared.may_slip else "do not agree on one position"
        why = "" if compared.may_slip else ": has the camera moved? Then leave --at-rest out"
        raise BadInput("inconsistent_evidence", f"{' and '.join(texts)} {what}, and neither is clearly right{why}")
    if (mode != best.mode).any():
        found = _smooth(modes, best, mode) or found
    found = replace(found, covariance_m2=known_m2(found.covariance_m2, vouched))
    return RobustTrack(found, mode, best)


def known_m2(covariance_m2: Array, known: Bools | bool) -> Array:
    """The covariances (..., 2, 2), of positions that are not `known` (...) those of unknown ones."""
    return np.where(np.asarray(known)[..., None, None], covariance_m2, UNKNOWN_M**2 * np.eye(2))


def disagrees(position_m: Array, covariance_m2: Array, other_m: Array, other_m2: Array) -> Bools:
    """Whether other positions (..., 2) are not within the ellipses that hold 99.9 %, or not known as well."""
    known = np.linalg.inv(covariance_m2)
    away = np.einsum("...i,...ij,...j->...", other_m - position_m, known, other_m - position_m)
    wider = np.linalg.eigvals(known @ other_m2).real.max(axis=-1)
    return np.asarray((away > CHI2_999) | (wider > CHI2_999))


def _doubt(
    modes: Sequence[Modes], best: Explanation, found: Smoothed | None, others: Sequence[Explanation],
) -> tuple[Array, Explanation | None]:  # fmt: skip
    """Probability (n,) of explanations of another position of each frame, and the likeliest of these explanations."""
    doubt, rival = np.zeros(len(best.mode)), None
    share = np.array([one.share for one in others])
    differs = np.array([(one.mode != best.mode) | (best.mode < 0) for one in others]).reshape(len(others), len(doubt))
    open_frames = share @ differs > AMBIGUOUS_MASS
    if found is None or not open_frames.any():
        return doubt, None
    for one in (one for one in others if one.share > AMBIGUOUS_MASS / len(others)):
        other = _smooth(modes, one, one.mode)
        away = np.ones(len(doubt), dtype=bool) if other is None else disagrees(
            found.position_m, found.covariance_m2, other.position_m, other.covariance_m2
        )  # fmt: skip
        doubt += one.share * (away & open_frames)
        rival = one if rival is None and (away & open_frames).any() else rival
    return doubt, rival


def _smooth(modes: Sequence[Modes], one: Explanation, mode: Ints) -> Smoothed | None:
    """The estimate by the modes (n,) with the moves of an explanation and its variants; None where no frame has one."""
    chosen = [of[k] if k >= 0 else None for of, k in zip(modes, mode, strict=True)]
    if all(estimate is None for estimate in chosen):
        return None
    parts, share = one.parts
    return mix_smoothed([smooth(chosen, each.steps) for each in parts], share)


def _group(one: Explanation, names: Sequence[str], *, has_odometry: bool) -> str:
    """The frames and the odometry that an explanation takes as right, in words."""
    used = [names[k] if names else f"image {k + 1}" for k in np.flatnonzero(one.mode >= 0).tolist()]
    more = [f"{len(used) - NAMED_FRAMES} more"] if len(used) > NAMED_FRAMES else []
    odometry = ["the odometry"] if has_odometry and not one.moves.fault else []
    return f"({', '.join([*used[:NAMED_FRAMES], *more, *odometry]) or 'no image'})"


def place_modes(
    modes: Sequence[Sequence[FrameEstimate]],
    moves: Sequence[Moves],
    shared: TrackErrors,
    names: Sequence[str] = (),
) -> list[list[FrameEstimate]]:
    """The modes of frames with their positions after the turn and the scaling of a round crater.

    Where its size is not known, positions are products of it: they are expanded about the estimate by the `moves`
    between all frames anew, by odometry as it is stated first. What may be wrong with it is compared where the
    expansion is right. `names` are those of the frames; raises as `conclude`.
    """
    placed = [[shared.place(one) for one in of] for of in modes]
    if not (shared.bends and any(modes)):
        return placed

    def expand(placed: list[list[FrameEstimate]], kinds: Sequence[Moves]) -> tuple[Any, RobustTrack, float]:
        """The modes and the track by `kinds` of moves, and by how much [m] the last expansion moved it."""
        robust = conclude(placed, explain(placed, kinds), names)
        rounds, moved_m = 0, np.inf
        while moved_m > STILL_MOVES_M and rounds < SIZE_ROUNDS:
            before = robust.smoothed
            placed = [
                [shared.place(one, position_m, before.shared) for one in of]
                for of, position_m in zip(modes, before.position_m, strict=True)
            ]
            robust = conclude(placed, explain(placed, kinds), names)
            rounds, moved_m = rounds + 1, float(np.abs(robust.smoothed.position_m - before.position_m).max())
        return placed, robust, moved_m

    if len(moves) > 1:
        with suppress(BadInput):  # wrong as stated: its faults are compared about the stated size
            placed, _, _ = expand(placed, moves[:1])
    placed, robust, moved_m = expand(placed, moves)
    is_size = np.array([name in SIZES for name in shared.names])
    if moved_m > STILL_MOVES_M or np.linalg.norm(robust.smoothed.shared[is_size]) > MOST_SIZE_SIGMAS:
        raise BadInput(
            "inconsistent_evidence",
            "the odometry contradicts what the terrain file states of the crater's size: are its lengths in metres?",
        )
    return placed


def positions_at_rest(
    frames: Sequence[ObservedFrame], terrain: Terrain, errors: TrackErrors
) -> tuple[RobustTrack, Filtered]:
    """The one position by all exposures, and those by each exposure with those before it.

    Single fixes that contradict the others are left out. Errors that exposures share are carried once, those of each
    image apart. Raises ValueError where no exposure has a position, and BadInput (inconsistent_evidence) where half of
    those with a single position or more are elsewhere.
    """
    terrain = terrain.with_steepness(next((frame.steepness_1 for frame in frames if frame.modes), 1.0))
    errors = errors.on(terrain)
    modes = [[errors.place(one) for one in frame.modes] for frame in frames]
    n = len(frames)
    still = Steps(np.zeros((n - 1, 2)), np.full(n - 1, STILL_M))
    compared = explain(modes, [Moves.of(still)], may_slip=False)
    agreeing = conclude(modes, compared, [frame.name for frame in frames])
    _require_majority(frames, agreeing.mode >= 0)
    used = np.flatnonzero(agreeing.mode >= 0).tolist()
    first = used[0]
    first_mode = frames[first].modes[agreeing.mode[first]]
    about = agreeing.smoothed.position_m[first], agreeing.smoothed.covariance_m2[first]
    if errors.bends:  # positions are sampled before they are scaled with the crater
        about = first_mode.mean[:2], first_mode.covariance[:2, :2]
    together = _estimate_together([frames[k] for k in used], first_mode, about, terrain, errors)
    by_all = together[-1]
    known = agreeing.smoothed.covariance_m2[:, 0, 0] < UNKNOWN_M**2  # explanations do not differ
    smoothed = replace(
        by_all, position_m=np.repeat(by_all.position_m, n, axis=0), covariance_m2=known_m2(by_all.covariance_m2, known)
    )  # fmt: skip
    return replace(agreeing, smoothed=smoothed), _filtered_at_rest(together, agreeing.mode, compared)


def _filtered_at_rest(together: Sequence[Smoothed], mode: Ints, compared: Explanations) -> Filtered:
    """The positions by each of n exposures with those before it, of which the modes (n,) are used.

    `together` are the estimates by the first exposure that is used, by the first two of them, and so on.
    """
    count = np.cumsum(mode >= 0)  # of the exposures that are used up to each one
    position = np.array([np.zeros(2), *(one.position_m[0] for one in together)])[count]
    covariance = np.array([UNKNOWN_M**2 * np.eye(2), *(one.covariance_m2[0] for one in together)])[count]
    return Filtered(position, covariance, mode, np.where(count == 1, np.flatnonzero(mode >= 0)[0], -1), compared)


def _require_majority(frames: Sequence[ObservedFrame], is_used: Bools) -> None:
    """Raise BadInput inconsistent_evidence where of the frames with one position half or fewer are used (n,)."""
    is_single = np.array([len(frame.modes) == 1 for frame in frames])
    agree, count = np.count_nonzero(is_single & is_used), np.count_nonzero(is_single)
    if count > 1 and 2 * agree <= count:
        raise BadInput(
            "inconsistent_evidence",
            f"only {agree} of {count} images agree on one position: has the camera moved? Then leave --at-rest out",
        )


def _estimate_together(
    frames: Sequence[ObservedFrame], first_mode: FrameEstimate, about: tuple[Array, Array], terrain: Terrain,
    errors: TrackErrors,
) -> list[Smoothed]:  # fmt: skip
    """The estimates of one position by the first of m frames, by the first two, and so on to all of them (m).

    `first_mode` is the observation by the first frame. The others are by points of the posterior of several exposures,
    sampled from `about`: a position (2,) [m] and its covariance (2, 2).
    """
    found = [_place_one(first_mode, errors)]
    half = max(FRAME_REACH_SIGMAS * largest_sigma(found[0].covariance_m2[0]), LEAST_FRAME_HALF_M)
    models: list[FrameModel] = []
    for k, frame in enumerate(frames):
        if frame.evidence is not None:
            models.append(FrameModel.of_evidence(frame.evidence, terrain, errors, about[0], half))
        if k > 0:
            found.append(_place_one(observe_together(models, sample_together(models, *about)), errors))
    return found


def _place_one(estimate: FrameEstimate, errors: TrackErrors) -> Smoothed:
    """The position and the shared errors by one observation, after the turn and the scaling of a round crater.

    Where its size is not known, the change with the size is taken about the result anew.
    """
    found = smooth([errors.place(estimate)], Steps.unknown(1))
    for _ in range(SIZE_ROUNDS if errors.bends else 0):
        found = smooth([errors.place(estimate, found.position_m[0], found.shared)], Steps.unknown(1))
    return found
