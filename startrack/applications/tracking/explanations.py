"""Explanations of a track: which images, moves and odometry belong together, compared by their evidence.

An explanation states of each image whether it is of this track, and which of its positions is right, of another drive
in the form of the odometry, or of neither: anywhere, or near its place with a gross error. It states of each move
whether the wheels slipped, in it alone or alike in the moves of a leg; and of the odometry, whether it is as stated or
wrong as a whole. Each has a prior (the constants below) and a likelihood: that of filters of both drives without posts,
whose errors count as the image's own. The track is the drive with more images; an explanation in which it is the other
one is compared too. Moves are turned by the attitude of the last image that is of the drive. In a live track the images
that WINDOW others with a position have followed are settled, unless explanations that matter take them otherwise: the
time of an image then stays flat. A whole track settles nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from startrack.applications.tracking.odometry import FREEDOMS, LEG_FREEDOMS, Moves, turned
from startrack.core.types import Array, Bools, Ints
from startrack.estimation.observations import FrameEstimate, Steps
from startrack.estimation.trajectory import TrackFilter, log_normal

SLIP_PROBABILITY, SLIP_SIGMA_M = 0.05, 20.0  # of a move by wheel slip, and its size on each axis
LEG_PROBABILITY, LEG_END_PROBABILITY = 0.05, 0.2  # that a leg begins with a move, and that a move of it is its last
STRAIGHT, SLIPS, BEGINS, CONTINUES = range(4)  # what a move is: without slip, with, the first of a leg, another of it
WRONG_PROBABILITY, WRONG_SIGMA_M = 1e-3, 200.0  # of a frame, and the error of its position on each axis
FOREIGN_SIGMA_M = 5000.0  # of a position anywhere in a search area, about its middle
MIXED_PROBABILITY, MIXED_PART = 1e-3, 0.1  # of a set with images from elsewhere, and how many of its images these are
LEAST_VARIANT = 0.01  # part of an explanation's probability, by other moves, that counts in its positions
WINDOW = 200  # frames with a position, of a live track, that are not settled
MOST_WAITING = 10  # times as many frames wait at most, refused ones included: memory stays flat
SETTLED_DOUBT = 1e-3  # probability of explanations that take a frame otherwise, from which on it is not settled
KEPT_NATS, MOST_KEPT = 60.0, 60  # of explanations beside the best, and for each kind of odometry
OF_MOVE = "delta_m", "sigma_m", "freedom_m"
MODE, KIND, ANCHOR = 0, slice(1, 3), slice(3, 5)  # of a frame in the history: kinds and anchors of both drives


@dataclass(frozen=True, eq=False)
class Explanation:
    """Explanation of n frames, with the share of all that differ from it in no frame and in no use of the odometry.

    The frames are those that its moves have: all, or the last ones.
    """

    share: float  # of the probability
    moves: Moves
    number: int  # of these moves among the kinds of odometry
    drive: int  # 0, 1: which of the two drives is the track
    mode: Ints  # (n,) which mode of each frame is right; -1: none
    kind: Ints  # (n - 1,) of each move: STRAIGHT to CONTINUES
    anchor: Ints  # (n - 1,) entry of `Moves.turn` for each move
    position_m: Array  # (2,) of the last frame
    covariance_m2: Array  # (2, 2)
    variants: tuple[Explanation, ...] = ()  # with other moves alone, beside it; their shares are those of this one

    @property
    def parts(self) -> tuple[tuple[Explanation, ...], Array]:
        """This explanation and its variants, m together, and the share (m,) of each among them."""
        others = [one.share for one in self.variants]
        return (self, *self.variants), np.array([1.0 - sum(others), *others])

    @property
    def leg(self) -> Ints:
        """Number (n - 1,), from 1, of the leg, or single move, that slipped; 0: none, or a leg begun before these."""
        return np.where(self.kind > STRAIGHT, np.cumsum((self.kind == SLIPS) | (self.kind == BEGINS)), 0)

    @property
    def steps(self) -> Steps:
        """Moves with their errors: a larger one where the wheels slipped, and what the moves of a leg share."""
        steps = self.moves.steps(self.anchor)
        sigma_m = np.where(self.kind == SLIPS, np.hypot(steps.sigma_m, SLIP_SIGMA_M), steps.sigma_m)
        by_leg_m = np.where((self.kind >= BEGINS)[:, None, None], steps.by_leg_m, 0.0)
        return replace(steps, sigma_m=sigma_m, by_leg_m=by_leg_m, begins=self.kind == BEGINS)


@dataclass(eq=False)
class Branches:
    """Explanations (b,) of the frames so far, as they grow frame by frame."""

    track: TrackFilter  # their estimates
    other: TrackFilter  # of another drive, which has no slips
    log_likelihood: Array  # (b,) with all priors but that of wrong frames
    count: Ints  # (b, 2) of frames of the track, and of the other drive
    odometry: Ints  # (b,) which moves
    drive: Ints  # (b,) 0, or 1 where the track and the other drive have changed places
    anchor: Ints  # (b, 2) number from 1 of the frame whose attitude turns the next move of each; 0: none
    history: Ints  # (b, w, 5) of the last frames: mode (of the other drive -2 - mode; -1: of none), kinds and anchors

    def __getitem__(self, which: Ints | Bools | slice) -> Branches:
        """Branches that the index, mask or slice `which` selects."""
        return Branches(*(part[which] for part in self._parts))

    @property
    def _parts(self) -> tuple[Any, ...]:
        """Values of all fields, in their order."""
        return tuple(getattr(self, f.name) for f in fields(self))

    def swapped(self) -> Branches:
        """Copy with the other drive as the track."""
        return Branches(
            self.other[:], self.track[:], self.log_likelihood, self.count[:, ::-1], self.odometry, 1 - self.drive,
            self.anchor[:, ::-1], swap(self.history),
        )  # fmt: skip

    def decided(self, mode: int, side: int = 0, anchor: Ints | None = None) -> Branches:
        """Copy with `mode` decided for the last frame; `anchor` (b,) is the next one of the drive of this `side`."""
        found = self[np.arange(len(self.drive))]
        found.history[:, -1, MODE] = mode
        if anchor is not None:
            found.anchor[:, side] = anchor
        return found

    @staticmethod
    def join(parts: Sequence[Branches]) -> Branches:
        """Branches of several `parts`, one part after the other."""
        track, other, *decisions = zip(*(one._parts for one in parts), strict=True)
        return Branches(TrackFilter.join(track), TrackFilter.join(other), *map(np.concatenate, decisions))


@dataclass(eq=False)
class Explanations:
    """The likeliest explanations of the frames so far; frames are added in the order of time."""

    shared_count: int
    may_slip: bool = True
    window: int = WINDOW  # frames with a position that are not settled
    _settled: list[Ints] = field(default_factory=list)  # of each frame before these, by each odometry (m, 5): `history`
    _frames: list[Sequence[FrameEstimate]] = field(default_factory=list)  # that are not settled
    _with_modes: int = 0  # number of frames that have one
    _moves: Sequence[Moves] = ()
    _first: int = 0  # frame of the first move
    _found: Branches | None = None

    def add(self, modes: Sequence[FrameEstimate], moves: Sequence[Moves], first: int = 0) -> None:
        """Add one more frame, with one mode, several (ambiguous) or none (refused).

        `moves` are those of each kind of odometry, from frame number `first`, which may be a settled one, to this one
        at least; the first is as stated.
        """
        self._frames.append(modes)
        self._with_modes += bool(modes)
        self._moves, self._first, k = moves, first, self.settled + len(self._frames) - 1
        start = self._start() if self._found is None else self._moved(self._found, k - 1 - first)
        known = np.array([np.isfinite(m.turn[k - first + 1]).all() for m in moves])[start.odometry]
        here = np.where(known[:, None], k + 1, start.anchor)
        if modes:
            begun = (start.count[:, 0] > 0) & ~self._has_fault[start.odometry]  # the first image is that of the track
            branches = [self._used(start, 0, number, mode, here) for number, mode in enumerate(modes)]
            branches += [self._used(start[begun], 1, number, mode, here[begun]) for number, mode in enumerate(modes)]
            branches += [self._wrong(start, modes)]
        else:  # refused; its attitude may be wrong
            doubt = np.where(known, np.log(WRONG_PROBABILITY), -np.inf)
            right, wrong = start.decided(-1, 0, here[:, 0]), start.decided(-1)[known]
            right.log_likelihood += np.log1p(-np.exp(doubt))
            wrong.log_likelihood += doubt[known]
            branches = [right, wrong]
        self._found = self._likeliest(Branches.join(branches))
        while self._has_overflown() and self._settle():
            pass

    def _has_overflown(self) -> bool:
        """Whether more frames wait than the window has, with a position or, after many refusals, at all."""
        return sum(map(bool, self._frames)) > self.window or len(self._frames) > MOST_WAITING * self.window

    @property
    def settled(self) -> int:
        """Number of settled frames."""
        return len(self._settled)

    def _settle(self) -> bool:
        """Keep the explanations that take the first frame as the likeliest one does; False where others matter.

        Among those by the same odometry, only the ones with the move to it of their likeliest are kept.
        """
        both, found = self._both, self._branches
        total, mode = self._log_posterior(both), np.maximum(both.history[:, 0, MODE], -1)
        if np.exp(total - np.logaddexp.reduce(total))[mode != mode[0]].sum() > SETTLED_DOUBT:
            return False
        taken = np.where(found.drive[:, None] == 1, swap(found.history[:, 0]), found.history[:, 0])
        settled, kept = np.tile(taken[0], (len(self._moves), 1)), np.zeros(len(taken), dtype=bool)
        same = taken[:, MODE] == taken[0, MODE]
        for number in np.unique(found.odometry[same]):
            alike = same & (found.odometry == number)
            settled[number] = taken[np.argmax(alike)]
            kept |= alike & (taken == settled[number]).all(axis=1)
        self._settled.append(settled)
        self._frames.pop(0)
        found = found[kept]
        found.anchor[found.anchor[:, 1] <= self.settled, 1] = 0  # the next move of the other drive leads anywhere
        self._found = replace(found, history=found.history[:, 1:])
        return True

    @property
    def likeliest(self) -> tuple[Explanation, Explanation]:
        """Explanations of both drives, each as the track, by the single branch that settles frames."""
        best = self._branches[:1]
        first, second = (self._explanation(one, 1.0) for one in (best, best.swapped()))
        return (second, first) if first.drive else (first, second)

    @property
    def has_odometry(self) -> bool:
        """Whether the moves are by odometry, which may have a fault."""
        return len(self._moves) > 1

    @property
    def first(self) -> int:
        """Number of the first frame that `moves` must have when the next one is added: its attitude turns a move."""
        if self._found is None:
            return 0
        anchors = np.append(self._found.history[..., ANCHOR].ravel(), self._found.anchor)
        return int(max(min(self.settled, anchors[anchors > 0].min(initial=self.settled)) - 1, 0))

    def ranked(self) -> list[Explanation]:
        """Explanations with their shares, the likeliest first."""
        found = self._both
        total = self._log_posterior(found)
        groups: dict[tuple[object, ...], list[int]] = {}
        mode = np.maximum(found.history[..., MODE], -1)
        for b in np.argsort(-total, kind="stable").tolist():
            key = bool(self._moves[found.odometry[b]].fault), int(found.drive[b]), mode[b].tobytes()
            groups.setdefault(key, []).append(b)
        weights = np.array([np.logaddexp.reduce(total[group]) for group in groups.values()])
        share = np.exp(weights - np.logaddexp.reduce(weights))
        ordered = [list(groups.values())[g] for g in np.argsort(-share, kind="stable")]
        likeliest, *others = (
            self._explanation(found[np.array(group[:1])], float(part))
            for group, part in zip(ordered, np.sort(share)[::-1], strict=True)
        )
        if not likeliest.moves.fault:
            part = np.exp(total[ordered[0]] - np.logaddexp.reduce(total[ordered[0]]))
            kept = [(b, p) for b, p in zip(ordered[0][1:], part[1:].tolist(), strict=True) if p > LEAST_VARIANT]
            more = tuple(self._explanation(found[np.array([b])], p) for b, p in kept)
            likeliest = replace(likeliest, variants=more)
        return [likeliest, *others]

    @property
    def _branches(self) -> Branches:
        """Branches of the frames so far. Raises ValueError where no frame was added."""
        if self._found is None:
            raise ValueError("no frame was added")
        return self._found

    @property
    def _has_fault(self) -> Bools:
        """Whether each kind of odometry (kinds,) has a fault as a whole."""
        return np.array([bool(m.fault) for m in self._moves])

    @property
    def _both(self) -> Branches:
        """Branches, and behind them, swapped, those whose other drive has frames."""
        found = self._branches
        return Branches.join([found, found[found.count[:, 1] > 0].swapped()])

    def _explanation(self, one: Branches, share: float) -> Explanation:
        """Explanation by the single branch `one`, with its settled frames and its `share`."""
        number, drive = int(one.odometry[0]), int(one.drive[0])
        before = [swap(of[number]) if drive else of[number] for of in self._settled[self._first :]]
        mode, kind, _, anchor, _ = np.vstack([*before, one.history[0]]).T
        return Explanation(
            share, self._moves[number], number, drive, np.maximum(mode, -1), kind[1:],
            np.maximum(anchor[1:] - self._first, 0), one.track.position_m, one.track.covariance_m2,
        )  # fmt: skip

    def _start(self) -> Branches:
        """Branches at the first frame: one for each kind of odometry."""
        n = len(self._moves)
        track = TrackFilter.start(self.shared_count, FREEDOMS, LEG_FREEDOMS, count=n, unknown_m=FOREIGN_SIGMA_M)
        none, pair = np.zeros(n, dtype=np.int64), np.zeros((n, 2), dtype=np.int64)
        prior = np.array([m.log_prior for m in self._moves])
        return Branches(
            track, track[:], prior, pair, np.arange(n), none, pair, np.zeros((n, 1, 5), dtype=np.int64)
        )  # fmt: skip

    def _moved(self, one: Branches, step: int) -> Branches:
        """Branches after a move, with the entry of the next frame in the history; a known move may be one that slipped.

        A leg may begin, and go on, in odometry without a fault as a whole.
        """
        moved, parts = one[np.arange(len(one.drive))], []
        own = [np.array([getattr(m, name)[step] for m in self._moves])[one.odometry] for name in OF_MOVE]
        for side, state in enumerate((moved.track, moved.other)):
            anchor = np.maximum(one.anchor[:, side] - self._first, 0)
            turn = np.array([self._moves[m].turn[k] for m, k in zip(one.odometry, anchor, strict=True)])
            parts.append(turned(turn, *own))
            state.move(*parts[side][:3])
        lost, by_leg = np.isinf(parts[0][1]), parts[0][3]
        entry = np.zeros((len(one.drive), 1, 5), dtype=np.int64)
        entry[:, 0, ANCHOR] = one.anchor
        moved.history = np.concatenate([one.history, entry], axis=1)
        if not self.may_slip:
            return moved
        may_begin = ~lost & (np.array([m.has_legs for m in self._moves]) & ~self._has_fault)[one.odometry]
        in_leg = one.history[:, -1, KIND][:, 0] >= BEGINS
        ended = np.where(in_leg, np.log(LEG_END_PROBABILITY), 0.0)  # a move that is not known ends a leg too
        slips = np.where(may_begin, SLIP_PROBABILITY + LEG_PROBABILITY, SLIP_PROBABILITY)
        branched = []
        for kind, may, log_prior in (
            (STRAIGHT, np.ones_like(lost), np.where(lost, 0.0, ended + np.log1p(-slips))),
            (SLIPS, ~lost, ended + np.log(SLIP_PROBABILITY)),
            (BEGINS, may_begin, ended + np.log(LEG_PROBABILITY)),
            (CONTINUES, ~lost & in_leg, np.full(len(lost), np.log1p(-LEG_END_PROBABILITY))),
        ):
            branches = moved[may]
            branches.log_likelihood += log_prior[may]
            branches.history[:, -1, KIND] = kind, STRAIGHT
            if kind == SLIPS:
                branches.track.add_noise(SLIP_SIGMA_M)
            elif kind != STRAIGHT:
                branches.track.move_by_leg(by_leg[may], is_new=kind == BEGINS)
            branched.append(branches)
        return Branches.join(branched)

    def _used(self, one: Branches, side: int, number: int, mode: FrameEstimate, here: Ints) -> Branches:
        """Branches by whose decision the frame is of the drive of this `side`: of the track, or of the other one."""
        found = one.decided(-2 - number if side else number, side, here[:, side])
        found.log_likelihood += np.log(mode.weight) + (found.track, found.other)[side].update(mode.without_posts)
        found.count[:, side] += 1
        return found

    def _wrong(self, one: Branches, modes: Sequence[FrameEstimate]) -> Branches:
        """Branches by whose decision the frame is of neither drive: anywhere, or near with a gross error."""
        free = np.ones(self.shared_count)
        near, far = (np.r_[sigma_m**2, sigma_m**2, free] for sigma_m in (WRONG_SIGMA_M, FOREIGN_SIGMA_M))
        parts = []
        for mode in (mode.without_posts for mode in modes):
            residual, covariance, _ = one.track.innovation(mode)
            gross = covariance + (mode.response * near) @ mode.response.T
            anywhere = log_normal(mode.mean, (mode.response * far) @ mode.response.T + mode.noise)
            either = np.logaddexp(log_normal(residual, gross), anywhere) - np.log(2.0)
            parts.append(np.log(mode.weight) + either)
        found = one.decided(-1)
        found.log_likelihood += np.logaddexp.reduce(parts)
        return found

    def _log_posterior(self, found: Branches) -> Array:
        """Logarithm (b,) of the posterior of each explanation, without its norm.

        Wrong frames are single ones, or those of a set with images from elsewhere; of each, half are of another drive.
        """
        right, parts = found.count[:, 0], []
        for probability, part in ((1.0 - MIXED_PROBABILITY, WRONG_PROBABILITY), (MIXED_PROBABILITY, MIXED_PART)):
            wrong = (self._with_modes - right) * np.log(0.5 * part)
            parts.append(np.log(probability) + wrong + right * np.log1p(-part))
        return np.asarray(found.log_likelihood + np.logaddexp(*parts))

    def _likeliest(self, found: Branches) -> Branches:
        """The explanations that are kept, the likeliest first, each with the drive with more frames as the track."""
        larger = found.count[:, 1] > found.count[:, 0]
        if larger.any():
            found = Branches.join([found[~larger], found[larger].swapped()])
        total = self._log_posterior(found)
        order = np.argsort(-total, kind="stable")
        order = order[total[order] > total.max() - KEPT_NATS]
        kind = found.odometry[order]
        place = np.cumsum(kind[:, None] == np.arange(len(self._moves)), axis=0)[np.arange(len(kind)), kind]
        return found[order[place <= MOST_KEPT]]


def swap(history: Ints) -> Ints:
    """Entries (..., 5) of a history with the track and the other drive exchanged."""
    found = history[..., [0, 2, 1, 4, 3]]
    found[..., MODE] = -2 - found[..., MODE]
    return found


def explain(modes: Sequence[Sequence[FrameEstimate]], moves: Sequence[Moves], *, may_slip: bool = True) -> Explanations:
    """The explanations of frames with these `modes`, with the `moves` between all of them by each kind of odometry.

    `may_slip`: whether moves may slip; at rest they do not.
    """
    found = Explanations(next((of[0].parameters for of in modes if of), 2) - 2, may_slip, window=len(modes))
    for of in modes:
        found.add(of, moves)
    return found
