"""Errors that shift the whole skyline of an image: of attitude and lens, of the terrain, and of the clock."""

from __future__ import annotations

import numpy as np

from startrack.evidence.sky_light import MIDDLES_RAD, SkyLight
from startrack.evidence.sky_step import Horizon
from startrack.evidence.star_offsets import OFFSET_TERMS, StarOffsets, measure_star_offsets, offset_terms
from startrack.frames import R_from_rotvec, turn_azel
from startrack.localization.skyline_fit import SharedErrors
from startrack.stages import Measured
from startrack.terrain import Terrain
from startrack.types import Array, Clock, Fix

EDGE_SIGMA_PX = 0.02  # of the whole skyline, from the models of the PSF and of both levels; see benchmarks
SHAPE_STEP = 1e-4  # relative, at which the horizon's change with the terrain's shape is taken
TURN_STEP_RAD = 2e-3  # of the sky, at which the skyline's change with the time is taken: its crests are no narrower


def shared_errors(measured: Measured, sky: SkyLight, position_m: Array, fix: Fix, clock: Clock | None) -> SharedErrors:
    """The errors at a position (2,): of the image, of the terrain, and of a `clock` (None: the time is exact)."""
    terrain, offsets = measured.terrain, _star_offsets(measured, sky.horizon)
    columns, means, variances = [offset_terms(MIDDLES_RAD)], list(offsets.mean_px), []
    if terrain.common_sigma_rad > 0.0:
        columns.append(sky.px_per_rad[:, None])
        means.append(fix.horizon_error_rad)
        variances.append(terrain.common_sigma_rad**2)
    for k, sigma in enumerate(terrain.shape_sigma):
        if sigma > 0.0:
            columns.append((_raised_by_shape(terrain, position_m, k) * sky.px_per_rad)[:, None])
            means.append(0.0)
            variances.append(sigma**2)
    if clock is not None:
        columns.append((_raised_by_clock(sky.horizon, clock) * sky.px_per_rad)[:, None])
        means.append(-clock.offset_s)
        variances.append(clock.sigma_s**2)
    covariance = np.zeros((len(means),) * 2)
    covariance[:OFFSET_TERMS, :OFFSET_TERMS] = offsets.covariance_px2
    covariance[0, 0] += EDGE_SIGMA_PX**2
    covariance[OFFSET_TERMS:, OFFSET_TERMS:] = np.diag(variances)
    of_terrain = np.arange(len(means)) >= OFFSET_TERMS
    at = None if clock is None else len(means) - 1
    return SharedErrors(np.concatenate(columns, axis=1), np.array(means), covariance, of_terrain, at)


def _raised_by_shape(terrain: Terrain, position_m: Array, which: int) -> Array:
    """How much (sectors,) a relative change of the terrain's shape raises the skyline."""
    changed = terrain.reshaped(SHAPE_STEP * np.eye(2)[which])
    here, there = (ground.horizon_rad(position_m[None], MIDDLES_RAD) for ground in (terrain, changed))
    return np.asarray(there - here) / SHAPE_STEP


def _raised_by_clock(horizon: Horizon, clock: Clock) -> Array:
    """How much (sectors,) a second that the true time is later raises the skyline among the stars."""
    step_s = TURN_STEP_RAD / float(np.linalg.norm(clock.turn_rad_s))
    raised = []
    for later_s in (-step_s, step_s):
        R = R_from_rotvec(later_s * clock.turn_rad_s)
        azimuth, elevation = turn_azel(MIDDLES_RAD, horizon(MIDDLES_RAD), R)
        raised.append(horizon(azimuth) - elevation)
    return np.asarray(raised[1] - raised[0]) / (2 * step_s)


def _star_offsets(measured: Measured, horizon: Horizon) -> StarOffsets:
    """Offset of the image at the skyline, by attitude, lens and the identified stars near it."""
    found, fit, camera = measured.identification, measured.attitude_fit, measured.camera
    rays_cam = measured.stars.rays_icrs[found.star[fit.used]] @ fit.attitude.R_cam_icrs.T
    centroids = measured.detections.covariance_px2[found.detection[fit.used]]
    variance = 0.5 * np.trace(centroids, axis1=1, axis2=2) + fit.extra_sigma_px**2
    return measure_star_offsets(
        camera, measured.R_cam_enu, fit.centroid_covariance_rad2, horizon, rays_cam, fit.residual_px[fit.used], variance
    )
