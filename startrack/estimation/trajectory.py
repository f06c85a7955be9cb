"""Positions of a track and the errors that its frames share, by one estimator: at each frame's time, and by all frames.

A Kalman filter has the last position, the errors that frames and moves share, and the errors of all posts and waves of
the map that a recent observation has depended on, in standard deviations. Posts that were not seen for the longest time
are left out, so that memory stays flat; where they are seen again, they count as new. Positions of earlier frames may
follow: each observation moves them by their covariance with the filter's state. That is a fixed-point smoother, whose
last result is the estimate by all frames. Source: Anderson and Moore 1979, Optimal Filtering, 7.2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from startrack.core.types import Array, Bools, Ints
from startrack.estimation.observations import UNKNOWN_M, FrameEstimate, Steps

MOST_POSTS = 2000  # in the state; 40 frames 50 m apart depend on 500
MOST_FOLLOWING = 400  # earlier positions; later frames change those before no more
SIGMAS_95 = float(np.sqrt(-2.0 * np.log(0.05)))  # half axes of the ellipse that holds 95 % of a Gaussian
DIRECTIONS = 256  # over half a turn


@dataclass(eq=False)
class Followers:
    """Positions (m,) of earlier frames, which observations of later ones move, for each of b explanations."""

    mean: Array  # (b, 2 m)
    own: Array  # (b, m, 2, 2) covariances
    cross: Array  # (b, 2 m, s) covariance with the state
    settled: list[tuple[Array, Array]] = field(default_factory=list)  # mean (b, 2) and covariance of those before

    @classmethod
    def none(cls, count: int, size: int) -> Self:
        """Followers before the second frame: none, for a `count` of explanations with a state of this `size`."""
        return cls(np.zeros((count, 0)), np.zeros((count, 0, 2, 2)), np.zeros((count, 0, size)))

    def append(self, mean: Array, covariance: Array) -> None:
        """Append one more position, the first of a state with this mean (b, s) and covariance (b, s, s)."""
        self.mean = np.hstack([self.mean, mean[:, :2]])
        self.own = np.concatenate([self.own, covariance[:, None, :2, :2]], axis=1)
        self.cross = np.concatenate([self.cross, covariance[:, :2]], axis=1)
        if self.own.shape[1] > MOST_FOLLOWING:
            self.settled.append((self.mean[:, :2], self.own[:, 0]))
            self.mean, self.own, self.cross = self.mean[:, 2:], self.own[:, 1:], self.cross[:, 2:]

    def update(self, cross: Array, covariance: Array, residual: Array, gain: Array) -> None:
        """Take in an observation that leaves a `residual` (b, p) of this `covariance` (b, p, p).

        `cross` (b, 2 m, p) is that of the positions with it, `gain` (b, p, s) the state's.
        """
        own_gain = np.linalg.solve(covariance, cross.swapaxes(1, 2))
        self.mean = self.mean + (residual[:, None] @ own_gain)[:, 0]
        self.cross = self.cross - cross @ gain
        b, m, p = len(cross), self.own.shape[1], cross.shape[2]
        self.own = self.own - cross.reshape(b, m, 2, p) @ own_gain.reshape(b, p, m, 2).transpose(0, 2, 1, 3)


@dataclass(eq=False)
class TrackFilter:
    """Estimates by b explanations after the frames so far; moves and observations come in the order of time.

    The state (s,): the last position, the shared errors, those of all moves and of the last leg, and posts.
    """

    mean: Array  # (b, s)
    covariance: Array  # (b, s, s)
    shared_count: int
    moves_count: int  # of errors that all moves share
    leg_count: int  # of errors that the moves of a leg share
    unknown_m: float  # standard deviation of a position about which nothing is known
    posts: dict[int, int] = field(default_factory=dict)  # number of a post to its place in the state
    followers: Followers | None = None

    @classmethod
    def start(
        cls, shared_count: int, moves_count: int = 0, leg_count: int = 0, *, count: int = 1,
        unknown_m: float = UNKNOWN_M, follows: bool = False,
    ) -> Self:  # fmt: skip
        """Filter before the first frame, for a `count` of explanations; `follows`: with positions of earlier frames."""
        size = 2 + shared_count + moves_count + leg_count
        prior = np.diag([unknown_m**2] * 2 + [1.0] * (size - 2))
        return cls(
            np.zeros((count, size)), np.tile(prior, (count, 1, 1)), shared_count, moves_count, leg_count, unknown_m,
            followers=Followers.none(count, size) if follows else None,
        )  # fmt: skip

    @property
    def position_m(self) -> Array:
        """Position (2,) [m] of the last frame, by the first explanation."""
        return self.mean[0, :2].copy()

    @property
    def covariance_m2(self) -> Array:
        """Covariance (2, 2) [m^2] of the last frame's position, by the first explanation."""
        return self.covariance[0, :2, :2].copy()

    def positions(self) -> tuple[Array, Array]:
        """Positions (n, 2) and covariances (n, 2, 2) of all following frames and the last, by the first explanation."""
        last = self.followers or Followers.none(1, 0)
        settled, before = [mean[0] for mean, _ in last.settled], last.mean[0].reshape(-1, 2)
        mean = np.vstack([*settled, before, self.mean[0, :2]])
        return mean, np.stack([*(own[0] for _, own in last.settled), *last.own[0], self.covariance[0, :2, :2]])

    def __getitem__(self, which: Ints | Bools | slice) -> Self:
        """Copy of the explanations of an index, without followers."""
        mean, covariance = self.mean[which].copy(), self.covariance[which].copy()
        return replace(self, mean=mean, covariance=covariance, posts=self.posts.copy(), followers=None)

    @staticmethod
    def join(parts: Sequence[TrackFilter]) -> TrackFilter:
        """Filter with all explanations of several filters, which have the same posts."""
        mean, covariance = (np.concatenate([getattr(one, name) for one in parts]) for name in ("mean", "covariance"))
        return replace(parts[0], mean=mean, covariance=covariance)

    def predict(self, steps: Steps, number: int) -> None:
        """Make the move of this `number` of the `steps`, by all explanations; one that is not known leads anywhere."""
        count, one = len(self.mean), slice(number, number + 1)
        by_shared_m = steps.by_shared_m[one] if self.moves_count else np.zeros((1, 2, 0))
        self.move(*(np.repeat(of, count, axis=0) for of in (steps.move_m[one], steps.sigma_m[one], by_shared_m)))
        if len(steps.begins):
            self.move_by_leg(np.repeat(steps.by_leg_m[one], count, axis=0), is_new=bool(steps.begins[number]))

    def move(self, move_m: Array, sigma_m: Array, by_m: Array) -> None:
        """Make moves (b, 2) with errors of `sigma_m` (b,) on each axis; infinite: not known, they lead anywhere.

        `by_m` (b, 2, f) are their changes by one sigma of each error that all moves share.
        """
        if self.followers is not None:
            self.followers.append(self.mean, self.covariance)
        lost = ~np.isfinite(sigma_m)
        if lost.any():
            self.mean[lost, :2] = 0.0
            self.covariance[lost, :2], self.covariance[lost, :, :2] = 0.0, 0.0
            if self.followers is not None:
                self.followers.cross[lost, :, :2] = 0.0
        first = 2 + self.shared_count
        self._shift(np.where(lost[:, None, None], 0.0, by_m), slice(first, first + self.moves_count))
        self.mean[:, :2] += np.where(lost[:, None], 0.0, move_m)
        self.add_noise(np.where(lost, self.unknown_m, sigma_m))

    def add_noise(self, sigma_m: Array | float) -> None:
        """Add errors of `sigma_m` (b,) [m] on each axis to the uncertainty of the position."""
        self.covariance[:, [0, 1], [0, 1]] += np.square(np.broadcast_to(sigma_m, len(self.mean)))[:, None]

    def move_by_leg(self, by_m: Array, *, is_new: bool) -> None:
        """Move by the errors of the last leg, or of a new one: `by_m` (b, 2, l) by one sigma of each."""
        end = 2 + self.shared_count + self.moves_count + self.leg_count
        leg = slice(end - self.leg_count, end)
        if is_new:
            self._forget(leg)
        self._shift(by_m, leg)

    def forget_moves(self) -> None:
        """Forget the errors that all moves share: another kind of odometry has others, in its sigmas."""
        first = 2 + self.shared_count
        self._forget(slice(first, first + self.moves_count))

    def _forget(self, part: slice) -> None:
        """Forget the errors in a `part` of the state: their prior is all that is known."""
        self.mean[:, part], self.covariance[:, part], self.covariance[:, :, part] = 0.0, 0.0, 0.0
        self.covariance[:, part, part] = np.eye(part.stop - part.start)
        if self.followers is not None:
            self.followers.cross[:, :, part] = 0.0

    def _shift(self, by_m: Array, part: slice) -> None:
        """Move by errors of a `part` of the state: `by_m` (b, 2, f) by one sigma of each."""
        turned = by_m.swapaxes(1, 2)
        self.mean[:, :2] += (by_m @ self.mean[:, part, None])[..., 0]
        self.covariance[:, :2] += by_m @ self.covariance[:, part]
        self.covariance[:, :, :2] += self.covariance[:, :, part] @ turned
        if self.followers is not None:
            self.followers.cross[:, :, :2] += self.followers.cross[:, :, part] @ turned

    def update(self, estimate: FrameEstimate) -> Array:
        """Take in the observation of one frame; returns the logarithm (b,) of its probability density."""
        residual, covariance, cross = self.innovation(estimate)
        gain = np.asarray(np.linalg.solve(covariance, cross.swapaxes(1, 2)), dtype=np.float64)
        if self.followers is not None:
            of_followers = self._with(self.followers.cross, estimate)
            self.followers.update(of_followers, covariance, residual, gain)
        self.mean = self.mean + (residual[:, None] @ gain)[:, 0]
        self.covariance = self.covariance - cross @ gain
        self._forget_posts(estimate)
        return log_normal(residual, covariance)

    def innovation(self, estimate: FrameEstimate) -> tuple[Array, Array, Array]:
        """Observation less prediction (b, p), its covariance (b, p, p), and that of the state with it (b, s, p).

        The state grows by the posts that it does not have.
        """
        self._add_posts([number for number in estimate.post.tolist() if number not in self.posts])
        cross = self._with(self.covariance, estimate)
        predicted = self._with(self.mean[:, None], estimate)[:, 0]
        covariance = self._with(cross.swapaxes(1, 2), estimate) + estimate.noise
        return estimate.mean - predicted, 0.5 * (covariance + covariance.swapaxes(1, 2)), cross

    def _with(self, values: Array, estimate: FrameEstimate) -> Array:
        """Products (b, n, p) of `values` (b, n, s) with the response of the observation to the state."""
        place = [self.posts[number] for number in estimate.post.tolist()]
        found = values[..., : estimate.parameters] @ estimate.response.T
        return found + values[..., place] @ estimate.by_post.T if place else found

    def _add_posts(self, numbers: Sequence[int]) -> None:
        """Add the errors of more posts, of which nothing is known but their prior."""
        if not numbers:
            return
        (count, size), more = self.mean.shape, len(numbers)
        self.posts.update((number, size + k) for k, number in enumerate(numbers))
        self.mean = np.pad(self.mean, ((0, 0), (0, more)))
        grown = np.tile(np.eye(size + more), (count, 1, 1))
        grown[:, :size, :size] = self.covariance
        self.covariance = grown
        if self.followers is not None:
            self.followers.cross = np.pad(self.followers.cross, ((0, 0), (0, 0), (0, more)))

    def _forget_posts(self, estimate: FrameEstimate) -> None:
        """Leave out the posts that were not seen for the longest time, where there are too many."""
        for number in estimate.post.tolist():  # the last ones of the dictionary are the latest
            self.posts[number] = self.posts.pop(number)
        if len(self.posts) > MOST_POSTS:
            kept = list(self.posts)[-(3 * MOST_POSTS // 4) :]
            first = 2 + self.shared_count + self.moves_count + self.leg_count
            place = np.append(np.arange(first), [self.posts[number] for number in kept])
            self.mean, self.covariance = self.mean[:, place], self.covariance[:, place[:, None], place]
            self.posts = {number: first + k for k, number in enumerate(kept)}
            if self.followers is not None:
                self.followers.cross = self.followers.cross[..., place]


@dataclass(frozen=True, eq=False)
class Smoothed:
    """The estimate by all observations."""

    position_m: Array  # (n, 2)
    covariance_m2: Array  # (n, 2, 2)
    shared: Array  # (k,) in standard deviations of their priors
    shared_covariance: Array  # (k, k)


def smooth(estimates: Sequence[FrameEstimate | None], steps: Steps) -> Smoothed:
    """The best positions and shared errors by the frames (n,) that have an estimate, with their covariances.

    Raises ValueError where no frame has one.
    """
    one = next((estimate for estimate in estimates if estimate is not None), None)
    if one is None:
        raise ValueError("no frame has an estimate")
    state = TrackFilter.start(one.parameters - 2, steps.by_shared_m.shape[-1], steps.by_leg_m.shape[-1], follows=True)
    for k, estimate in enumerate(estimates):
        if k:
            state.predict(steps, k - 1)
        if estimate is not None:
            state.update(estimate)
    position_m, covariance_m2 = state.positions()
    shared = slice(2, one.parameters)
    return Smoothed(position_m, covariance_m2, state.mean[0, shared], state.covariance[0, shared, shared])


def mix_smoothed(parts: Sequence[Smoothed], share: Array) -> Smoothed:
    """Estimate by several explanations of the same observations, with their shares (m,)."""
    position = mixed_normal([one.position_m for one in parts], [one.covariance_m2 for one in parts], share)
    shared = mixed_normal([one.shared for one in parts], [one.shared_covariance for one in parts], share)
    return Smoothed(*position, *shared)


def mixed_normal(means: Sequence[Array], covariances: Sequence[Array], share: Array) -> tuple[Array, Array]:
    """Mean (..., d) and covariance (..., d, d) of a mixture of normal distributions with these shares (m,)."""
    mean = np.einsum("m,m...->...", share, means)
    off = np.asarray(means) - mean
    return mean, np.einsum("m,m...->...", share, covariances + off[..., None] * off[..., None, :])


def log_normal(residual: Array, covariance: Array) -> Array:
    """Logarithm of normal densities at residuals (..., p) with covariances (..., p, p)."""
    chi2 = np.einsum("...i,...i->...", residual, np.linalg.solve(covariance, residual[..., None])[..., 0])
    size = residual.shape[-1] * np.log(2.0 * np.pi)
    return np.asarray(-0.5 * (chi2 + size + np.linalg.slogdet(covariance)[1]))


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
    for _ in range(np.finfo(np.float64).nmant):  # to the last digit
        middle = 0.5 * (low + high)
        inside = 1.0 - np.exp(-0.5 * np.square(middle)[:, None] / along).mean(axis=1)
        low, high = np.where(inside < probability, middle, low), np.where(inside < probability, high, middle)
    radius[known] = high
    return radius
