"""Normal equations of one lens and many attitudes: blocks, solved by the Schur complement over the images."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from startrack.camera import Camera
from startrack.camera.uncertainty import lens_jacobian
from startrack.types import Array, Ints

RIDGE_1 = 1e-14  # relative; keeps a parameter that nothing constrains solvable


@dataclass(frozen=True)
class Terms:
    """Derivatives of every observation's pixel by the lens (n, 2, m) and by its image's attitude (n, 2, 3)."""

    lens: Array
    turn: Array
    image: Ints  # (n,) ascending
    images: int

    @classmethod
    def at(cls, camera: Camera, rays_cam: Array, image: Ints, images: int, free: tuple[str, ...]) -> Terms:
        return cls(lens_jacobian(camera, rays_cam, free), camera.jacobian_px_per_rad(rays_cam), image, images)

    def normal(self, weight: Array, residual: Array) -> Normal:
        """Sums over the observations with weights (n, 2, 2) and residuals (n, 2), measured minus predicted."""
        wl, wt = weight @ self.lens, weight @ self.turn
        lt, tt = np.swapaxes(self.lens, 1, 2), np.swapaxes(self.turn, 1, 2)
        column = residual[:, :, None]
        return Normal(
            ll=np.sum(lt @ wl, axis=0),
            lt=self._by_image(lt @ wt),
            tt=self._by_image(tt @ wt),
            gl=np.sum(np.swapaxes(wl, 1, 2) @ column, axis=0)[:, 0],
            gt=self._by_image(np.swapaxes(wt, 1, 2) @ column)[..., 0],
        )

    def _by_image(self, values: Array) -> Array:
        total = np.zeros((self.images, *values.shape[1:]))
        if len(values):
            starts = np.flatnonzero(np.diff(self.image, prepend=-1))
            total[self.image[starts]] = np.add.reduceat(values, starts, axis=0)
        return total

    def leverage(self, normal: Normal) -> Array:
        """Covariance (n, 2, 2) of each prediction, attitude and lens together."""
        turned = np.take(normal.turn_by_lens, self.image, axis=0)
        lens = self.lens + self.turn @ turned
        own = np.take(normal.turn_inverse, self.image, axis=0)
        return lens @ normal.lens_covariance @ np.swapaxes(lens, 1, 2) + self.turn @ own @ np.swapaxes(self.turn, 1, 2)


@dataclass(frozen=True)
class Normal:
    """Normal equations: lens block (m, m), lens with attitude (images, m, 3), attitudes (images, 3, 3), right sides."""

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
            self.tt + damping * np.einsum("nii,ij->nij", self.tt, np.eye(3)),
            self.gl,
            self.gt,
        )

    @cached_property
    def turn_inverse(self) -> Array:
        size = np.trace(self.tt, axis1=1, axis2=2)[:, None, None]
        return np.linalg.inv(self.tt + (RIDGE_1 * size + 1e-300) * np.eye(3))

    @cached_property
    def turn_by_lens(self) -> Array:
        """Turn (images, 3, m) of each attitude that goes best with a change of the lens."""
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
        """Covariance (images, 3, 3) of the attitudes, the lens being unknown too."""
        by = self.turn_by_lens
        return self.turn_inverse + by @ self.lens_covariance @ np.swapaxes(by, 1, 2)

    def solve(self) -> tuple[Array, Array]:
        """Steps of the lens (m,) and of the attitudes (images, 3) [rad]."""
        right = self.gl + np.einsum("nam,na->m", self.turn_by_lens, self.gt)
        lens = self.lens_covariance @ right
        return lens, np.einsum("nab,nb->na", self.turn_inverse, self.gt) + self.turn_by_lens @ lens
