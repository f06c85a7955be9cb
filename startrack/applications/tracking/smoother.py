"""All frames of a track together: generalised least squares with the errors that they share.

Unknowns are the positions and the shared errors. The errors of the map's posts are not among them: they make the
observations' noise correlated, with the covariance G S G^T. Given all observations their estimates follow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from startrack.applications.tracking.frame_estimate import FrameEstimate
from startrack.applications.tracking.frame_model import UNKNOWN_M
from startrack.core.types import Array, Ints

if TYPE_CHECKING:
    from scipy.sparse import csr_array


@dataclass(frozen=True, eq=False)
class Steps:
    """Moves between successive frames, in enu, each with an independent error."""

    move_m: Array  # (n - 1, 2)
    sigma_m: Array  # (n - 1,) on each axis; infinite where the move is not known

    @classmethod
    def unknown(cls, frames: int) -> Steps:
        """No move is known."""
        return cls(np.zeros((max(frames - 1, 0), 2)), np.full(max(frames - 1, 0), np.inf))


@dataclass(frozen=True, eq=False)
class Smoothed:
    """The estimate by all observations."""

    position_m: Array  # (n, 2)
    covariance_m2: Array  # (n, 2, 2)
    shared: Array  # (k,) in standard deviations of their priors
    shared_covariance: Array  # (k, k)
    joint_m2: Array  # (n, 2, n, 2) covariance of all positions
    step_residual_m: Array  # (n - 1, 2) of each move, where the other data predict it
    step_variance_m2: Array  # (n - 1, 2, 2) of that prediction
    frame_residual: Array  # (frames, 2 + k) of the observations used, where the others predict them
    frame_covariance: Array  # (frames, 2 + k, 2 + k) of that residual
    post: Ints  # (c,) numbers of the posts that the observations depend on
    post_error_m: Array  # (c,)
    post_sigma_m: Array  # (c,)


@dataclass(frozen=True, eq=False)
class Observations:
    """The observations of some frames of a track of n frames, with the covariance of all of them."""

    frames: tuple[int, ...]
    estimates: tuple[FrameEstimate, ...]
    count: int  # n
    height_sigma_m: float

    @classmethod
    def of(cls, estimates: Sequence[FrameEstimate | None], height_sigma_m: float) -> Observations:
        """Those of the frames that have an estimate."""
        used = [(k, e) for k, e in enumerate(estimates) if e is not None]
        return cls(tuple(k for k, _ in used), tuple(e for _, e in used), len(estimates), height_sigma_m)

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

        p, n = self.size, self.count
        matrix = np.concatenate([e.response for e in self.estimates])
        frame = np.repeat(self.frames, p)[:, None]
        shared = np.broadcast_to(2 * n + np.arange(p - 2), (len(frame), p - 2))
        column = np.concatenate([2 * frame, 2 * frame + 1, shared], axis=1)
        row = np.broadcast_to(np.arange(len(frame))[:, None], column.shape)
        return csr_array((matrix.ravel(), (row.ravel(), column.ravel())), shape=(len(frame), 2 * n + p - 2))

    @cached_property
    def posts(self) -> Ints:
        """(c,) ascending."""
        return np.unique(np.concatenate([e.post for e in self.estimates]))

    @cached_property
    def by_post(self) -> csr_array:
        """(m, c) response to the errors of the posts, in their standard deviations."""
        from scipy.sparse import csr_array

        p, rows, columns, values = self.size, [], [], []
        for number, e in enumerate(self.estimates):
            rows.append(np.repeat(p * number + np.arange(p), len(e.post)))
            columns.append(np.tile(np.searchsorted(self.posts, e.post), p))
            values.append(self.height_sigma_m * e.by_post.ravel())
        at = np.concatenate(rows), np.concatenate(columns)
        return csr_array((np.concatenate(values), at), shape=(len(self.value), len(self.posts)))

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


def smooth(observations: Observations, steps: Steps) -> Smoothed:
    """The best positions and shared errors, with their covariances. Cost: the third power of the number of frames."""
    n, known = observations.count, np.isfinite(steps.sigma_m)
    weight = np.where(known, 1.0 / np.square(np.where(known, steps.sigma_m, 1.0)), 0.0)
    information, target = observations.information.copy(), observations.target.copy()
    for axis in range(2):
        left, right = 2 * np.arange(n - 1) + axis, 2 * np.arange(n - 1) + 2 + axis
        for a, b, sign in ((left, left, 1.0), (right, right, 1.0), (left, right, -1.0), (right, left, -1.0)):
            information[a, b] += sign * weight
        np.subtract.at(target, left, weight * steps.move_m[:, axis])
        np.add.at(target, right, weight * steps.move_m[:, axis])
    covariance = inverse(information)
    best = covariance @ target
    blocks = covariance[: 2 * n, : 2 * n].reshape(n, 2, n, 2)
    frame = np.arange(n)
    residual, variance = _predicted_steps(best[: 2 * n].reshape(n, 2), blocks, steps, weight)
    pulls, spread = _predicted_frames(observations, best, covariance)
    error, sigma = _posts(observations, best, covariance)
    return Smoothed(
        best[: 2 * n].reshape(n, 2), blocks[frame, :, frame], best[2 * n :], covariance[2 * n :, 2 * n :], blocks,
        residual, variance, pulls, spread, observations.posts, error, sigma,
    )  # fmt: skip


def inverse(matrix: Array) -> Array:
    """Of a symmetric positive definite matrix, by Cholesky's factors."""
    from scipy.linalg import lapack

    factor, info = lapack.dpotrf(matrix, lower=1)
    if info != 0:
        raise np.linalg.LinAlgError("the covariance is not positive definite")
    found: Any = lapack.dpotri(factor, lower=1)[0]
    return np.tril(found) + np.tril(found, -1).T


