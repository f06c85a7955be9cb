"""Which images, moves and odometry of a track belong together: explanations, compared by their evidence.

An explanation states of each image whether it is of this camera, and which of its positions is right; of each move,
whether the wheels slipped, in it alone or alike in the moves of a leg; and of the odometry, whether it is as stated or
wrong as a whole. Each has a prior (the constants below) and a likelihood: that of the filter without posts, whose
errors count as the image's own. An image that is not of the track is anywhere, or near its place with a gross error.
The moves are turned by the attitude of the last image that an explanation takes as right. In a live track the images
that WINDOW others with a position have followed are settled, unless explanations that matter take them otherwise, or
wrong images agree with each other: the time of an image then stays flat. A whole track settles nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from startrack.applications.tracking.branches import Branches
from startrack.applications.tracking.moves import FREEDOMS, LEG_FREEDOMS, Moves
from startrack.core.types import Array, Ints
from startrack.estimation.observations import FrameEstimate, Steps
from startrack.estimation.trajectory import TrackFilter, log_normal

SLIP_PROBABILITY, SLIP_SIGMA_M = 0.05, 20.0  # of a move by wheel slip, and its size on each axis
LEG_PROBABILITY, LEG_END_PROBABILITY = 0.05, 0.2  # that a leg begins with a move, and that a move of it is its last
STRAIGHT, SLIPS, BEGINS, CONTINUES = range(4)  # what a move is: without slip, with, the first of a leg, another of it
WRONG = np.array([-1, STRAIGHT, 0])  # mode, kind and anchor of a frame before all that are right
WRONG_PROBABILITY, WRONG_SIGMA_M = 1e-3, 200.0  # of a frame, and the error of its position on each axis
FOREIGN_SIGMA_M = 5000.0  # of a position anywhere in a search area, about its middle
MIXED_PROBABILITY, MIXED_PART = 1e-3, 0.1  # of a set with images from elsewhere, and how many of its images these are
ODOMETRY_WRONG_PROBABILITY = 0.01  # as a whole
LEAST_VARIANT = 0.01  # part of an explanation's probability, by other moves, that counts in its positions
WINDOW = 200  # frames with a position, of a live track, that are not settled
SETTLED_DOUBT = 1e-3  # probability of explanations that take a frame otherwise, from which on it is not settled
KEPT_NATS, MOST_KEPT = 60.0, 60  # of explanations beside the best, and for each kind of odometry


@dataclass(frozen=True, eq=False)
class Explanation:
    """One explanation of n frames, with the shares of all that differ in no frame and in no use of the odometry.

    The frames are those that its moves have: all, or the last ones.
    """

    share: float  # of the probability
    moves: Moves
    number: int  # of these moves among the kinds of odometry
    mode: Ints  # (n,) which mode of each frame is right; -1: none
    kind: Ints  # (n - 1,) of each move: STRAIGHT to CONTINUES
    anchor: Ints  # (n - 1,) entry of `Moves.turn` for each move
    position_m: Array  # (2,) of the last frame
    covariance_m2: Array  # (2, 2)
    variants: tuple[Explanation, ...] = ()  # with other moves alone, beside it; their shares are those of this one
    keeps_settled: bool = True  # False: all settled frames are wrong

    @property
    def parts(self) -> tuple[tuple[Explanation, ...], Array]:
        """It and its variants, with the share (m,) of each among them."""
        others = [one.share for one in self.variants]
        return (self, *self.variants), np.array([1.0 - sum(others), *others])

    @property
    def leg(self) -> Ints:
        """(n - 1,) number from 1 of the leg, or of the single move, that slipped; 0: none; -1: begun before them."""
        number = np.cumsum((self.kind == SLIPS) | (self.kind == BEGINS))
        return np.where(self.kind > STRAIGHT, np.where(number > 0, number, -1), 0)

    @property
    def steps(self) -> Steps:
        """The moves with their errors: those that slipped with a larger one, those of a leg with what they share."""
        steps = self.moves.steps(self.anchor)
        sigma_m = np.where(self.kind == SLIPS, np.hypot(steps.sigma_m, SLIP_SIGMA_M), steps.sigma_m)
        return replace(steps, sigma_m=sigma_m, leg=np.where(self.kind >= BEGINS, self.leg, 0))


@dataclass(eq=False)
class Explanations:
    """The likeliest explanations of the frames so far; `add` in the order of time."""

    shared_count: int
    may_slip: bool = True
    window: int = WINDOW  # frames with a position that are not settled
    _settled: list[Ints] = field(default_factory=list)  # of each frame before these, by each odometry (m, 3): `history`
    _frames: list[Sequence[FrameEstimate]] = field(default_factory=list)  # that are not settled
    _with_modes: int = 0  # number of frames that have one
    _moves: Sequence[Moves] = ()
    _first: int = 0  # frame of the first move
    _found: Branches | None = None

    def add(self, modes: Sequence[FrameEstimate], moves: Sequence[Moves], first: int = 0) -> None:
        """One more frame, with one mode, several (ambiguous) or none (refused).

        `moves` are those of each kind of odometry, from frame number `first`, which may be a settled one, to this one
        at least; the first is as stated.
        """
        self._frames.append(modes)
        self._with_modes += bool(modes)
        self._moves, self._first, k = moves, first, self.settled + len(self._frames) - 1
        start = self._start() if self._found is None else self._moved(self._found, k - 1 - first)
        known = np.array([np.isfinite(m.turn[k - first + 1]).all() for m in moves])[start.odometry]
        here = np.where(known, k + 1, start.anchor)
        branches = [self._used(start, number, mode, here) for number, mode in enumerate(modes)]
        if modes:
            branches.append(self._wrong(start, modes))
        else:  # refused; its attitude may be wrong
            doubt = np.where(known, np.log(WRONG_PROBABILITY), -np.inf)
            branches += [_decided(start, start.log_likelihood + np.log1p(-np.exp(doubt)), -1, here)]
            branches += [_decided(start, start.log_likelihood + doubt, -1, start.anchor)] if known.any() else []
        self._found = self._likeliest(Branches.join(branches))
        while sum(map(bool, self._frames)) > self.window and self._settle(self._branches):
            pass

    @property
    def settled(self) -> int:
        """Number of settled frames."""
        return len(self._settled)

    def _settle(self, found: Branches) -> bool:
        """Keep the explanations that take the first frame as the likeliest one does; False where others matter.

        Of those by the same odometry, only the ones with the move to it of their likeliest are kept. While wrong frames
        agree with each other nothing is settled: they may be those of the track when more follow.
        """
        total, taken = self._log_posterior(found), found.history[:, 0]
        share, same = np.exp(total - np.logaddexp.reduce(total)), taken[:, 0] == taken[0, 0]
        if share[~same].sum() > SETTLED_DOUBT or self._second_group(found[:1]) is not None:
            return False
        settled, kept = np.tile(taken[0], (len(self._moves), 1)), np.zeros_like(same)
        for number in np.unique(found.odometry[same]):
            alike = same & (found.odometry == number)
            settled[number] = taken[np.argmax(alike)]
            kept |= alike & (taken == settled[number]).all(axis=1)
        self._settled.append(settled)
        self._frames.pop(0)
        found = found[kept]
        self._found = replace(found, history=found.history[:, 1:], log_wrong=found.log_wrong[:, 1:])
        return True

    @property
    def likeliest(self) -> Explanation:
        """The single explanation by which frames are settled, with a share of 1."""
        return self._explanation(self._branches[:1], 1.0)

    @property
    def has_odometry(self) -> bool:
        """Whether the moves are by odometry, which may have a fault."""
        return len(self._moves) > 1

    @property
    def first(self) -> int:
        """Number of the first frame that `moves` must have when the next one is added: its attitude turns a move."""
        if self._found is None:
            return 0
        anchors = np.append(self._found.history[..., 2].ravel(), self._found.anchor)
        return int(max(min(self.settled, anchors[anchors > 0].min(initial=self.settled)) - 1, 0))

    def ranked(self) -> list[Explanation]:
        """Explanations with their shares, the likeliest first.

        Frames that the likeliest one takes as wrong may be those of the track, if they agree with each other as well.
        """
        found = self._branches
        total = self._log_posterior(found)
        groups: dict[tuple[object, ...], list[int]] = {}
        for b in np.argsort(-total, kind="stable").tolist():
            key = bool(self._moves[found.odometry[b]].fault), found.history[b, :, 0].tobytes()
            groups.setdefault(key, []).append(b)
        weights = [np.logaddexp.reduce(total[group]) for group in groups.values()]
        best = [found[np.array(group[:1])] for group in groups.values()]
        seen: set[object] = set()
        for number, (is_faulty, *_) in enumerate(groups):  # the best with each use of the odometry
            second = None if is_faulty in seen else self._second_group(best[number])
            seen.add(is_faulty)
            if second is not None:
                agreeing, other = second
                weights[number] = np.logaddexp(weights[number], agreeing + self._wrong_prior(best[number].wrong)[0])
                weights.append(agreeing + self._wrong_prior(other.wrong)[0])
                best.append(other)
        share = np.exp(np.array(weights) - np.logaddexp.reduce(weights))
        order = np.argsort(-share, kind="stable").tolist()
        likeliest, *others = (self._explanation(best[g], float(share[g]), keeps_settled=g < len(groups)) for g in order)
        group = list(groups.values())[order[0]] if order[0] < len(groups) else []
        if not likeliest.moves.fault:
            part = np.exp(total[group] - np.logaddexp.reduce(total[group]))
            kept = [(b, p) for b, p in zip(group[1:], part[1:].tolist(), strict=True) if p > LEAST_VARIANT]
            more = tuple(self._explanation(found[np.array([b])], p) for b, p in kept)
            likeliest = replace(likeliest, variants=more)
        return [likeliest, *others]

    @property
    def _branches(self) -> Branches:
        if self._found is None:
            raise ValueError("no frame was added")
        return self._found

    def _explanation(self, one: Branches, share: float, *, keeps_settled: bool = True) -> Explanation:
        number = int(one.odometry[0])
        before = [of[number] if keeps_settled else WRONG for of in self._settled[self._first :]]
        mode, kind, anchor = np.vstack([*before, one.history[0]]).T
        turned_by = np.maximum(anchor[1:] - self._first, 0)
        return Explanation(
            share, self._moves[number], number, mode, kind[1:], turned_by,
            one.state.position_m, one.state.covariance_m2, keeps_settled=keeps_settled,
        )  # fmt: skip

    def _start(self) -> Branches:
        count = len(self._moves)
        state = TrackFilter.start(
            self.shared_count, FREEDOMS, LEG_FREEDOMS, count=count, unknown_m=FOREIGN_SIGMA_M
        )  # fmt: skip
        nothing, none = np.zeros(count), np.zeros(count, dtype=np.int64)
        return Branches(
            state, np.array([m.log_prior for m in self._moves]), nothing[:, None], none, np.arange(count), none,
            np.zeros((count, 1, 3), dtype=np.int64),
        )  # fmt: skip

    @property
    def _free_sigma(self) -> Array:
        return np.r_[FOREIGN_SIGMA_M, FOREIGN_SIGMA_M, np.ones(self.shared_count)]

    def _moved(self, one: Branches, step: int) -> Branches:
        """After a move, with the entry of the next frame in the history; a known move may be one that slipped.

        A leg may begin, and go on, in odometry without a fault as a whole.
        """
        anchor = np.maximum(one.anchor - self._first, 0)
        turn = np.array([self._moves[m].turn[k] for m, k in zip(one.odometry, anchor, strict=True)])
        delta = np.array([m.delta_m[step] for m in self._moves])[one.odometry]
        sigma = np.array([m.sigma_m[step] for m in self._moves])[one.odometry]
        freedom = np.array([m.freedom_m[step] for m in self._moves])[one.odometry]
        move = np.einsum("bij,bj->bi", turn, delta)[:, :2]
        sigma = np.where(np.isfinite(move).all(axis=1), sigma, np.inf)
        lost, state = np.isinf(sigma), one.state[:]
        state.move(move, sigma, (turn @ freedom)[:, :2])
        entry = np.stack([np.zeros_like(one.anchor), np.zeros_like(one.anchor), one.anchor], axis=-1)
        history = np.concatenate([one.history, entry[:, None]], axis=1)
        moved = replace(one, state=state, log_wrong=np.pad(one.log_wrong, ((0, 0), (0, 1))), history=history)
        if not self.may_slip:
            return moved
        may_begin = ~lost & np.array([m.has_legs and not m.fault for m in self._moves])[one.odometry]
        in_leg = one.history[:, -1, 1] >= BEGINS
        ended = np.where(in_leg, np.log(LEG_END_PROBABILITY), 0.0)  # a move that is not known ends a leg too
        slips = np.where(may_begin, SLIP_PROBABILITY + LEG_PROBABILITY, SLIP_PROBABILITY)
        by_leg = (turn @ np.array([m.leg_m[step] for m in self._moves])[one.odometry])[:, :2]
        parts = []
        for kind, may, log_prior in (
            (STRAIGHT, np.ones_like(lost), np.where(lost, 0.0, ended + np.log1p(-slips))),
            (SLIPS, ~lost, ended + np.log(SLIP_PROBABILITY)),
            (BEGINS, may_begin, ended + np.log(LEG_PROBABILITY)),
            (CONTINUES, ~lost & in_leg, np.full(len(lost), np.log1p(-LEG_END_PROBABILITY))),
        ):
            branches = moved[may]
            branches.log_likelihood += log_prior[may]
            branches.history[:, -1, 1] = kind
            if kind == SLIPS:
                branches.state.add_noise(SLIP_SIGMA_M)
            elif kind != STRAIGHT:
                branches.state.move_by_leg(by_leg[may], is_new=kind == BEGINS)
            parts.append(branches)
        return Branches.join(parts)

    def _used(self, one: Branches, number: int, mode: FrameEstimate, anchor: Ints) -> Branches:
        found = _decided(one, one.log_likelihood + np.log(mode.weight), number, anchor)
        found.log_likelihood += found.state.update(mode.without_posts)
        return found

    def _wrong(self, one: Branches, modes: Sequence[FrameEstimate]) -> Branches:
        """The frame is not of the track: anywhere, or near with a gross error; its shared errors are its own."""
        near, free = np.r_[[WRONG_SIGMA_M**2] * 2, np.ones(self.shared_count)], np.square(self._free_sigma)
        parts = []
        for mode in (mode.without_posts for mode in modes):
            residual, covariance, _ = one.state.innovation(mode)
            gross = covariance + (mode.response * near) @ mode.response.T
            anywhere = log_normal(mode.mean, (mode.response * free) @ mode.response.T + mode.noise)
            either = np.logaddexp(log_normal(residual, gross), anywhere) - np.log(2.0)
            parts.append(np.log(mode.weight) + either)
        likelihood = np.logaddexp.reduce(parts)
        found = _decided(one, one.log_likelihood + likelihood, -1, one.anchor)
        found.log_wrong, found.wrong = one.log_wrong.copy(), one.wrong + 1
        found.log_wrong[:, -1] = likelihood
        return found

    def _log_posterior(self, found: Branches) -> Array:
        """Logarithm (b,) of the posterior of each explanation, without its norm."""
        return np.asarray(found.log_likelihood + self._wrong_prior(found.wrong))

    def _wrong_prior(self, wrong: Ints) -> Array:
        """Logarithm of the prior of so many wrong frames: single ones, or a set with images from elsewhere."""
        right, parts = self._with_modes - wrong, []
        for probability, part in ((1.0 - MIXED_PROBABILITY, WRONG_PROBABILITY), (MIXED_PROBABILITY, MIXED_PART)):
            parts.append(np.log(probability) + wrong * np.log(part) + right * np.log1p(-part))
        return np.asarray(np.logaddexp(*parts))

    def _likeliest(self, found: Branches) -> Branches:
        total = self._log_posterior(found)
        order = np.argsort(-total, kind="stable")
        order = order[total[order] > total.max() - KEPT_NATS]
        kind = found.odometry[order]
        place = np.cumsum(kind[:, None] == np.arange(len(self._moves)), axis=0)[np.arange(len(kind)), kind]
        return found[order[place <= MOST_KEPT]]

    def _second_group(self, best: Branches) -> tuple[float, Branches] | None:
        """Log-likelihood of `best` where its wrong frames are a track of their own, and the explanation by that one.

        None where fewer than two are wrong of those that are not settled, or they do not agree.
        """
        has_modes = np.array([bool(modes) for modes in self._frames])
        out, settled = best.history[0, :, 0] < 0, self.settled
        wrong = np.count_nonzero(out & has_modes)
        if wrong < 2:
            return None
        alone = Explanations(self.shared_count, self.may_slip, window=len(out))
        start = replace(self._moves[best.odometry[0]].part(settled - self._first, len(out)), log_prior=0.0)
        start.turn[1:][~out] = np.nan
        for modes, is_out in zip(self._frames, out, strict=True):
            alone.add(modes if is_out else (), [start])
        other = alone._branches
        other = other[other.wrong == 0]
        if not len(other.wrong):
            return None
        other, as_wrong = other[np.argsort(-other.log_likelihood)[:1]], float(best.log_wrong[0].sum())
        if other.log_likelihood[0] < as_wrong:
            return None
        other.history[..., 2] += np.where(other.history[..., 2] > 0, settled, 0)
        other.odometry, other.wrong = best.odometry, np.full_like(best.wrong, self._with_modes - wrong)
        return float(best.log_likelihood[0] - as_wrong + other.log_likelihood[0]), other


def explain(modes: Sequence[Sequence[FrameEstimate]], moves: Sequence[Moves], *, may_slip: bool = True) -> Explanations:
    """The explanations of frames with these `modes`, with the `moves` between all of them by each kind of odometry.

    `may_slip`: whether moves may slip; at rest they do not.
    """
    found = Explanations(next((of[0].parameters for of in modes if of), 2) - 2, may_slip, window=len(modes))
    for of in modes:
        found.add(of, moves)
    return found


def _decided(one: Branches, log_likelihood: Array, mode: int, anchor: Ints) -> Branches:
    """The same with a decision about the last frame."""
    history = one.history.copy()
    history[:, -1, 0] = mode
    return replace(one, state=one.state[:], log_likelihood=log_likelihood, anchor=anchor, history=history)
