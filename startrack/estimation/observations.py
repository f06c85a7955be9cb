"""Observations of a camera's positions by its exposures, with the errors that they share, and the moves between them.

Unknowns of a track are the positions and the shared errors. The errors of the map's posts are not among them: they make
the observations' noise correlated, with the covariance G G^T.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from startrack.core import MAX_SPEED_M_S, ODOMETRY_FLOOR_M, ODOMETRY_SIGMA
from startrack.core.types import Array, Ints

if TYPE_CHECKING:
    from scipy.sparse import csr_array

UNKNOWN_M = 1e6  # standard deviation of a position about which nothing is known
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
        """2 + k."""
        return len(self.mean)

    def transform(self, to: Array, moved: Array | float = 0.0, unseen: Array | float = 0.0) -> FrameEstimate:
        """Of parameters after the linear map `to` (p, p), and `moved` (p,) besides.

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
    leg: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int64))  # (n - 1,) number, rising; 0: none
    by_leg_m: Array = field(default_factory=lambda: np.zeros((0, 2, 0)))  # (n - 1, 2, l) by one sigma of its errors

    @property
    def by_each_m(self) -> Array:
        """(n - 1, 2, f + l m) by the errors that all moves share, and those of each of m legs."""
        of_legs = [np.where((self.leg == k)[:, None, None], self.by_leg_m, 0.0) for k in np.unique(self.leg) if k]
        return np.concatenate([self.by_shared_m, *of_legs], axis=2)

    @classmethod
    def unknown(cls, frames: int) -> Steps:
        """No move is known."""
        return cls(np.zeros((max(frames - 1, 0), 2)), np.full(max(frames - 1, 0), np.inf))


@dataclass(frozen=True, eq=False)
class Observations:
    """The observations of some frames of a track of n frames, with the covariance of all of them."""

    frames: tuple[int, ...]
    estimates: tuple[FrameEstimate, ...]
    count: int  # n

    @classmethod
    def of(cls, estimates: Sequence[FrameEstimate | None]) -> Observations:
        """Those of the frames that have an estimate."""
        used = [(k, e) for k, e in enumerate(estimates) if e is not None]
        return cls(tuple(k for k, _ in used), tuple(e for _, e in used), len(estimates))

    @property
    def size(self) -> int:
        """2 + k, of one observation."""
        return self.estimates[0].parameters

    @cached_property
    def value(self) -> Array:
        """(m,) all means."""
        return np.concatenate([e.mean for e in self.estimates])

    @cached_property
    def design(self) -> csr_array:
        """(m, 2 n + k) response to all positions and the shared errors."""
        from scipy.sparse import csr_array

        p, width = self.size, 2 * self.count + self.size - 2
        matrix = np.concatenate([e.response for e in self.estimates])
        frame = np.repeat(self.frames, p)[:, None]
        shared = np.broadcast_to(np.arange(2 * self.count, width), (len(frame), p - 2))
        column = np.concatenate([2 * frame, 2 * frame + 1, shared], axis=1)
        row = np.repeat(np.arange(len(frame)), p)
        return csr_array((matrix.ravel(), (row, column.ravel())), shape=(len(frame), width))

    @cached_property
    def posts(self) -> Ints:
        """(c,) ascending."""
        return np.unique(np.concatenate([e.post for e in self.estimates]))

    @cached_property
    def by_post(self) -> csr_array:
        """(m, c) response to the errors of the posts, in their standard deviations."""
        from scipy.sparse import csr_array

        each = [len(e.post) for e in self.estimates]
        row = np.repeat(np.arange(len(self.value)), np.repeat(each, self.size))
        column = np.concatenate([np.tile(np.searchsorted(self.posts, e.post), self.size) for e in self.estimates])
        values = np.concatenate([e.by_post.ravel() for e in self.estimates])
        return csr_array((values, (row, column)), shape=(len(self.value), len(self.posts)))

    @cached_property
    def inverse_covariance(self) -> Array:
        """(m, m) V^-1, V the noise of each observation and what the posts make common."""
        covariance = (self.by_post @ self.by_post.T).toarray()
        for number, e in enumerate(self.estimates):
            part = slice(self.size * number, self.size * (number + 1))
            covariance[part, part] += e.noise
        return inverse(covariance)

    @cached_property
    def weighted_design(self) -> Array:
        """(m, 2 n + k) V^-1 A."""
        return np.asarray(self.inverse_covariance @ self.design)

    @cached_property
    def information(self) -> Array:
        """(2 n + k, 2 n + k) by the observations, with the prior of the shared errors."""
        found = np.asarray(self.design.T @ self.weighted_design)
        found[np.diag_indices_from(found)] += np.where(np.arange(len(found)) < 2 * self.count, UNKNOWN_M**-2, 1.0)
        return found

    @cached_property
    def target(self) -> Array:
        """(2 n + k,) A^T V^-1 m."""
        return np.asarray(self.weighted_design.T @ self.value)


def inverse(matrix: Array) -> Array:
    """Of a symmetric positive definite matrix, by Cholesky's factors."""
    from scipy.linalg import lapack

    factor, info = lapack.dpotrf(matrix, lower=1)
    if info != 0:
        raise np.linalg.LinAlgError("the covariance is not positive definite")
    found: Any = lapack.dpotri(factor, lower=1)[0]
    return np.tril(found) + np.tril(found, -1).T
