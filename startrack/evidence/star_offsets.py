"""Offset of the sky near the skyline in the image from what camera and attitude state, by the stars near it.

Pixels of the sky get their direction from the camera and the attitude, stars theirs from the catalogue. What the stars
near the skyline show of the difference is taken out of the pixels' heights; its uncertainty stays with the position.

The stars near the skyline, a tenth of those identified, are also in the fit whose covariance is the attitude's prior.
A prior without their part moves 13 positions by 0.0004 to 0.08 sigma and widens these sigmas by 1.6 % at most.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.camera import Camera, compensating_rotation, lens_jacobian
from startrack.core.types import Array, Bools
from startrack.evidence.photometry import CLIPPED_SIGMAS
from startrack.evidence.skyline import ELEVATION_STEP_RAD, SKYLINE_POINTS, Horizon
from startrack.frames import azel_from_rays, off_axis_rad, rays_from_azel

NEAR_SKYLINE_PX = 60.0  # from the skyline to the stars that are used: five degrees of a 180-degree fisheye
FIRST_CLIPPED_PX, CLIPPING_ROUNDS = 1.0, 3  # of offsets from the terms fitted so far: blends
# Of the offset around the image. Of frames with lens errors of 0.2 px (waves 2 to 4) under a sky of 90 %, 6 of 20 are
# beyond their 99.9 % circles with 2 waves, and 0 of the same and 3 of 20 others with 4, at a third of the error.
MOST_TURNS = 4
TERMS = 1 + 2 * MOST_TURNS
SIGNIFICANT_CHI2 = 27.9  # of all terms: one in a thousand; below, the lens is as its file says
LEAST_SIGMA_PX = 1e-3  # of a term
# Of a term of a calibrated lens, from night to night: beyond what one calibration can know of it. Positions by four
# nights outside the calibration of an all-sky camera erred by 0.8 m an axis where 0.1 px is 0.8 m.
NIGHT_SIGMA_PX = 0.1
# Of a term of a calibrated lens, with the stars of the image: two lens models, fitted to the same stars of six nights
# of that camera, differ by 0.01 to 0.06 px at skylines.
MODEL_SIGMA_PX = 0.03
OFFSET_STARS = 10


@dataclass(frozen=True, eq=False)
class StarOffsets:
    """Terms of the offset (see `offset_terms`) with their covariance."""

    mean_px: Array  # (TERMS,)
    covariance_px2: Array  # (TERMS, TERMS)


def offset_terms(azimuth_rad: Array) -> Array:
    """Terms (n, TERMS) of an offset as a function of `azimuth_rad` (n,): its mean, cosine and sine of each wave."""
    waves = [wave(k * azimuth_rad) for k in range(1, MOST_TURNS + 1) for wave in (np.cos, np.sin)]
    return np.stack([np.ones_like(azimuth_rad), *waves], axis=1)


def measure_star_offsets(
    camera: Camera,
    R_cam_enu: Array,
    attitude_covariance_rad2: Array,
    horizon: Horizon,
    rays_cam: Array,
    residual_px: Array,
    variance_px2: Array,
) -> StarOffsets:
    """Offset of the image at a skyline from the covariances of attitude and lens and the residuals of matched stars.

    Args:
        camera: its covariance is the prior of the lens.
        R_cam_enu: (3, 3) rotation from enu to the camera.
        attitude_covariance_rad2: (3, 3) by the centroids, about the camera's axes.
        horizon: elevations of the skyline.
        rays_cam: (n, 3) directions of matched stars.
        residual_px: (n, 2) measured less predicted.
        variance_px2: (n,) of a residual, per axis.
    """
    prior = _prior_px2(camera, R_cam_enu, attitude_covariance_rad2, horizon)
    azimuth, elevation = azel_from_rays(rays_cam @ R_cam_enu)
    up, scale = _up_in_image(camera, R_cam_enu, azimuth, elevation)
    above_px = (elevation - horizon(azimuth)) * scale
    offset = np.einsum("ni,ni->n", residual_px, up)
    near, terms, sigma = np.abs(above_px) < NEAR_SKYLINE_PX, offset_terms(azimuth), np.sqrt(variance_px2)
    limit, mean = np.maximum(CLIPPED_SIGMAS * sigma, FIRST_CLIPPED_PX), np.zeros(TERMS)
    for _ in range(CLIPPING_ROUNDS):
        used: Bools = near & (np.abs(offset - terms @ mean) < limit)
        if np.count_nonzero(used) < OFFSET_STARS:
            return StarOffsets(np.zeros(TERMS), prior)
        weighted = terms[used] / variance_px2[used, None]
        normal, right = weighted.T @ terms[used], weighted.T @ offset[used]
        alone = np.linalg.pinv(normal, hermitian=True)
        limit, mean = CLIPPED_SIGMAS * sigma, alone @ right
    if mean @ np.linalg.pinv(alone + prior, hermitian=True) @ mean > SIGNIFICANT_CHI2:
        prior = prior + max(float(np.mean(np.square(mean) - np.diag(alone))), 0.0) * np.eye(TERMS)
    covariance = np.linalg.inv(np.linalg.inv(prior) + normal)
    by_model = 0.0 if camera.covariance is None else MODEL_SIGMA_PX**2
    return StarOffsets(np.asarray(covariance @ right), np.asarray(covariance + by_model * np.eye(TERMS)))


def _prior_px2(camera: Camera, R_cam_enu: Array, attitude_covariance_rad2: Array, horizon: Horizon) -> Array:
    """Covariance (TERMS, TERMS) of the terms by attitude and lens together."""
    azimuth = np.linspace(0.0, 2 * np.pi, SKYLINE_POINTS // 4, endpoint=False)
    rays_cam = rays_from_azel(azimuth, horizon(azimuth)) @ R_cam_enu.T
    seen = off_axis_rad(rays_cam) < min(camera.calibrated_angle_rad, camera.lens.max_invertible_rad)
    azimuth, elevation, rays_cam = azimuth[seen], horizon(azimuth[seen]), rays_cam[seen]
    up, _ = _up_in_image(camera, R_cam_enu, azimuth, elevation)
    to_terms = np.linalg.pinv(offset_terms(azimuth))
    rotation = camera.jacobian_px_per_rad(rays_cam)
    by_rotation = to_terms @ np.einsum("ni,nij->nj", up, rotation)
    prior = by_rotation @ attitude_covariance_rad2 @ by_rotation.T + LEAST_SIGMA_PX**2 * np.eye(TERMS)
    if camera.covariance is not None:
        order = camera.covariance_order
        lens = lens_jacobian(camera, rays_cam, order) + rotation @ compensating_rotation(camera, order)
        by_lens = to_terms @ np.einsum("ni,nij->nj", up, lens)
        prior = prior + by_lens @ camera.covariance @ by_lens.T + NIGHT_SIGMA_PX**2 * np.eye(TERMS)
    return np.asarray(prior)


def _up_in_image(camera: Camera, R_cam_enu: Array, azimuth: Array, elevation: Array) -> tuple[Array, Array]:
    """Unit vectors (n, 2) of growing elevation in the image, and pixels per radian (n,)."""
    low, high = (
        camera.project_unlimited(rays_from_azel(azimuth, elevation + step) @ R_cam_enu.T)
        for step in (-ELEVATION_STEP_RAD, ELEVATION_STEP_RAD)
    )
    length = np.maximum(np.hypot(*(high - low).T), 1e-9)
    return (high - low) / length[:, None], length / (2 * ELEVATION_STEP_RAD)
