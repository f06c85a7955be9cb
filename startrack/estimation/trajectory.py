"""Positions of a track and the errors that its frames share: known at each frame's own time, and by all frames.

The first is a Kalman filter over the last position, the shared errors, and the errors of all posts that a recent
observation has depended on, in standard deviations. Posts that were not seen for the longest time are left out, so that
memory stays flat; where they are seen again, they count as new. The second is generalised least squares; given all
observations, the estimates of the errors of the map's posts follow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from startrack.core.types import Array, Ints
from startrack.estimation.observations import UNKNOWN_M, FrameEstimate, Observations, Steps, inverse

MOST_POSTS = 2000  # in the state; 40 frames 50 m apart depend on 500
SIGMAS_95 = float(np.sqrt(-2.0 * np.log(0.05)))  # half axes of the ellipse that holds 95 % of a Gaussian
DIRECTIONS = 256  # over half a turn


@dataclass(eq=False)
class TrackFilter:
    """Estimates after the frames so far; `predict` and `update` in the order of time.

    The state: the last position, the shared errors, those of all moves and of the last leg, and posts.
    """

    shared_count: int
    moves_count: int = 0  # of errors that all moves share, and then of the last leg
    mean: Array = field(init=False)
    covariance: Array = field(init=False)
    posts: dict[int, int] = field(default_factory=dict)  # number of a post to its place in the state

    def __post_init__(self) -> None:
        self.mean = np.zeros(self._first_post)
        self.covariance = np.diag([UNKNOWN_M**2] * 2 + [1.0] * (self._first_post - 2))

    @property
    def _first_post(self) -> int:
        return 2 + self.shared_count + self.moves_count

    @property
    def position_m(self) -> Array:
        """(2,) of the last frame."""
        return self.mean[:2].copy()

    @property
    def covariance_m2(self) -> Array:
        """(2, 2) of the last frame."""
        return self.covariance[:2, :2].copy()

    def predict(self, steps: Steps, number: int) -> None:
        """The camera made the move of this `number`; one that is not known leads anywhere."""
        sigma_m, move_m = float(steps.sigma_m[number]), steps.move_m[number]
        if not np.isfinite(sigma_m):
            self.mean[:2] = 0.0
            self.covariance[:2], self.covariance[:, :2] = 0.0, 0.0
            sigma_m = UNKNOWN_M
        elif self.moves_count:
            shared, by = slice(2 + self.shared_count, self._first_post), steps.by_shared_m[number]
            if len(steps.leg):
                if steps.leg[number] > steps.leg[:number].max(initial=0):
                    self._forget(slice(self._first_post - steps.by_leg_m.shape[-1], self._first_post))
                by = np.hstack([by, steps.by_leg_m[number] * (steps.leg[number] > 0)])
            move_m = move_m + by @ self.mean[shared]
            self.covariance[:2] += by @ self.covariance[shared]
            self.covariance[:, :2] += self.covariance[:, shared] @ by.T
        self.mean[:2] += move_m
        self.covariance[[0, 1], [0, 1]] += sigma_m**2

    def _forget(self, part: slice) -> None:
        """These errors are those of a new leg."""
        self.mean[part] = 0.0
        self.covariance[part], self.covariance[:, part] = 0.0, 0.0
        self.covariance[part, part] = np.eye(part.stop - part.start)

    def update(self, estimate: FrameEstimate) -> None:
        """Take in the observation of one frame."""
        residual, covariance, cross = self.innovation(estimate)
        gain = np.linalg.solve(covariance, cross.T).T
        self.mean = self.mean + gain @ residual
        self.covariance -= gain @ cross.T
        for number in estimate.post.tolist():  # the last ones of the dictionary are the latest
            self.posts[number] = self.posts.pop(number)
        if len(self.posts) > MOST_POSTS:  # those that were not seen for the longest time are left out
            kept, first = list(self.posts)[-(3 * MOST_POSTS // 4) :], self._first_post
            place = np.append(np.arange(first), [self.posts[number] for number in kept])
            self.mean, self.covariance = self.mean[place], self.covariance[np.ix_(place, place)]
            self.posts = {number: first + k for k, number in enumerate(kept)}

    def innovation(self, estimate: FrameEstimate) -> tuple[Array, Array, Array]:
        """Observation less prediction (p,), its covariance (p, p), and that of the state with it (s, p).

        The state grows by the posts that it does not have.
        """
        size, new = len(self.mean), [number for number in estimate.post.tolist() if number not in self.posts]
        if new:
            self.posts.update((number, size + k) for k, number in enumerate(new))
            self.mean = np.append(self.mean, np.zeros(len(new)))
            grown = np.eye(len(self.mean))
            grown[:size, :size] = self.covariance
            self.covariance = grown
        place = np.array([self.posts[number] for number in estimate.post.tolist()], dtype=np.int64)
        p, by_post = estimate.parameters, estimate.by_post
        cross = self.covariance[:, :p] @ estimate.response.T + self.covariance[:, place] @ by_post.T
        predicted = estimate.response @ self.mean[:p] + by_post @ self.mean[place]
        covariance = estimate.response @ cross[:p] + by_post @ cross[place] + estimate.noise
        return estimate.mean - predicted, 0.5 * (covariance + covariance.T), cross


@dataclass(frozen=True, eq=False)
class Smoothed:
    """The estimate by all observations."""

    position_m: Array  # (n, 2)
    covariance_m2: Array  # (n, 2, 2)
    shared: Array  # (k,) in standard deviations of their priors
    shared_covariance: Array  # (k, k)
    post: Ints  # (c,) numbers of the posts that the observations depend on
    post_error: Array  # (c,) in their standard deviations
    post_sigma: Array  # (c,) of these


def mixed_normal(means: Sequence[Array], covariances: Sequence[Array], share: Array) -> tuple[Array, Array]:
    """Mean (..., d) and covariance (..., d, d) of a mixture of normal distributions with these shares (m,)."""
    mean = np.einsum("m,m...->...", share, means)
    off = np.asarray(means) - mean
    return mean, np.einsum("m,m...->...", share, covariances + off[..., None] * off[..., None, :])


def mix_smoothed(parts: Sequence[Smoothed], share: Array) -> Smoothed:
    """The estimate by several explanations of the same observations, with their shares (m,)."""
    position = mixed_normal([one.position_m for one in parts], [one.covariance_m2 for one in parts], share)
    shared = mixed_normal([one.shared for one in parts], [one.shared_covariance for one in parts], share)
    errors = [one.post_error[:, None] for one in parts]
    post = mixed_normal(errors, [np.square(one.post_sigma)[:, None, None] for one in parts], share)
    return Smoothed(*position, *shared, parts[0].post, post[0][:, 0], np.sqrt(post[1][:, 0, 0]))


def smooth(observations: Observations, steps: Steps) -> Smoothed:
    """The best positions and shared errors, with their covariances. Cost: the third power of the number of frames."""
    n, known = observations.count, np.isfinite(steps.sigma_m)
    weight = np.where(known, 1.0 / np.square(np.where(known, steps.sigma_m, 1.0)), 0.0)
    by_each_m = steps.by_each_m
    size, more = len(observations.target), by_each_m.shape[-1]
    information, target = np.eye(size + more), np.append(observations.target, np.zeros(more))
    information[:size, :size] = observations.information
    for axis in range(2):
        left, right = 2 * np.arange(n - 1) + axis, 2 * np.arange(n - 1) + 2 + axis
        for a, b, sign in ((left, left, 1.0), (right, right, 1.0), (left, right, -1.0), (right, left, -1.0)):
            information[a, b] += sign * weight
        np.subtract.at(target, left, weight * steps.move_m[:, axis])
        np.add.at(target, right, weight * steps.move_m[:, axis])
    if more:
        by, left = by_each_m.reshape(-1, more), np.arange(2 * (n - 1))
        weighted = np.repeat(weight, 2)[:, None] * by
        for at, sign in ((left, 1.0), (left + 2, -1.0)):
            information[at, size:] += sign * weighted
            information[size:, at] += sign * weighted.T
        information[size:, size:] += weighted.T @ by
        target[size:] -= weighted.T @ steps.move_m.ravel()
    covariance = inverse(information)
    best, covariance = (covariance @ target)[:size], covariance[:size, :size]
    position, blocks = best[: 2 * n].reshape(n, 2), covariance[: 2 * n, : 2 * n].reshape(n, 2, n, 2)
    pull = observations.inverse_covariance @ observations.value - observations.weighted_design @ best
    return Smoothed(
        position, blocks[range(n), :, range(n)], best[2 * n :], covariance[2 * n :, 2 * n :], observations.posts,
        *_posts(observations, pull, covariance),
    )  # fmt: skip


def _posts(observations: Observations, pull: Array, covariance: Array) -> tuple[Array, Array]:
    """Errors (c,) of the posts and what is left of them (c,), in standard deviations before."""
    G = observations.by_post
    weighted = np.asarray(G.T @ observations.weighted_design)
    gain = np.asarray((G.T @ observations.inverse_covariance) * G.T.toarray()).sum(axis=1)
    gain -= np.einsum("ci,ij,cj->c", weighted, covariance, weighted, optimize=True)
    return np.asarray(G.T @ pull), np.sqrt(np.maximum(1.0 - gain, 0.0))


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
