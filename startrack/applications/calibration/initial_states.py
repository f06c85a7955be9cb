"""Beginnings of a calibration: the field of view, and cameras and attitudes from matched stars or from flat boards."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from startrack.camera import Camera, lens_jacobian, lens_kinds
from startrack.core.types import Array, BadInput, NotIdentified
from startrack.estimation.adjust import Observations, State, Terms
from startrack.frames import R_from_rotvec, angle_between_rad, nearest_rotation, wahba
from startrack.identification import WIDE_FIELD_RAD

PAIR_STARS = 80  # of an image, whose pairs give the focal length
NEAR_PAIRS_QUANTILE = 0.3
FOCAL_FACTORS = np.geomspace(0.6, 1.7, 23)
ATTITUDE_ROUNDS = 8
IMAGES_TRIED = 3
OUTLIER_RAD = np.radians(4.0)  # larger errors of a ray count as this one
SMALLEST_TOLERANCE_RAD = 1e-4
LARGEST_ERROR_RAD = 0.05  # median error of the corners' rays with a usable initial camera
FOCAL_PARTS = (0.33, 1.0)  # of the frame's width: initial focal lengths


def field_of_view_rad(camera: Camera | None, fov_rad: float | None) -> float:
    """Field of view [rad]: `fov_rad`, else of the approximate camera: image circle if wide, else frame width.

    Raises BadInput no_calibration where there is neither.
    """
    if fov_rad is not None:
        return fov_rad
    if camera is None:
        raise BadInput("no_calibration", "give the field of view (--fov DEG) or an approximate camera file (-c)")
    if 2.0 * camera.max_angle_rad >= WIDE_FIELD_RAD:
        return 2.0 * camera.max_angle_rad
    width, height = camera.size_px
    sides = np.array([[-0.5, (height - 1) / 2], [width - 0.5, (height - 1) / 2]])
    return float(min(np.sum(camera.angle_rad(sides)), 0.99 * WIDE_FIELD_RAD))


def corner_angle_rad(camera: Camera) -> float:
    """The largest angle off the axis [rad] of the frame's corners."""
    right, bottom = (side - 0.5 for side in camera.size_px)
    return float(np.max(camera.angle_rad(np.array([[x, y] for x in (-0.5, right) for y in (-0.5, bottom)]))))


def largest_angle_rad(fitted: Camera, start: Camera | None, fov_rad: float | None) -> float:
    """Edge of the image circle [rad]: as given, else the corner; at most the turning point of the polynomial."""
    edge = corner_angle_rad(fitted) if start is None else start.max_angle_rad
    if start is None and fov_rad is not None and fov_rad >= WIDE_FIELD_RAD:
        edge = 0.5 * fov_rad
    return float(max(min(edge, fitted.lens.max_invertible_rad), fitted.calibrated_angle_rad))


def initial_state(points: Observations, size_px: tuple[int, int]) -> State:
    """The best of many simple cameras with the axis in the middle of the frame, with its attitudes.

    `points` are the observations of a frame of `size_px` (W, H). Up to half of the matches may be wrong. Raises
    NotIdentified without observations.
    """
    if not len(points):
        raise NotIdentified("a calibration needs matched stars")
    some = _points_of_fullest_images(points)
    cameras = _simple_cameras(_focal_px(some), size_px)
    best = min(cameras, key=lambda camera: float(np.sum(_fit_rays(camera, some)[1])))
    return State(camera=best, R_cam_icrs=fit_attitudes(best, points))


def _points_of_fullest_images(points: Observations) -> Observations:
    """The observations of the images that have most."""
    most = np.argsort(-np.bincount(points.image), kind="stable")[:IMAGES_TRIED]
    return points.take(np.isin(points.image, most))


def _simple_cameras(focal_px: float, size_px: tuple[int, int]) -> Iterator[Camera]:
    """Cameras of all kinds of lenses, focal lengths about `focal_px` and handednesses, for a frame of `size_px`."""
    for kind in lens_kinds().values():
        for lens in kind.typical_shapes():
            for factor in FOCAL_FACTORS:
                for mirrored in (False, True):
                    yield Camera(
                        name="initial",
                        size_px=size_px,
                        focal_px=(focal_px * factor, focal_px * factor),
                        centre_px=((size_px[0] - 1) / 2, (size_px[1] - 1) / 2),
                        max_angle_rad=min(np.pi, lens.max_invertible_rad),
                        calibrated_angle_rad=min(np.pi / 2, lens.max_invertible_rad),
                        lens=lens,
                        mirrored=mirrored,
                    )


def fit_attitudes(camera: Camera, points: Observations) -> Array:
    """R_cam_icrs (images, 3, 3), robustly weighted; identity where an image has no observations."""
    return _fit_rays(camera, points)[0]


