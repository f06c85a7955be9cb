"""Observations of one lens in many images, and their normal equations, solved by the Schur complement.

The images have only the lens in common, so that each image's attitude is eliminated alone: the cost grows linearly
with the number of images; that of a dense solution grows with its cube.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from startrack.core.types import Array, Ints, Rows, array

RIDGE_1 = 1e-14  # relative to the diagonal; the system stays solvable with unconstrained parameters
TINY = np.finfo(np.float64).tiny


@dataclass(frozen=True, kw_only=True)
class Observations(Rows):
    """Measured pixels with known directions, sorted by image."""

    image: Ints = array("n", dtype=np.int64)  # 0 ... images - 1, ascending
    xy_px: Array = array("n", 2)  # measured
    covariance_px2: Array = array("n", 2, 2)  # of the measurement
    rays_icrs: Array = array("n", 3)  # apparent directions, refraction included; of boards: positions [squares]

    def __post_init__(self) -> None:
        super().__post_init__()
        if np.any(np.diff(self.image) < 0) or np.any(self.image[:1] < 0):
            raise ValueError("Observations.image must ascend from 0")

    @property
    def images(self) -> int:
        """Number of images."""
        return int(self.image[-1]) + 1 if len(self.image) else 0


def observations(
    xy_px: list[Array], rays_icrs: list[Array], covariance_px2: list[Array] | float | None = None
) -> Observations:
    """Observations from pixels `xy_px` (n_i, 2) and directions `rays_icrs` (n_i, 3), one array per image.

    `covariance_px2`: per image (n_i, 2, 2), or one variance per axis [px^2] for all. None: the centroid errors are not
    known; a fit then takes them from the scatter.
    """
    counts = [len(xy) for xy in xy_px]
    covariance = (
        np.concatenate(covariance_px2)
        if isinstance(covariance_px2, list)
        else np.broadcast_to((covariance_px2 or 0.0) * np.eye(2), (sum(counts), 2, 2))
    )
    return Observations(
        image=np.repeat(np.arange(len(counts)), counts),
        xy_px=np.concatenate(xy_px),
        covariance_px2=covariance,
        rays_icrs=np.concatenate(rays_icrs),
    )


def observations_of_image(xy_px: Array, covariance_px2: Array, rays_icrs: Array) -> Observations:
    """Observations of a single image: pixels (n, 2), their covariances (n, 2, 2), directions (n, 3)."""
    image = np.zeros(len(xy_px), dtype=np.int64)
    return Observations(image=image, xy_px=xy_px, covariance_px2=covariance_px2, rays_icrs=rays_icrs)


@dataclass(frozen=True)
class NormalEquations:
    """Blocks of the normal matrix of m lens parameters and q pose parameters per image, and the right sides."""

    lens: Array  # (m, m)
    lens_pose: Array  # (images, m, q)
    pose: Array  # (images, q, q)
    lens_right: Array  # (m,)
    pose_right: Array  # (images, q)

    def subtract(self, part: NormalEquations) -> NormalEquations:
        """Copy of these equations without a part of their observations."""
        return NormalEquations(
            self.lens - part.lens, self.lens_pose - part.lens_pose, self.pose - part.pose,
            self.lens_right - part.lens_right, self.pose_right - part.pose_right,
        )  # fmt: skip

    def with_prior(self, precision: Array, offset: Array) -> NormalEquations:
        """Copy with a prior of the lens parameters: precisions (m,) and expected minus current values (m,)."""
        return replace(self, lens=self.lens + np.diag(precision), lens_right=self.lens_right + precision * offset)

    def with_damping(self, damping: float) -> NormalEquations:
        """Copy with the diagonals multiplied by 1 + damping. Source: Marquardt 1963, J. SIAM 11, 431."""
        return replace(
            self,
            lens=self.lens + damping * np.diag(np.diag(self.lens)),
            pose=self.pose + damping * np.einsum("nii,ij->nij", self.pose, np.eye(self.pose.shape[1])),
        )

    @cached_property
    def pose_inverse(self) -> Array:
        """Inverses (images, q, q) of the pose blocks."""
        size = np.trace(self.pose, axis1=1, axis2=2)[:, None, None]
        return np.linalg.inv(self.pose + (RIDGE_1 * size + TINY) * np.eye(self.pose.shape[1]))

    @cached_property
    def pose_by_lens(self) -> Array:
        """Response (images, q, m) of the poses to a change of the lens parameters."""
        return -self.pose_inverse @ np.swapaxes(self.lens_pose, 1, 2)

    @cached_property
    def lens_covariance(self) -> Array:
        """Marginal covariance (m, m) of the lens parameters."""
        schur = self.lens + np.sum(self.lens_pose @ self.pose_by_lens, axis=0)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(self.lens), TINY))
        scaled = schur * scale * scale[:, None]
        inverse = np.linalg.inv(0.5 * (scaled + scaled.T) + RIDGE_1 * np.eye(len(scaled)))
        return inverse * scale * scale[:, None]

    @property
    def pose_covariance(self) -> Array:
        """Marginal covariances (images, q, q) of the poses."""
        by = self.pose_by_lens
        return self.pose_inverse + by @ self.lens_covariance @ np.swapaxes(by, 1, 2)

    def solve(self) -> tuple[Array, Array]:
        """Steps of the lens parameters (m,) and of the poses (images, q)."""
        if len(self.pose) == 1:
            return self._solve_dense()
        right = self.lens_right + np.einsum("nam,na->m", self.pose_by_lens, self.pose_right)
        lens = self.lens_covariance @ right
        return lens, np.einsum("nab,nb->na", self.pose_inverse, self.pose_right) + self.pose_by_lens @ lens

    def _solve_dense(self) -> tuple[Array, Array]:
        """Steps (m,) and (1, q) for a single image, by one small system with the parameters' units divided out."""
        m = len(self.lens)
        size = m + self.pose.shape[1]
        full = np.empty((size, size))
        full[:m, :m], full[:m, m:], full[m:, :m], full[m:, m:] = (
            self.lens, self.lens_pose[0], self.lens_pose[0].T, self.pose[0]
        )  # fmt: skip
        diagonal = full.ravel()[:: size + 1]  # a view
        unit = 1.0 / np.sqrt(np.maximum(diagonal, TINY))
        full *= unit
        full *= unit[:, None]
        diagonal += RIDGE_1
        step = unit * np.linalg.solve(full, unit * np.concatenate([self.lens_right, self.pose_right[0]]))
        return step[:m], step[None, m:]


