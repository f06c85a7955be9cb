"""Pixels that scanned obstacles hide: they say nothing about the ground's skyline."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from startrack.camera import Camera
from startrack.core.obstacles import Obstacles, read_obstacles
from startrack.core.types import Array, Bools, Detections, Mask
from startrack.exposure import combine_masks
from startrack.frames import azel_from_rays
from startrack.terrain import Terrain

R_COMPASS_BODY = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # right, forward, up
HIDDEN_BLOCK_PX = 4  # a square that one direction stands for; so many pixels about obstacles are hidden too


def add_obstacles(
    mask: Mask | None, camera: Camera, R_enu_cam: Array, terrain: Terrain, of_image: str | Obstacles | None = None
) -> Mask | None:
    """The `mask` with the pixels that the obstacles of `camera`, `terrain` and image hide; None: nothing is hidden.

    `of_image` are those of the sidecar. Azimuths of a camera's obstacles count from the rover's nose to its right, and
    its elevations are above the plane of the body's x and y; the others are in enu, `R_enu_cam` (3, 3) from the camera.
    Raises BadInput: bad_calibration and bad_image for files that cannot be used.
    """
    stated = (
        (camera.obstacles, R_COMPASS_BODY @ camera.R_body_cam, "bad_calibration"),
        (terrain.file.obstacles, R_enu_cam, "bad_terrain"), (of_image, R_enu_cam, "bad_image"),
    )  # fmt: skip
    for given, R, reason in stated:
        if given is not None:
            obstacles = given if isinstance(given, Obstacles) else read_obstacles(given, reason)
            hidden = Mask(masked=_hidden_pixels(obstacles, camera, R), sha256=obstacles.sha256)
            dead_part = 0.0 if mask is None else mask.dead_part
            joined = combine_masks(hidden, mask, camera.size_px)
            mask = joined if joined is None else replace(joined, dead_part=dead_part)
    return mask


def mask_obstacles(detections: Detections, mask: Mask | None) -> Detections:
    """The same `detections` with another `mask`, whose pixels count as dead."""
    if mask is detections.mask or mask is None:
        return detections
    return replace(detections, mask=mask, dead=detections.dead | mask.masked)


def _hidden_pixels(obstacles: Obstacles, camera: Camera, R_frame_cam: Array) -> Bools:
    """Whether pixels (H, W), or others up to HIDDEN_BLOCK_PX beside them, have directions that obstacles hide."""
    import cv2

    width, height = camera.size_px
    columns, rows = (np.arange(0, n, HIDDEN_BLOCK_PX) + 0.5 * (HIDDEN_BLOCK_PX - 1) for n in (width, height))
    px = np.stack(np.meshgrid(columns, rows), axis=-1)
    azimuth, elevation = azel_from_rays(camera.unproject(px.reshape(-1, 2)) @ R_frame_cam.T)
    blocks = obstacles.hides(azimuth, elevation).reshape(len(rows), len(columns)).astype(np.uint8)
    whole = np.repeat(np.repeat(blocks, HIDDEN_BLOCK_PX, axis=0), HIDDEN_BLOCK_PX, axis=1)[:height, :width]
    side = 2 * HIDDEN_BLOCK_PX + 1
    return np.asarray(cv2.dilate(whole, np.ones((side, side), np.uint8)) > 0)