def _focal_px(points: Observations) -> float:
    """Pixels per radian from the distances of near pairs, which depend on neither centre nor attitude."""
    ratios = []
    for i in np.unique(points.image):
        own = points.take(points.image == i)
        own = own.take(np.linspace(0, len(own) - 1, min(len(own), PAIR_STARS)).astype(int))
        a, b = np.triu_indices(len(own), 1)
        angle = angle_between_rad(own.rays_icrs[a], own.rays_icrs[b])
        near = angle <= np.quantile(angle, NEAR_PAIRS_QUANTILE) if len(angle) else np.zeros(0, dtype=bool)
        near &= angle > 0
        ratios.append(np.linalg.norm(own.xy_px[a] - own.xy_px[b], axis=1)[near] / angle[near])
    ratio = np.concatenate(ratios)
    if not len(ratio):
        raise NotIdentified("a calibration needs at least two matched stars in one image")
    return float(np.median(ratio))


def _fit_rays(camera: Camera, points: Observations) -> tuple[Array, Array]:
    """Attitudes (images, 3, 3), and the squared errors (n,) of the rays [rad^2], at most OUTLIER_RAD squared."""
    rays = camera.unproject(points.xy_px)
    R = np.tile(np.eye(3), (points.images, 1, 1))
    squared_error = np.empty(len(points))
    for i in np.unique(points.image):
        own = np.flatnonzero(points.image == i)
        weight = np.ones(len(own))
        for _ in range(ATTITUDE_ROUNDS):
            R[i] = wahba(rays[own], points.rays_icrs[own], weight)
            squared = np.sum(np.square(rays[own] - points.rays_icrs[own] @ R[i].T), axis=1)
            tolerance = max(float(np.sqrt(np.median(squared))), SMALLEST_TOLERANCE_RAD)
            weight = 1.0 / (1.0 + squared / tolerance**2) ** 2
        squared_error[own] = np.minimum(squared, OUTLIER_RAD**2)
    return R, squared_error


@dataclass(frozen=True, kw_only=True)
class BoardState(State):
    """State of an adjustment to boards: `R_cam_icrs` are R_cam_board, `rays_icrs` positions on the board [squares]."""

    position_cam: Array  # (images, 3) of the boards' origins [squares]

    def rays_cam(self, points: Observations) -> Array:
        """Unit vectors (n, 3) to the corners in the axes of their cameras."""
        corners = self._corners_cam(points)
        return np.asarray(corners / np.linalg.norm(corners, axis=1, keepdims=True))

    def _corners_cam(self, points: Observations) -> Array:
        """Positions (n, 3) [squares] of the corners in the axes of their cameras."""
        rotated = np.einsum("nij,nj->ni", self.R_cam_icrs[points.image], points.rays_icrs)
        return np.asarray(rotated + self.position_cam[points.image])

    def terms(self, points: Observations, rays_cam: Array, free: tuple[str, ...]) -> Terms:
        """Derivatives by the free parameters, and by rotations and shifts of the boards (q = 6)."""
        by_rotation = self.camera.jacobian_px_per_rad(rays_cam)
        x, y, z = rays_cam.T / np.linalg.norm(self._corners_cam(points), axis=1)
        zero = np.zeros_like(x)
        # A shift d of a point at the distance L rotates its ray r by r x d / L.
        cross = np.stack([np.stack([zero, -z, y], 1), np.stack([z, zero, -x], 1), np.stack([-y, x, zero], 1)], axis=1)
        pose = np.concatenate([by_rotation, by_rotation @ cross], axis=2)
        return Terms(lens_jacobian(self.camera, rays_cam, free), pose, points.image, len(self.R_cam_icrs))

    def step(self, free: tuple[str, ...], lens: Array, poses: Array) -> BoardState:
        """The state after a step of the lens; `poses` (images, 6): rotations [rad] and shifts [squares]."""
        new = super().step(free, lens, poses[:, :3])
        position = np.einsum("nij,nj->ni", R_from_rotvec(poses[:, :3]), self.position_cam) + poses[:, 3:]
        return replace(self, camera=new.camera, R_cam_icrs=new.R_cam_icrs, position_cam=position)


def initial_board_state(points: Observations, size_px: tuple[int, int]) -> BoardState:
    """The best of many simple cameras with the axis in the middle of the frame. Raises NotIdentified if none fits."""
    some = _points_of_fullest_images(points)
    focals_px = [part * size_px[0] for part in FOCAL_PARTS]
    cameras = [camera for f in focals_px for camera in _simple_cameras(f, size_px) if not camera.mirrored]
    best = min(cameras, key=lambda camera: _board_poses(camera, some)[2])
    if _board_poses(best, some)[2] > LARGEST_ERROR_RAD:
        raise NotIdentified("no lens images flat boards at these corners: is --pattern right?")
    R, position, _ = _board_poses(best, points)
    return BoardState(camera=best, R_cam_icrs=R, position_cam=position)


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
    x, y, z = rays.T[:, :, None]
    zero = np.zeros_like(flat)
    rows = np.block([[zero, -z * flat, y * flat], [z * flat, zero, -x * flat], [-y * flat, x * flat, zero]])
    H = np.linalg.svd(rows, full_matrices=False)[2][-1].reshape(3, 3)
    H = H if np.sum(rays * (flat @ H.T)) > 0 else -H  # the board lies where the rays point
    scale = 2.0 / (np.linalg.norm(H[:, 0]) + np.linalg.norm(H[:, 1]))
    first, second = H[:, 0] * scale, H[:, 1] * scale
    return nearest_rotation(np.stack([first, second, np.cross(first, second)], axis=1)), H[:, 2] * scale
