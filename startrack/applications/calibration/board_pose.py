"""Calibration boards in pictures: corners by OpenCV's detectors, and poses at finite distances through any lens."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from startrack.applications.calibration.initial_camera import FOCAL_FACTORS, LENSES
from startrack.camera import Camera, lens_jacobian, with_update
from startrack.core.types import Array, BadInput, Exposure, NotIdentified
from startrack.estimation.adjust import SMALLEST_RISE_RAD
from startrack.estimation.normal_equations import Observations, Terms
from startrack.frames import R_from_rotvec, nearest_rotation

IMAGES_TRIED = 4
LARGEST_ERROR_RAD = 0.05  # median error of the corners' rays with a usable initial camera
FOCAL_PARTS = (0.33, 1.0)  # of the frame's width: initial focal lengths
MIN_CHARUCO_CORNERS = 4
CONTRAST_PERCENTILES = (0.5, 99.5)


@dataclass(frozen=True)
class Board:
    """A flat pattern; positions on it are in squares."""

    columns: int  # inner corners of a chessboard, squares of a ChArUco board
    rows: int
    charuco: str | None = None  # name of the dictionary, such as DICT_5X5_100
    marker_fraction: float = 0.75  # marker's side over the square's


@dataclass(frozen=True)
class Corners:
    """Corners found in one picture."""

    xy_px: Array  # (n, 2)
    position: Array  # (n, 3) on the board, in squares, z = 0


def find_corners(exposure: Exposure, board: Board) -> Corners | None:
    """Corners in a picture; None where the board is not found. Raises BadInput for an unknown dictionary."""
    grey = _as_8_bits(exposure)
    return _find_chessboard(grey, board) if board.charuco is None else _find_charuco(grey, board)


def _as_8_bits(exposure: Exposure) -> Any:
    """The picture in 8 bits, which the detectors need, stretched between two percentiles."""
    p = np.asarray(exposure.pixels_adu)
    low, high = np.percentile(p[::3, ::3], CONTRAST_PERCENTILES)
    return np.clip((p - low) * (255.0 / max(high - low, 1e-6)), 0, 255).astype(np.uint8)


def _find_chessboard(grey: Any, board: Board) -> Corners | None:
    import cv2

    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE
    found, px = cv2.findChessboardCornersSB(grey, (board.columns, board.rows), flags=flags)
    if not found or px is None:
        return None
    x, y = np.meshgrid(np.arange(board.columns), np.arange(board.rows))
    position = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1).astype(np.float64)
    return Corners(px.reshape(-1, 2).astype(np.float64), position)


def _find_charuco(grey: Any, board: Board) -> Corners | None:
    import cv2

    name = str(board.charuco)
    number = vars(cv2.aruco).get(name) if name.startswith("DICT_") else None
    if number is None:
        raise BadInput("bad_calibration", f"{name} is not an ArUco dictionary of OpenCV, such as DICT_5X5_100")
    dictionary = cv2.aruco.getPredefinedDictionary(number)
    pattern = cv2.aruco.CharucoBoard((board.columns, board.rows), 1.0, board.marker_fraction, dictionary)
    px, ids, _, _ = cv2.aruco.CharucoDetector(pattern).detectBoard(grey)
    if ids is None or px is None or len(ids) < MIN_CHARUCO_CORNERS:
        return None
    position = np.asarray(pattern.getChessboardCorners(), dtype=np.float64)[np.asarray(ids).ravel()]
    return Corners(np.asarray(px, dtype=np.float64).reshape(-1, 2), position)


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
    width, height = size_px
    most = np.argsort(-np.bincount(points.image), kind="stable")[:IMAGES_TRIED]
    some = points.take(np.isin(points.image, most))
    cameras = [
        Camera(
            name="initial", size_px=size_px, focal_px=(part * width * factor, part * width * factor),
            centre_px=((width - 1) / 2, (height - 1) / 2), max_angle_rad=min(np.pi, lens.max_invertible_rad),
            calibrated_angle_rad=min(np.pi / 2, lens.max_invertible_rad), lens=lens,
        )
        for lens in LENSES
        for factor in FOCAL_FACTORS
        for part in FOCAL_PARTS
    ]  # fmt: skip
    errors = [_board_poses(camera, some)[2] for camera in cameras]
    best = int(np.argmin(errors))
    if errors[best] > LARGEST_ERROR_RAD:
        raise NotIdentified("no lens images flat boards at these corners: is --pattern right?")
    R, position, _ = _board_poses(cameras[best], points)
    return BoardState(camera=cameras[best], R_cam_board=R, position_cam=position)


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