@dataclass(frozen=True)
class Terms:
    """Derivatives of the observations' pixels by the lens parameters (n, 2, m) and by their image's pose (n, 2, q).

    q is 3 for attitudes (stars), and 6 for poses of boards, which have a position too.
    """

    lens: Array
    pose: Array
    image: Ints  # (n,) ascending
    images: int

    def take(self, which: Ints) -> Terms:
        """Terms of the observations with these ascending indices."""
        return Terms(self.lens.T[..., which].T, self.pose.T[..., which].T, self.image[which], self.images)

    def shift_px(self, lens: Array, poses: Array) -> Array:
        """Linear shift (n, 2) of the predicted pixels by steps of the lens parameters (m,) and poses (images, q)."""
        return self.lens @ lens + np.einsum("nij,nj->ni", self.pose, poses[self.image])

    def normal_equations(self, weight: Array, residual_px: Array) -> NormalEquations:
        """Normal equations by weights (n, 2, 2) and residuals (n, 2), measured minus predicted, of the observations."""
        m = self.lens.shape[2]
        q = m + self.pose.shape[2]
        ends = np.searchsorted(self.image, np.arange(self.images + 1))
        total = np.zeros((self.images, q + 1, q + 1))
        for i, (a, b) in enumerate(pairwise(ends.tolist())):  # one matrix product each is much faster than einsum
            full = np.concatenate([self.lens.T[..., a:b], self.pose.T[..., a:b], residual_px.T[None, :, a:b]])
            (xx, xy), (yx, yy) = weight[a:b].transpose(1, 2, 0)
            x, y = full[:, 0], full[:, 1]
            weighted = np.stack([xx * x + xy * y, yx * x + yy * y], axis=1)
            total[i] = full.reshape(q + 1, -1) @ weighted.reshape(q + 1, -1).T
        return NormalEquations(
            lens=total[:, :m, :m].sum(axis=0),
            lens_pose=total[:, :m, m:q],
            pose=total[:, m:q, m:q],
            lens_right=total[:, :m, q].sum(axis=0),
            pose_right=total[:, m:q, q],
        )
