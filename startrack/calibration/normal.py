"""Normal equations of one lens and many attitudes: blocks, solved by the Schur complement over the images."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from startrack.camera import Camera
from startrack.camera.uncertainty import lens_jacobian
from startrack.types import Array, Ints

RIDGE_1 = 1e-14  # relative; keeps a parameter that nothing constrains solvable


@dataclass(frozen=True)
class Terms:
    """Derivatives of every observation's pixel by the lens (n, 2, m) and by its image's attitude (n, 2, q).

    q is 3 where only the camera turns (stars), 6 where it moves too (boards).
    """

    lens: Array
    turn: Array
    image: Ints  # (n,) ascending
    images: int

    @classmethod
    def at(cls, camera: Camera, rays_cam: Array, image: Ints, images: int, free: tuple[str, ...]) -> Terms:
        return cls(lens_jacobian(camera, rays_cam, free), camera.jacobian_px_per_rad(rays_cam), image, images)

    def normal(self, weight: Array, residual: Array) -> Normal:
        """Sums over the observations with weights (n, 2, 2) and residuals (n, 2), measured minus predicted."""
        m = self.lens.shape[2]
        q = m + self.turn.shape[2]
        full = np.concatenate([self.lens, self.turn, residual[:, :, None]], axis=2)
        x, y = full[:, 0], full[:, 1]
        wx = weight[:, 0, :1] * x + weight[:, 0, 1:] * y
        wy = weight[:, 1, :1] * x + weight[:, 1, 1:] * y
        ends = np.searchsorted(self.image, np.arange(self.images + 1))
        total = np.zeros((self.images, q + 1, q + 1))
        for i, (a, b) in enumerate(pairwise(ends.tolist())):  # one product of matrices each: far quicker than sums
            total[i] = x[a:b].T @ wx[a:b] + y[a:b].T @ wy[a:b]
        return Normal(
            ll=total[:, :m, :m].sum(axis=0),
            lt=total[:, :m, m:q],
            tt=total[:, m:q, m:q],
            gl=total[:, :m, q].sum(axis=0),
            gt=total[:, m:q, q],
        )


@dataclass(frozen=True)
class Normal:
    """Normal equations: lens block (m, m), lens with attitude (images, m, q), attitudes (images, q, q), right sides."""

    ll: Array
    lt: Array
    tt: Array
    gl: Array
    gt: Array

    def without(self, part: Normal) -> Normal:
        """These equations less those of a part of the observations."""
        pairs = ((getattr(self, name), getattr(part, name)) for name in ("ll", "lt", "tt", "gl", "gt"))
        return Normal(*(whole - some for whole, some in pairs))

    def damped(self, damping: float) -> Normal:
        """With the diagonals raised by the factor 1 + damping (Marquardt)."""
        return Normal(
            self.ll + damping * np.diag(np.diag(self.ll)),
            self.lt,
            self.tt + damping * np.einsum("nii,ij->nij", self.tt, np.eye(self.tt.shape[1])),
            self.gl,
            self.gt,
        )

    @cached_property
    def turn_inverse(self) -> Array:
        size = np.trace(self.tt, axis1=1, axis2=2)[:, None, None]
        return np.linalg.inv(self.tt + (RIDGE_1 * size + 1e-300) * np.eye(self.tt.shape[1]))

    @cached_property
    def turn_by_lens(self) -> Array:
        """Turn (images, q, m) of each attitude that goes best with a change of the lens."""
        return -self.turn_inverse @ np.swapaxes(self.lt, 1, 2)

    @cached_property
    def lens_covariance(self) -> Array:
        """Covariance (m, m) of the lens, the attitudes being unknown too."""
        schur = self.ll + np.sum(self.lt @ self.turn_by_lens, axis=0)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(self.ll), 1e-300))
        scaled = schur * scale * scale[:, None]
        inverse = np.linalg.inv(0.5 * (scaled + scaled.T) + RIDGE_1 * np.eye(len(scaled)))
        return inverse * scale * scale[:, None]

    @property
    def turn_covariance(self) -> Array:
        """Covariance (images, q, q) of the attitudes, the lens being unknown too."""
        by = self.turn_by_lens
        return self.turn_inverse + by @ self.lens_covariance @ np.swapaxes(by, 1, 2)

    def solve(self) -> tuple[Array, Array]:
        """Steps of the lens (m,) and of the attitudes (images, q) [rad]."""
        right = self.gl + np.einsum("nam,na->m", self.turn_by_lens, self.gt)
        lens = self.lens_covariance @ right
        return lens, np.einsum("nab,nb->na", self.turn_inverse, self.gt) + self.turn_by_lens @ lens
