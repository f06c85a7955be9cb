"""The fix by the stars, refined by the light of the sky that stops at the skyline near it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.evidence import Skyline
from startrack.evidence.sky_checks import sectors_with_step
from startrack.evidence.sky_light import MIDDLES_RAD, SkyLight, measure_sky_light
from startrack.evidence.sky_pixels import pixels_near_skyline
from startrack.localization.refinement import horizon_slopes, refine_fix
from startrack.localization.skyline_fit import SharedErrors, SkylineFit, fit_skyline
from startrack.stages import Measured
from startrack.types import Array, Evidence, Fix

ROUNDS = 3  # of predicted skylines; the step of the last is far below a pixel
SETTLED_PX = 0.3  # a skyline that moves by less need not be predicted anew
NEAR_PX = 20.0  # stars farther from the skyline do not depend on the position here
EDGE_SIGMA_PX = 0.02  # of the whole skyline, from the models of the PSF and of both levels; see benchmarks
MOST_CHI2 = 3.0  # of a sector: the skyline is another
MOST_STARS_CHI2 = 22.0  # of the step against the fix by the stars: one in 60,000


@dataclass(frozen=True, eq=False)
class SkyRefinement:
    """A fix by stars and sky, and the skyline that the sky shows."""

    fix: Fix
    sky: SkyLight
    fit: SkylineFit


def refine_by_sky_light(measured: Measured, fix: Fix, stars: bool = True) -> SkyRefinement | None:
    """The `fix` found with `measured`, refined; None where the image shows no light that stops at the skyline.

    With `stars` the rows of the stars stay in the posterior, otherwise the sky's light alone determines it.
    """
    terrain, camera = measured.terrain, measured.camera
    position, prior_m2 = fix.position_enu_m[:2], fix.covariance_m2
    horizon = Skyline.trace(position, terrain)
    pixels = pixels_near_skyline(measured.detections, camera, measured.R_cam_enu, horizon, measured.light)
    if not len(pixels.light_e):
        return None
    sky = measure_sky_light(pixels, horizon)
    for _ in range(ROUNDS):
        fit = _fit_step(measured, sky, position, fix)
        if fit is None or not np.asarray(terrain.allowed(position + fit.step_m)):
            return None
        position = position + fit.step_m
        if np.abs(fit.px_per_m @ fit.step_m).max() < SETTLED_PX:
            break
        horizon = Skyline.trace(position, terrain)
        sky = sky.above(horizon)
    moved = position - fix.position_enu_m[:2]
    if fit.chi2 > MOST_CHI2 or moved @ np.linalg.solve(prior_m2, moved) > MOST_STARS_CHI2:
        return None
    raised = _shared_errors(measured, sky).raised_px @ fit.shared
    rows = sky.evidence(fit.used, raised, max(fit.chi2, 1.0))
    if stars:
        rows = Evidence.concatenate(_stars_near(measured, horizon, float(np.median(pixels.px_per_rad))), rows)
    by_shared = fit.step_by_shared
    smear = by_shared @ fit.shared_covariance @ by_shared.T
    refined = refine_fix(rows, fix, terrain, position, fit.covariance[:2, :2], smear)
    return SkyRefinement(refined, sky, fit)


def _fit_step(measured: Measured, sky: SkyLight, position_m: Array, fix: Fix) -> SkylineFit | None:
    """The step from a position (2,) that explains the skyline which the sky shows there."""
    terrain = measured.terrain
    used = sectors_with_step(sky)
    if not used.any():
        return None
    map_sigma_px = terrain.horizon_sigma_rad(position_m[None], MIDDLES_RAD) * sky.px_per_rad
    variance = np.where(used, sky.variance_px2 + np.square(map_sigma_px), np.inf)
    slopes = horizon_slopes(terrain, position_m, MIDDLES_RAD) * sky.px_per_rad[:, None]
    shift = sky.shift_px - fix.horizon_error_rad * sky.px_per_rad
    return fit_skyline(
        shift, variance, slopes, _shared_errors(measured, sky), fix.position_enu_m[:2] - position_m, fix.covariance_m2
    )


def _shared_errors(measured: Measured, sky: SkyLight) -> SharedErrors:
    """Errors of the attitude about east and north, and of the level of the whole skyline.

    A rotation w of the camera raises what it shows at azimuth a by w_east cos a - w_north sin a, at any elevation.
    """
    R = measured.R_cam_enu
    turned = (R.T @ measured.attitude_fit.attitude.covariance_rad2 @ R)[:2, :2]
    columns = np.stack([np.cos(MIDDLES_RAD), -np.sin(MIDDLES_RAD), np.ones_like(MIDDLES_RAD)], axis=1)
    scale = sky.px_per_rad
    level = (EDGE_SIGMA_PX / float(np.median(scale))) ** 2 + measured.terrain.common_sigma_rad**2
    covariance = np.zeros((3, 3))
    covariance[:2, :2], covariance[2, 2] = turned, level
    return SharedErrors(columns * scale[:, None], covariance)


def _stars_near(measured: Measured, horizon: Skyline, px_per_rad: float) -> Evidence:
    """The rows of the stars that a small step of the position may hide or show."""
    rows = measured.evidence()
    near = np.abs(rows.elevation_rad - horizon(rows.azimuth_rad)) < NEAR_PX / px_per_rad
    return rows.take(near)


