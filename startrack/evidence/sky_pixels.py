"""Pixels of the diffuse sky and the ground near a predicted skyline, without those that show stars or defects."""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
from dataclasses import dataclass
from math import sqrt

import numpy as np

from startrack.camera import Camera
from startrack.core.kernels import njit
from startrack.core.types import Array, Bools, Detections
from startrack.evidence.sky_step import (
    BAND_PX,
    ELEVATION_STEP_RAD,
    SKYLINE_POINTS,
    Horizon,
    Skyline,
    look_through,
    skyline_band,
)
from startrack.evidence.star_evidence import StarPhotometry, filtered_noise_e
from startrack.frames import azel_from_rays, off_axis_rad, rays_from_azel
from startrack.psf import noise_area_px

MASKED_SIGMA = 0.4  # light of a known star, in a pixel's noise, from which the pixel is left out
CIRCLE_EDGE_PX = 3.0  # beside the end of the image circle
UNRESOLVED_PX2 = 1.0 / 12.0  # variance of the position in a pixel


@dataclass(frozen=True, eq=False)
class SkyPixels:
    """Pixels (n,) near a predicted skyline, each with its direction and its light."""

    azimuth_rad: Array  # in enu
    elevation_rad: Array
    px_per_rad: Array  # of elevation, across the skyline
    height_px: Array  # above the skyline, across it
    light_e: Array
    edge_px: float  # width of a sharp edge in the image: the PSF and the pixel


def pixels_near_skyline(
    detections: Detections, camera: Camera, R_cam_enu: Array, horizon: Horizon, stars: StarPhotometry
) -> SkyPixels:
    """Pixels of the `detections`' image near a `horizon` that show no known star and no source.

    `camera` and `R_cam_enu` place the skyline in the image; `stars` are those whose light is left out, visible or not.
    """
    band = skyline_band(detections.image_e.shape, camera, R_cam_enu, horizon)
    _leave_out_stars(band, detections, stars)
    pixel, rays_cam = look_through(band & ~detections.dead, camera)
    azimuth, elevation = azel_from_rays(rays_cam @ R_cam_enu)
    scale = scale_across(camera, R_cam_enu, horizon)(azimuth)
    height = (elevation - horizon(azimuth)) * scale
    limit_rad = min(camera.calibrated_angle_rad, camera.max_angle_rad) - CIRCLE_EDGE_PX / camera.focal_px[0]
    usable = np.flatnonzero((rays_cam[:, 2] > np.cos(limit_rad)) & (np.abs(height) < BAND_PX))
    return SkyPixels(
        azimuth_rad=azimuth[usable],
        elevation_rad=elevation[usable],
        px_per_rad=scale[usable],
        height_px=height[usable],
        light_e=detections.image_e.ravel()[pixel[usable]].astype(np.float64),
        edge_px=sqrt(detections.psf_sigma_px**2 + UNRESOLVED_PX2),
    )


def scale_across(camera: Camera, R_cam_enu: Array, horizon: Horizon) -> Skyline:
    """Pixels per radian of elevation across the image of a `horizon`, as a function of azimuths [rad].

    Across, not upwards: a steep skyline is closer than it is high. `camera` and `R_cam_enu` place it in the image.
    """
    azimuth = np.linspace(0.0, 2 * np.pi, SKYLINE_POINTS, endpoint=False)
    elevation = horizon(azimuth)
    rays_cam = rays_from_azel(azimuth, elevation) @ R_cam_enu.T
    seen = off_axis_rad(rays_cam) < min(camera.max_angle_rad, camera.lens.max_invertible_rad)

    def pixels(turned: int, raised_rad: float) -> Array:
        rays_enu = rays_from_azel(np.roll(azimuth, turned), np.roll(elevation, turned) + raised_rad)
        return camera.project_unlimited((rays_enu @ R_cam_enu.T)[seen])

    up = (pixels(0, ELEVATION_STEP_RAD) - pixels(0, -ELEVATION_STEP_RAD)) / (2 * ELEVATION_STEP_RAD)
    along = pixels(-1, 0.0) - pixels(1, 0.0)
    across = np.abs(up[:, 0] * along[:, 1] - up[:, 1] * along[:, 0])
    scale = np.ones(SKYLINE_POINTS)
    scale[seen] = across / np.maximum(np.hypot(*along.T), 1e-9)
    return Skyline(scale)


def _leave_out_stars(band: Bools, detections: Detections, stars: StarPhotometry) -> None:
    """Clear the pixels of the band (H, W) that hold light of known stars, visible or hidden, or of detections."""
    sigma2 = detections.psf_sigma_px**2 + UNRESOLVED_PX2
    noise_e = filtered_noise_e(detections) / sqrt(noise_area_px(detections.psf_sigma_px))
    xy_px = np.concatenate([stars.xy_px, detections.xy_px])
    peak = np.concatenate([stars.expected_e, detections.flux_e]) / (2 * np.pi * sigma2 * max(noise_e, 1e-9))
    bright = np.flatnonzero(peak > MASKED_SIGMA)
    radius = np.ceil(np.sqrt(2 * sigma2 * np.log(peak[bright] / MASKED_SIGMA)) + 0.5)
    _clear_disks(band, np.rint(np.clip(xy_px[bright], -1e6, 1e6)).astype(np.int64), radius.astype(np.int64))


@njit(cache=True, nogil=True)
def _clear_disks(mask, xy_px, radius_px):
    """Clear the pixels of a mask (H, W) within `radius_px` (n,) of the pixels (n, 2).

    A small disk whose middle the mask lacks hardly reaches into the band: it is left out.
    """
    height, width = mask.shape
    touching = radius_px > BAND_PX / 2
    for k in range(len(xy_px)):
        x, y = xy_px[k, 0], xy_px[k, 1]
        touching[k] |= 0 <= x < width and 0 <= y < height and mask[y, x]
    for k in np.flatnonzero(touching):
        x, y, r = xy_px[k, 0], xy_px[k, 1], radius_px[k]
        for row in range(max(y - r, 0), min(y + r + 1, height)):
            for column in range(max(x - r, 0), min(x + r + 1, width)):
                if (column - x) ** 2 + (row - y) ** 2 <= r * r:
                    mask[row, column] = False
