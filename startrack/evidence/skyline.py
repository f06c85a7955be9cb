"""A predicted skyline in an image: its elevations, its scale in pixels, and the pixels beside it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from startrack.camera import Camera
from startrack.core.statistics import interpolate_circle
from startrack.core.types import MIDDLES_RAD, SECTORS, Array, Bools, Ints
from startrack.frames import R_from_rotvec, azel_from_rays, off_axis_rad, rays_from_azel
from startrack.terrain import Terrain

BAND_PX = 12.0  # from the skyline to the last pixels that are used; the background model has no sharper edge
CLIP_SHIFT_PX = 1.0  # by which any prediction may be wrong
SKYLINE_SIGMAS = 2.0  # of the prediction
MOST_REACH_PX = 6.0  # of a skyline that is known well enough to be measured
SKYLINE_POINTS = 1440
AROUND_RAD = np.linspace(0.0, 2 * np.pi, SKYLINE_POINTS, endpoint=False)
SKYLINE_SAMPLES = 5 * SKYLINE_POINTS  # one in 3 arcmin: half a pixel of a 180-degree fisheye
ELEVATION_STEP_RAD = 1e-3  # of derivatives
MAX_SLOPE = 1.0

Horizon = Callable[[Array], Array]  # azimuths (n,) to elevations (n,) [rad]


@dataclass(frozen=True)
class Skyline:
    """The horizon of one position: elevations [rad] at equally spaced azimuths, called with `azimuth_rad` (n,)."""

    elevation_rad: Array

    @classmethod
    def trace(cls, position_m: Array, terrain: Terrain, samples: int = SKYLINE_SAMPLES) -> Skyline:
        """The horizon of a `terrain` at `position_m` (2,), traced once at `samples` azimuths.

        On a height map that takes time.
        """
        azimuth = np.linspace(0.0, 2 * np.pi, samples, endpoint=False)
        return cls(terrain.horizon_rad(np.asarray(position_m)[None, :], azimuth))

    def __call__(self, azimuth_rad: Array) -> Array:
        return interpolate_circle(self.elevation_rad, azimuth_rad)

    def raised(self, by_rad: Array) -> Skyline:
        """Copy of this skyline that is higher by `by_rad` (n,) [rad] in the middle of n sectors from north eastward."""
        azimuth = np.linspace(0.0, 2 * np.pi, len(self.elevation_rad), endpoint=False)
        middle = (np.arange(len(by_rad)) + 0.5) * 2 * np.pi / len(by_rad)
        return Skyline(self.elevation_rad + np.interp(azimuth, middle, by_rad, period=2 * np.pi))


@dataclass(frozen=True, eq=False)
class SkylineEstimate:
    """The skyline by a first fix, and how well it is known."""

    skyline: Skyline
    sigma_rad: Array  # (SECTORS,) of its elevation

    @classmethod
    def of(cls, position_m: Array, covariance_m2: Array, terrain: Terrain, raised_rad: Array | None) -> SkylineEstimate:
        """Estimate for a `terrain` at `position_m` (2,), raised by `raised_rad` (SECTORS,); None: by nothing.

        Its sigma is by the covariance `covariance_m2` (2, 2) of the position and by the errors of the map.
        """
        skyline = Skyline.trace(position_m, terrain)
        variance_m2, axes = np.linalg.eigh(covariance_m2)
        axes = (axes * np.sqrt(np.maximum(variance_m2, 0.0))).T
        there = terrain.horizon_rad((position_m + np.vstack([np.zeros(2), axes, -axes]))[:, None], MIDDLES_RAD)
        by_map = np.asarray(terrain.errors.sigma_rad(np.asarray(position_m)[None], MIDDLES_RAD)).ravel()
        moved = (
            np.abs(there[1:] - there[0]).reshape(2, 2, -1).min(axis=0)
        )  # beyond a wall nearby the horizon is no measure
        sigma = np.sqrt(np.square(moved).sum(axis=0) + np.square(by_map))
        return cls(skyline if raised_rad is None else skyline.raised(raised_rad), sigma)

    def star_motion_rad(self, turn_rad: Array) -> Array:
        """Motion (SECTORS,) [rad] of stars across this skyline, in height above it, while the sky turns.

        `turn_rad` (3,) is the rotation vector in enu of the turn, half of it before the middle of the exposure. The
        motion is the median in each sector: where the skyline jumps only the stars at the jump move by its height.
        """
        rays = rays_from_azel(AROUND_RAD, self.skyline(AROUND_RAD))
        ends = [azel_from_rays(rays @ R_from_rotvec(part * turn_rad).T) for part in (-0.5, 0.5)]
        before, after = (elevation - self.skyline(azimuth) for azimuth, elevation in ends)
        return np.asarray(np.median(np.abs(after - before).reshape(SECTORS, -1), axis=1))

    def is_level(self, azimuth_rad: Array) -> Bools:
        """Whether the skyline at `azimuth_rad` (n,) is so level that a small shift does not turn it."""
        here = self.skyline(AROUND_RAD)
        run = 2 * np.pi / SKYLINE_POINTS * np.cos(here)
        steep = np.abs(np.roll(here, -1) - np.roll(here, 1)) / (2 * run)
        at = np.rint(azimuth_rad / (2 * np.pi) * SKYLINE_POINTS).astype(np.int64) % SKYLINE_POINTS
        return np.asarray(steep[at] < MAX_SLOPE)


def scale_across(camera: Camera, R_cam_enu: Array, horizon: Horizon) -> Skyline:
    """Pixels per radian of elevation across the image of a `horizon`, as a function of azimuths [rad].

    Across, not upwards: a steep skyline is closer than it is high. `camera` and `R_cam_enu` place it in the image. Out
    of the view it is the median of that in view.
    """
    elevation = horizon(AROUND_RAD)
    rays_cam = rays_from_azel(AROUND_RAD, elevation) @ R_cam_enu.T
    seen = off_axis_rad(rays_cam) < min(camera.max_angle_rad, camera.lens.max_invertible_rad)

    def pixels(turned: int, raised_rad: float) -> Array:
        rays_enu = rays_from_azel(np.roll(AROUND_RAD, turned), np.roll(elevation, turned) + raised_rad)
        return camera.project_unlimited((rays_enu @ R_cam_enu.T)[seen])

    up = (pixels(0, ELEVATION_STEP_RAD) - pixels(0, -ELEVATION_STEP_RAD)) / (2 * ELEVATION_STEP_RAD)
    along = pixels(-1, 0.0) - pixels(1, 0.0)
    across = np.abs(up[:, 0] * along[:, 1] - up[:, 1] * along[:, 0])
    found = across / np.maximum(np.hypot(*along.T), 1e-9)
    scale = np.full(SKYLINE_POINTS, np.median(found) if len(found) else 1.0)
    scale[seen] = found
    return Skyline(scale)


def skyline_band(
    shape: tuple[int, ...], camera: Camera, R_cam_enu: Array, horizon: Horizon, half_px: float
) -> Bools:  # fmt: skip
    """Pixels (H, W) of an image of that `shape` within `half_px` of a `horizon`, with some to spare.

    `camera` and `R_cam_enu` place the skyline in the image.
    """
    xy, inside = camera.project(rays_from_azel(AROUND_RAD, horizon(AROUND_RAD)) @ R_cam_enu.T)
    picture = np.full(shape, 0, dtype=np.uint8)  # np.zeros would take small memory pages
    points = np.rint(xy).astype(np.int32)
    both = np.flatnonzero(inside & np.roll(inside, 1))
    cv2.polylines(
        picture, list(np.stack([points[both - 1], points[both]], axis=1)), False, (1.0,), int(2 * half_px) + 3
    )
    return picture.view(np.bool_)


def look_through(chosen: Bools, camera: Camera) -> tuple[Ints, Array]:
    """Indices (n,) of the `chosen` pixels (H, W) in the flat image, and their directions (n, 3) from the `camera`."""
    pixel = np.flatnonzero(chosen)
    rows, columns = np.divmod(pixel, chosen.shape[1])
    return pixel, camera.unproject(np.stack([columns, rows], axis=1).astype(np.float64))
