"""Observations of a camera's positions by its exposures, the errors that they share, and the moves between them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from startrack.core import MAX_SPEED_M_S, ODOMETRY_FLOOR_M, ODOMETRY_SIGMA
from startrack.core.types import Array, Bools, Ints

UNKNOWN_M = 1e5  # standard deviation of a position about which nothing is known; larger ones cost digits of the others
UNSEEN_NOISE = 1e-6  # of means that do not respond to anything: any will do, and about that of others leaves all digits


@dataclass(frozen=True, eq=False)
class FrameEstimate:
    """The observation of one frame. Parameters: east and north [m], and k shared errors in their prior's sigma."""

    mean: Array  # (2 + k,) of the posterior with the priors of the shared errors
    covariance: Array  # (2 + k, 2 + k) of that, with the errors of posts
    response: Array  # (2 + k, 2 + k) of the mean to the true parameters: K
    noise: Array  # (2 + k, 2 + k) of the mean, of this frame alone
    post: Ints  # (c,) numbers of the posts with a measurable effect
    by_post: Array  # (2 + k, c) of the mean to the error of each, in its standard deviation: G
    weight: float = 1.0  # probability of this mode of the frame's posterior

    @property
    def parameters(self) -> int:
        """Number of the parameters, 2 + k."""
        return len(self.mean)

    @cached_property
    def without_posts(self) -> FrameEstimate:
        """Copy of this estimate with the errors by posts as the frame's own."""
        noise = self.noise + self.by_post @ self.by_post.T
        return replace(self, noise=noise, post=self.post[:0], by_post=self.by_post[:, :0])

    def transform(self, to: Array, moved: Array | float = 0.0, unseen: Array | float = 0.0) -> FrameEstimate:
        """Estimate of the parameters after the linear map `to` (p, p), with `moved` (p,) added.

        What `moved` holds are positions, to which the mean responds wholly. Of what `unseen` (p, p) projects on, the
        prior is all that is known.
        """
        response = to @ self.response @ np.linalg.pinv(to, rcond=1e-12)
        return replace(
            self, mean=to @ self.mean + moved, covariance=to @ self.covariance @ to.T + unseen, response=response,
            noise=to @ self.noise @ to.T + UNSEEN_NOISE * unseen, by_post=to @ self.by_post,
        )  # fmt: skip


@dataclass(frozen=True)
class OdometryErrors:
    """Errors of moves, independent on each horizontal axis; by default those of a usual rover's odometry.

    All moves share a further error of their scale and one of their heading, each as large as the relative one, and the
    offset of the odometry's clock from that of the images.
    """

    sigma_1: float = ODOMETRY_SIGMA  # standard deviation, relative to the length of a move
    floor_m: float = ODOMETRY_FLOOR_M  # beside that, in quadrature
    max_speed_m_s: float = MAX_SPEED_M_S  # faster moves are impossible
    time_sigma_s: float = 0.0  # standard deviation of that offset

    def sigma_m(self, move_m: Array) -> Array:
        """Standard deviation (...) [m] of moves (..., 2), or (..., 3), on each axis."""
        return np.hypot(self.sigma_1 * np.linalg.norm(move_m, axis=-1), self.floor_m)


USUAL_ODOMETRY = OdometryErrors()


def moves_by_scale_and_heading(move_m: Array) -> Array:
    """Changes (..., d, 2) of moves (..., d), d at least 2, by a scale larger by 1 and a heading larger by 1 rad."""
    turned = np.zeros_like(move_m)
    turned[..., 0], turned[..., 1] = -move_m[..., 1], move_m[..., 0]
    return np.stack([move_m, turned], axis=-1)


@dataclass(frozen=True, eq=False)
class Steps:
    """Moves between successive frames, in enu, each with an independent error, and with errors that they share.

    Some are of all moves, some of each leg: moves in a row in which the wheels slip alike.
    """

    move_m: Array  # (n - 1, 2)
    sigma_m: Array  # (n - 1,) on each axis; infinite where the move is not known
    by_shared_m: Array = field(default_factory=lambda: np.zeros((0, 2, 0)))  # (n - 1, 2, f) by one sigma of each
    by_leg_m: Array = field(default_factory=lambda: np.zeros((0, 2, 0)))  # (n - 1, 2, l) of its leg; 0 where none is
    begins: Bools = field(default_factory=lambda: np.zeros(0, dtype=bool))  # (n - 1,) whether a leg begins with it

    @classmethod
    def unknown(cls, frames: int) -> Steps:
        """Steps between so many `frames` of which no move is known."""
        return cls(np.zeros((max(frames - 1, 0), 2)), np.full(max(frames - 1, 0), np.inf))