def _predicted_steps(position_m: Array, blocks: Array, steps: Steps, weight: Array) -> tuple[Array, Array]:
    """Residuals (n - 1, 2) and covariances (n - 1, 2, 2) of the moves by all data but the move itself."""
    here = np.arange(len(weight))
    covariance = blocks[here, :, here] + blocks[here + 1, :, here + 1] - blocks[here, :, here + 1]
    covariance -= blocks[here + 1, :, here]
    residual = steps.move_m - np.diff(position_m, axis=0)
    # Just less than the whole weight: a move that nothing else predicts stays invertible.
    without = np.linalg.inv(np.linalg.inv(covariance) - (1.0 - 1e-9) * weight[:, None, None] * np.eye(2))
    return np.asarray(residual + np.einsum("n,nij,nj->ni", weight, without, residual)), np.asarray(without)


def _predicted_frames(observations: Observations, best: Array, covariance: Array) -> tuple[Array, Array]:
    """Residuals (frames, p) and their covariances (frames, p, p) of the observations by all data but each itself.

    With P = V^-1 - V^-1 A H^-1 A^T V^-1 the residual of a block is P_ii^-1 (P m)_i, and P_ii^-1 its covariance.
    """
    p, count = observations.size, len(observations.frames)
    pull = observations.inverse_covariance @ observations.value - observations.weighted_design @ best
    spread = observations.weighted_design @ covariance
    residual, variance = np.empty((count, p)), np.empty((count, p, p))
    for k in range(count):
        part = slice(p * k, p * (k + 1))
        within = observations.inverse_covariance[part, part] - spread[part] @ observations.weighted_design[part].T
        variance[k] = np.linalg.pinv(within, hermitian=True)
        residual[k] = variance[k] @ pull[part]
    return residual, variance


def _posts(observations: Observations, best: Array, covariance: Array) -> tuple[Array, Array]:
    """Errors (c,) of the posts and their standard deviations (c,) [m]."""
    G = observations.by_post
    pull = observations.inverse_covariance @ observations.value - observations.weighted_design @ best
    weighted = np.asarray(G.T @ observations.weighted_design)
    gain = np.asarray((G.T @ observations.inverse_covariance) * G.T.toarray()).sum(axis=1)
    gain -= np.einsum("ci,ij,cj->c", weighted, covariance, weighted, optimize=True)
    sigma = observations.height_sigma_m
    return sigma * np.asarray(G.T @ pull), sigma * np.sqrt(np.maximum(1.0 - gain, 0.0))
