"""A pinhole of unknown focal length: stars brought onto detections, with the few numbers that this takes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from startrack.camera import Camera, KannalaBrandt, Lens, Pinhole
from startrack.frames import R_from_rotvec
from startrack.types import Array, Bools, Ints

LONGEST_STEP = 0.1
FEWEST = 5
TANGENT = (1 / 3, 2 / 15, 17 / 315, 62 / 2835)  # series of tan a beyond a: to 1e-7 up to 20 degrees
STEEPEST_RAD = 1.0


@dataclass(frozen=True)
class View:
    """Attitude and focal length of a frame (W, H) whose optical axis is its middle."""

    R_cam_icrs: Array
    focal_px: float
    mirrored: bool
    size_px: tuple[int, int]
    bend: float = 0.0  # of the radius [focal lengths] per cube of the angle off the axis, beyond the pinhole's tangent

    @property
    def middle_px(self) -> Array:
        """(2,)"""
        return 0.5 * (np.array(self.size_px) - 1.0)

    def project(self, rays_icrs: Array) -> tuple[Array, Bools]:
        """Pixels (n, 2) of rays (n, 3) less than 90 degrees off the axis, and which lie in the frame."""
        cam = rays_icrs @ self.R_cam_icrs.T
        plane = cam[:, :2] / np.maximum(cam[:, 2], 1e-6)[:, None]
        px = plane * self._bent(plane)[:, None] * self._handed + self.middle_px
        reach = 0.5 * np.array(self.size_px)
        return px, (np.abs(px - self.middle_px) <= reach).all(axis=1) & (cam[:, 2] > 0)

    def fitted(self, xy_px: Array, rays_icrs: Array, sigma_px: float, bend: bool, steps: int = 1) -> View:
        """The view that brings the stars (n, 3) onto the pixels (n, 2): `steps` of Gauss-Newton, Cauchy's weights.

        With `bend` the lens need not be a pinhole's.
        """
        view = self
        for _ in range(steps):
            cam = rays_icrs @ view.R_cam_icrs.T
            plane = cam[:, :2] / cam[:, 2:]
            scale = view._bent(plane)
            miss = xy_px - view.middle_px - plane * scale[:, None] * view._handed
            weight = 1.0 / (1.0 + np.einsum("ni,ni->n", miss, miss) / (2 * sigma_px) ** 2)
            slope = view._slopes(plane, scale)[..., : 5 if bend else 4]
            flat = slope.reshape(-1, slope.shape[2])
            weighted = (slope * weight[:, None, None]).reshape(flat.shape)
            step = np.linalg.solve(weighted.T @ flat + 1e-9 * np.eye(flat.shape[1]), weighted.T @ miss.reshape(-1))
            step = np.clip(step, -LONGEST_STEP, LONGEST_STEP)
            view = replace(
                view,
                R_cam_icrs=R_from_rotvec(step[:3]) @ view.R_cam_icrs,
                focal_px=float(view.focal_px * np.exp(step[3])),
                bend=view.bend + float(step[4]) if bend else view.bend,
            )
        return view

    def straight(self) -> View:
        """The same with a pinhole."""
        return replace(self, bend=0.0)

    def _bent(self, plane: Array) -> Array:
        """Radius over that of a pinhole (n,), at places (n, 2) [focal lengths] of the pinhole's plane."""
        return 1.0 + self.bend * _cube(plane) if self.bend else np.ones(len(plane))

    def _slopes(self, plane: Array, scale: Array) -> Array:
        """d px / d (turns about the camera's axes, log focal, bend) (n, 2, 5); the bend's own change is left out."""
        (u, v), (fx, fy) = plane.T, self._handed
        slope = np.empty((len(u), 2, 5))
        slope[:, 0, 0], slope[:, 0, 1], slope[:, 0, 2] = -fx * u * v, fx * (1 + u * u), -fx * v
        slope[:, 1, 0], slope[:, 1, 1], slope[:, 1, 2] = -fy * (1 + v * v), fy * u * v, fy * u
        handed = plane * self._handed
        slope[:, :, 3] = handed * scale[:, None]
        slope[:, :, 4] = handed * _cube(plane)[:, None]
        return slope

    def camera(self) -> Camera:
        """The camera, as wide as its frame."""
        width, height = self.size_px
        lens: Lens = KannalaBrandt((TANGENT[0] + self.bend, *TANGENT[1:])) if self.bend else Pinhole()
        middle = (0.5 * (width - 1), 0.5 * (height - 1))
        camera = Camera(
            name="unknown", size_px=self.size_px, focal_px=(self.focal_px, self.focal_px), centre_px=middle,
            max_angle_rad=STEEPEST_RAD, calibrated_angle_rad=STEEPEST_RAD, lens=lens, mirrored=self.mirrored,
        )  # fmt: skip
        corner = float(camera.angle_rad(np.array([-0.5, -0.5])))
        return replace(camera, max_angle_rad=corner, calibrated_angle_rad=corner)

    @property
    def _handed(self) -> Array:
        return np.array([-self.focal_px if self.mirrored else self.focal_px, self.focal_px])


def _cube(plane: Array) -> Array:
    """Cube of the angle off the axis over the radius (n,) of places (n, 2) of a pinhole's plane."""
    radius = np.sqrt(np.einsum("ni,ni->n", plane, plane))
    return np.asarray(np.arctan(radius) ** 3 / np.maximum(radius, 1e-12))


def nearest_pairs(tree: Any, px: Array, gate_px: float) -> tuple[Ints, Ints, Array]:
    """(detection, star, distance) of the stars' pixels (n, 2) next to detections in the k-d tree, one-to-one."""
    distance, detection = tree.query(px, distance_upper_bound=gate_px)
    star = np.flatnonzero(np.isfinite(distance))
    star = star[np.lexsort((distance[star], detection[star]))]
    star = star[np.flatnonzero(np.diff(detection[star], prepend=-1))]
    return detection[star].astype(np.int64), star, distance[star]
