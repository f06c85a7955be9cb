"""View of a narrow field: attitude, focal length and one distortion term of a camera whose axis is the frame's centre.

A state for `startrack.estimation.adjust` with closed-form derivatives in the tangential plane, an order of magnitude
cheaper than those of a general lens.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from startrack.camera import Camera, Lens, Pinhole, default_lens
from startrack.core.types import Array, Bools
from startrack.estimation.adjust import Scheme, adjust
from startrack.estimation.normal_equations import Observations, Terms, observations_of_image
from startrack.frames import R_from_rotvec
from startrack.identification.region_growing import MATCH_LOSS

TANGENT = (1 / 3, 2 / 15, 17 / 315, 62 / 2835)  # series of tan a beyond a: to 1e-7 up to 20 degrees
LONGEST_STEP = 0.1  # of a parameter: radians, logarithm of the focal length, distortion


@dataclass(frozen=True)
class PinholeView:
    """Attitude and focal length of a frame (W, H)."""

    R_cam_icrs: Array
    focal_px: float
    mirrored: bool
    size_px: tuple[int, int]
    distortion: float  # of the radius [focal lengths] per cube of the angle off the axis, beyond the tangent

    @property
    def centre_px(self) -> Array:
        """(2,)"""
        return 0.5 * (np.array(self.size_px) - 1.0)

    @property
    def rotations(self) -> Array:
        """R_cam_icrs (1, 3, 3)."""
        return self.R_cam_icrs[None]

    @property
    def is_valid(self) -> bool:
        """Always: the focal length is fitted by its logarithm."""
        return True

    def project(self, rays_icrs: Array) -> tuple[Array, Bools]:
        """Pixels (n, 2) of rays (n, 3) less than 90 degrees off the axis, and which lie in the frame."""
        cam = rays_icrs @ self.R_cam_icrs.T
        plane = cam[:, :2] / np.maximum(cam[:, 2], 1e-6)[:, None]
        px = self._pixels(plane)
        half = 0.5 * np.array(self.size_px)
        return px, (np.abs(px - self.centre_px) <= half).all(axis=1) & (cam[:, 2] > 0)

    def fit(self, xy_px: Array, rays_icrs: Array, sigma_px: float, distorted: bool, steps: int = 1) -> PinholeView:
        """The view fitted to the stars (n, 3) at the pixels (n, 2), some of them wrong, with a loss of this scale.

        `distorted`: whether the lens may differ from a pinhole.
        """
        covariance = np.broadcast_to(sigma_px**2 * np.eye(2), (len(xy_px), 2, 2))
        points = observations_of_image(xy_px, covariance, rays_icrs)
        free = ("log_focal", "distortion") if distorted else ("log_focal",)
        scheme = Scheme(loss=MATCH_LOSS, steps=steps, settled_px=0.0, damped=False)
        found: PinholeView = adjust(self, points, free, scheme).state
        return found

    def rays_cam(self, points: Observations) -> Array:
        """Positions (n, 2) [focal lengths] of the observations in the pinhole's image plane."""
        cam = points.rays_icrs @ self.R_cam_icrs.T
        return np.asarray(cam[:, :2] / cam[:, 2:])

    def residual_px(self, points: Observations, plane: Array) -> Array:
        """Measured minus predicted pixels (n, 2)."""
        return points.xy_px - self._pixels(plane)

    def terms(self, points: Observations, plane: Array, free: tuple[str, ...]) -> Terms:
        """Derivatives by the logarithm of the focal length, the distortion, and rotations about the camera's axes.

        The rotation's effect on the distortion itself is left out.
        """
        (u, v), (fx, fy) = plane.T, self._signed_focal_px
        pose = np.empty((len(u), 2, 3))
        pose[:, 0, 0], pose[:, 0, 1], pose[:, 0, 2] = -fx * u * v, fx * (1 + u * u), -fx * v
        pose[:, 1, 0], pose[:, 1, 1], pose[:, 1, 2] = -fy * (1 + v * v), fy * u * v, fy * u
        signed = plane * self._signed_focal_px
        by_lens = np.empty((len(u), 2, len(free)))
        by_lens[:, :, 0] = signed * self._radius_ratio(plane)[:, None]
        if len(free) > 1:
            by_lens[:, :, 1] = signed * _cube(plane)[:, None]
        return Terms(by_lens, pose, points.image, 1)

    def step(self, free: tuple[str, ...], lens: Array, poses: Array) -> PinholeView:
        """The view after a step of the free parameters and of the attitude (1, 3) [rad]."""
        lens, poses = np.clip(lens, -LONGEST_STEP, LONGEST_STEP), np.clip(poses, -LONGEST_STEP, LONGEST_STEP)
        return replace(
            self,
            R_cam_icrs=R_from_rotvec(poses[0]) @ self.R_cam_icrs,
            focal_px=float(self.focal_px * np.exp(lens[0])),
            distortion=self.distortion + (float(lens[1]) if len(free) > 1 else 0.0),
        )

    def camera(self) -> Camera:
        """The camera, as wide as its frame."""
        lens: Lens = Pinhole()
        if self.distortion:
            lens = default_lens()((TANGENT[0] + self.distortion, *TANGENT[1:]))
        (x, y), widest = self.centre_px.tolist(), lens.max_invertible_rad
        camera = Camera(
            name="unknown", size_px=self.size_px, focal_px=(self.focal_px, self.focal_px), centre_px=(x, y),
            max_angle_rad=widest, calibrated_angle_rad=widest, lens=lens, mirrored=self.mirrored,
        )  # fmt: skip
        corner = float(camera.angle_rad(np.array([-0.5, -0.5])))
        return replace(camera, max_angle_rad=corner, calibrated_angle_rad=corner)

    @property
    def _signed_focal_px(self) -> Array:
        return np.array([-self.focal_px if self.mirrored else self.focal_px, self.focal_px])

    def _pixels(self, plane: Array) -> Array:
        return np.asarray(plane * self._radius_ratio(plane)[:, None] * self._signed_focal_px + self.centre_px)

    def _radius_ratio(self, plane: Array) -> Array:
        """Radius over that of a pinhole (n,), at positions (n, 2) of the pinhole's plane."""
        return 1.0 + self.distortion * _cube(plane) if self.distortion else np.ones(len(plane))


def _cube(plane: Array) -> Array:
    """Cube of the angle off the axis over the radius (n,) at positions (n, 2) of a pinhole's plane."""
    radius = np.sqrt(np.einsum("ni,ni->n", plane, plane))
    return np.asarray(np.arctan(radius) ** 3 / np.maximum(radius, 1e-12))
