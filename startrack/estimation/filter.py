"""The position known at each frame's own time: a Kalman filter over position, shared errors and posts.

The model is the smoother's. The state has the last position, the shared errors, and the errors of all posts that a
recent observation has depended on, in standard deviations. Posts that were not seen for the longest time are left out,
so that memory stays flat; where they are seen again, they count as new.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from startrack.core.types import Array, Ints
from startrack.estimation.observations import UNKNOWN_M, FrameEstimate

MOST_POSTS = 2000  # in the state; 40 frames 50 m apart depend on 500


@dataclass(eq=False)
class TrackFilter:
    """Estimates after the frames so far; `predict` and `update` in the order of time."""

    shared_count: int
    height_sigma_m: float
    mean: Array = field(init=False)
    covariance: Array = field(init=False)
    posts: dict[int, int] = field(default_factory=dict)  # number of a post to its place in the state

    def __post_init__(self) -> None:
        self.mean = np.zeros(2 + self.shared_count)
        self.covariance = np.diag([UNKNOWN_M**2] * 2 + [1.0] * self.shared_count)

    @property
    def position_m(self) -> Array:
        """(2,)."""
        return self.mean[:2].copy()

    @property
    def covariance_m2(self) -> Array:
        """(2, 2)."""
        return self.covariance[:2, :2].copy()

    def predict(self, move_m: Array, sigma_m: float) -> None:
        """The camera moved by (2,) in enu, with an error of `sigma_m` on each axis; infinite: anywhere."""
        if not np.isfinite(sigma_m):
            self.mean[:2] = 0.0
            self.covariance[:2], self.covariance[:, :2] = 0.0, 0.0
            sigma_m = UNKNOWN_M
        self.mean[:2] += move_m
        self.covariance[[0, 1], [0, 1]] += sigma_m**2

    def innovation(self, estimate: FrameEstimate) -> tuple[Array, Array]:
        """Observation less prediction (2 + k,), and its covariance."""
        place = self._places(estimate.post)
        return self._innovation(estimate, place)[:2]

    def update(self, estimate: FrameEstimate) -> None:
        """Take in the observation of one frame."""
        place = self._places(estimate.post)
        residual, covariance, cross = self._innovation(estimate, place)
        gain = np.linalg.solve(covariance, cross.T).T
        self.mean = self.mean + gain @ residual
        self.covariance -= gain @ cross.T
        for number in estimate.post.tolist():  # the last ones of the dictionary are the latest
            self.posts[number] = self.posts.pop(number)
        if len(self.posts) > MOST_POSTS:  # those that were not seen for the longest time are left out
            kept, first = list(self.posts)[-(3 * MOST_POSTS // 4) :], 2 + self.shared_count
            place = np.concatenate([np.arange(first), [self.posts[number] for number in kept]])
            self.mean, self.covariance = self.mean[place], self.covariance[np.ix_(place, place)]
            self.posts = {number: first + k for k, number in enumerate(kept)}

    def _innovation(self, estimate: FrameEstimate, place: Ints) -> tuple[Array, Array, Array]:
        """Residual (p,), its covariance (p, p), and that of the state with it (s, p)."""
        p, by_post = estimate.parameters, self.height_sigma_m * estimate.by_post
        cross = self.covariance[:, :p] @ estimate.response.T + self.covariance[:, place] @ by_post.T
        predicted = estimate.response @ self.mean[:p] + by_post @ self.mean[place]
        covariance = estimate.response @ cross[:p] + by_post @ cross[place] + estimate.noise
        return estimate.mean - predicted, 0.5 * (covariance + covariance.T), cross

    def _places(self, post: Ints) -> Ints:
        """Places (c,) of posts in the state, which grows by the new ones."""
        new = [number for number in post.tolist() if number not in self.posts]
        if new:
            size = len(self.mean)
            self.posts.update((number, size + k) for k, number in enumerate(new))
            self.mean = np.concatenate([self.mean, np.zeros(len(new))])
            grown = np.eye(size + len(new))
            grown[:size, :size] = self.covariance
            self.covariance = grown
        return np.array([self.posts[number] for number in post.tolist()], dtype=np.int64)
