"""Poses of flat boards at finite distances through any lens."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from startrack.applications.calibration.initial_camera import points_of_fullest_images, simple_cameras
from startrack.camera import Camera, lens_jacobian, with_update
from startrack.core.types import Array, NotIdentified
from startrack.estimation.adjust import SMALLEST_RISE_RAD
from startrack.estimation.normal_equations import Observations, Terms
from startrack.frames import R_from_rotvec, nearest_rotation

LARGEST_ERROR_RAD = 0.05  # median error of the corners' rays with a usable initial camera
FOCAL_PARTS = (0.33, 1.0)  # of the frame's width: initial focal lengths


@dataclass(frozen=True, kw_only=True)
class BoardState:
    """State of an adjustment to boards: the observations' `rays_icrs` are positions on the board [squares]."""

    camera: Camera
    R_cam_board: Array  # (images, 3, 3)
    position_cam: Array  # (images, 3) of the boards' origins [squares]

    @property
    def rotations(self) -> Array:
        """R_cam_board (images, 3, 3)."""
        return self.R_cam_board

    @property
    def is_valid(self) -> bool:
        """Whether the radius of the lens grows with the angle near the axis."""
        return min(self.camera.focal_px) > 0 and self.camera.lens.max_invertible_rad > SMALLEST_RISE_RAD

    def _corners_cam(self, points: Observations) -> Array:
        rotated = np.einsum("nij,nj->ni", self.R_cam_board[points.image], points.rays_icrs)
        return np.asarray(rotated + self.position_cam[points.image])

    def rays_cam(self, points: Observations) -> Array:
        """Directions (n, 3) of the corners in their cameras' axes."""
        corners = self._corners_cam(points)
        return np.asarray(corners / np.linalg.norm(corners, axis=1, keepdims=True))

    def residual_px(self, points: Observations, rays_cam: Array) -> Array:
        """Measured minus predicted pixels (n, 2)."""
        return points.xy_px - self.camera.project_unlimited(rays_cam)

    def terms(self, points: Observations, rays_cam: Array, free: tuple[str, ...]) -> Terms:
        """Derivatives by the free parameters, and by rotations and shifts of the boards (q = 6)."""
        by_rotation = self.camera.jacobian_px_per_rad(rays_cam)
        x, y, z = rays_cam.T / np.linalg.norm(self._corners_cam(points), axis=1)
        zero = np.zeros_like(x)
        # A shift d of a point at the distance L rotates its ray r by r x d / L.
        cross = np.stack([np.stack([zero, -z, y], 1), np.stack([z, zero, -x], 1), np.stack([-y, x, zero], 1)], axis=1)
        pose = np.concatenate([by_rotation, by_rotation @ cross], axis=2)
        return Terms(lens_jacobian(self.camera, rays_cam, free), pose, points.image, len(self.R_cam_board))

    def step(self, free: tuple[str, ...], lens: Array, poses: Array) -> BoardState:
        """The state after a step of the lens; `poses` (images, 6): rotations [rad] and shifts [squares]."""
        R = R_from_rotvec(poses[:, :3])
        return replace(
            self,
            camera=with_update(self.camera, dict(zip(free, lens.tolist(), strict=True))),
            R_cam_board=R @ self.R_cam_board,
            position_cam=np.einsum("nij,nj->ni", R, self.position_cam) + poses[:, 3:],
        )


def initial_board_state(points: Observations, size_px: tuple[int, int]) -> BoardState:
    """The best of many simple cameras with the axis in the middle of the frame. Raises NotIdentified if none fits."""
    some = points_of_fullest_images(points)
    focals_px = [part * size_px[0] for part in FOCAL_PARTS]
    cameras = [camera for f in focals_px for camera in simple_cameras(f, size_px) if not camera.mirrored]
    best = min(cameras, key=lambda camera: _board_poses(camera, some)[2])
    if _board_poses(best, some)[2] > LARGEST_ERROR_RAD:
        raise NotIdentified("no lens images flat boards at these corners: is --pattern right?")
    R, position, _ = _board_poses(best, points)
    return BoardState(camera=best, R_cam_board=R, position_cam=position)


def _board_poses(camera: Camera, points: Observations) -> tuple[Array, Array, float]:
    """Attitudes, positions and the median error [rad] of the corners' rays, image by image from a homography."""
    R, position = np.tile(np.eye(3), (points.images, 1, 1)), np.tile([0.0, 0.0, 1.0], (points.images, 1))
    errors = []
    for i in np.unique(points.image):
        own = points.take(points.image == i)
        rays = camera.unproject(own.xy_px)
        R[i], position[i] = _board_pose(rays, own.rays_icrs)
        seen = own.rays_icrs @ R[i].T + position[i]
        seen /= np.linalg.norm(seen, axis=1, keepdims=True)
        errors.append(np.linalg.norm(seen - rays, axis=1))
    return R, position, float(np.median(np.concatenate(errors)))


def _board_pose(rays: Array, positions: Array) -> tuple[Array, Array]:
    """Attitude and position of a flat board from rays (n, 3) and positions on it (n, 3): r x (H p) = 0, linear in H."""
    flat = np.column_stack([positions[:, :2], np.ones(len(positions))])
    x, y, z = rays.T
    zero = np.zeros_like(flat)
    rows = np.concatenate(
        [
            np.concatenate([zero, -z[:, None] * flat, y[:, None] * flat], axis=1),
            np.concatenate([z[:, None] * flat, zero, -x[:, None] * flat], axis=1),
            np.concatenate([-y[:, None] * flat, x[:, None] * flat, zero], axis=1),
        ]
    )
    H = np.linalg.svd(rows, full_matrices=False)[2][-1].reshape(3, 3)
    H = H if np.sum(rays * (flat @ H.T)) > 0 else -H  # the board lies where the rays point
    scale = 2.0 / (np.linalg.norm(H[:, 0]) + np.linalg.norm(H[:, 1]))
    first, second = H[:, 0] * scale, H[:, 1] * scale
    return nearest_rotation(np.stack([first, second, np.cross(first, second)], axis=1)), H[:, 2] * scale
