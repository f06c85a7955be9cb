"""Boards at finite distances: an attitude and a place each, by any lens, also past 90 degrees."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from startrack.calibration.initial_camera import LENSES, STRETCHES
from startrack.calibration.normal import Terms
from startrack.calibration.observations import Observations
from startrack.calibration.solve import State
from startrack.camera import Camera
from startrack.camera.uncertainty import lens_jacobian
from startrack.frames import R_from_rotvec, nearest_rotation
from startrack.types import Array, NotIdentified

IMAGES_TRIED = 4
WRONG_RAD = 0.05


@dataclass(frozen=True, kw_only=True)
class BoardState(State):
    """Here the observations' `rays_icrs` are places on the board, and R_cam_icrs turns the board's axes to cam."""

    place: Array  # (images, 3) of the board's origin in cam [squares]

    def _points_cam(self, points: Observations) -> Array:
        turned = np.einsum("nij,nj->ni", self.R_cam_icrs[points.image], points.rays_icrs)
        return turned + self.place[points.image]

    def rays_cam(self, points: Observations) -> Array:
        """Directions (n, 3) of the corners in their cameras' axes."""
        seen = self._points_cam(points)
        return seen / np.linalg.norm(seen, axis=1, keepdims=True)

    def terms(self, points: Observations, rays_cam: Array, free: tuple[str, ...]) -> Terms:
        """Derivatives by the free parameters, and by turns of the camera and shifts of the board (q = 6)."""
        turn = self.camera.jacobian_px_per_rad(rays_cam)
        x, y, z = rays_cam.T / np.linalg.norm(self._points_cam(points), axis=1)
        zero = np.zeros_like(x)
        # A shift d of a point at the distance L turns its ray r by r x d / L.
        cross = np.stack([np.stack([zero, -z, y], 1), np.stack([z, zero, -x], 1), np.stack([-y, x, zero], 1)], axis=1)
        both = np.concatenate([turn, turn @ cross], axis=2)
        return Terms(lens_jacobian(self.camera, rays_cam, free), both, points.image, len(self.R_cam_icrs))

    def stepped(self, free: tuple[str, ...], lens: Array, turns_rad: Array) -> BoardState:
        """The state after a step; `turns_rad` (images, 6): turns [rad] and shifts [squares]."""
        turned = super().stepped(free, lens, turns_rad[:, :3])
        R = R_from_rotvec(turns_rad[:, :3])
        place = np.einsum("nij,nj->ni", R, self.place) + turns_rad[:, 3:]
        return replace(self, camera=turned.camera, R_cam_icrs=turned.R_cam_icrs, place=place)


def first_board_state(points: Observations, size_px: tuple[int, int]) -> BoardState:
    """The best of many simple cameras in the middle of the frame. Raises NotIdentified where none fits."""
    width, height = size_px
    most = np.argsort(-np.bincount(points.image), kind="stable")[:IMAGES_TRIED]
    some = points.take(np.isin(points.image, most))
    best: tuple[float, Camera] | None = None
    for lens in LENSES:
        for part in STRETCHES:
            for wide in (0.33, 1.0):
                focal = wide * width * part
                camera = Camera(
                    name="first guess", size_px=size_px, focal_px=(focal, focal),
                    centre_px=((width - 1) / 2, (height - 1) / 2), max_angle_rad=min(np.pi, lens.max_invertible_rad),
                    calibrated_angle_rad=min(np.pi / 2, lens.max_invertible_rad), lens=lens,
                )  # fmt: skip
                score = _poses(camera, some)[2]
                if best is None or score < best[0]:
                    best = (score, camera)
    if best is None or best[0] > WRONG_RAD:
        raise NotIdentified("no lens makes flat boards of these corners: is --pattern right?")
    R, place, _ = _poses(best[1], points)
    return BoardState(camera=best[1], R_cam_icrs=R, place=place)


def _poses(camera: Camera, points: Observations) -> tuple[Array, Array, float]:
    """Attitudes, places and the median angle [rad] by which corners miss, image by image from a homography."""
    R, place = np.tile(np.eye(3), (points.images, 1, 1)), np.tile([0.0, 0.0, 1.0], (points.images, 1))
    misses = []
    for i in np.unique(points.image):
        own = points.take(points.image == i)
        rays = camera.unproject(own.xy_px)
        R[i], place[i] = _pose(rays, own.rays_icrs)
        seen = own.rays_icrs @ R[i].T + place[i]
        seen /= np.linalg.norm(seen, axis=1, keepdims=True)
        misses.append(np.linalg.norm(seen - rays, axis=1))
    return R, place, float(np.median(np.concatenate(misses)))


def _pose(rays: Array, places: Array) -> tuple[Array, Array]:
    """Attitude and place of a flat board from rays (n, 3) and places on it (n, 3): r x (H p) = 0, linear in H."""
    flat = np.column_stack([places[:, :2], np.ones(len(places))])
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
    H = H if np.sum(rays * (flat @ H.T)) > 0 else -H  # the board is where the rays point, not behind
    scale = 2.0 / (np.linalg.norm(H[:, 0]) + np.linalg.norm(H[:, 1]))
    first, second = H[:, 0] * scale, H[:, 1] * scale
    return nearest_rotation(np.stack([first, second, np.cross(first, second)], axis=1)), H[:, 2] * scale
