"""The fix by the stars, refined by the light of the sky that stops at the skyline near it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from startrack.evidence import Skyline
from startrack.evidence.sky_checks import sectors_with_step
from startrack.evidence.sky_levels import sector_of
from startrack.evidence.sky_light import MIDDLES_RAD, SkyLight, measure_sky_light
from startrack.evidence.sky_pixels import pixels_near_skyline
from startrack.evidence.sky_step import Horizon
from startrack.evidence.star_offsets import StarOffsets, measure_star_offsets, offset_terms
from startrack.localization.refinement import horizon_slopes, refine_fix
from startrack.localization.skyline_fit import SharedErrors, SkylineFit, fit_skyline
from startrack.stages import Located, Measured
from startrack.types import Array, Evidence, Fix, NotLocated

ROUNDS = 5  # of predicted skylines; the step of the last is far below a pixel
SETTLED_PX = 0.3  # a skyline that moves by less need not be predicted anew
NEAR_PX = 20.0  # stars farther from the skyline do not depend on the position here
EDGE_SIGMA_PX = 0.02  # of the whole skyline, from the models of the PSF and of both levels; see benchmarks
SHAPE_STEP = 1e-4  # relative, at which the horizon's change with the terrain's shape is taken
MOST_CHI2 = 3.0  # of a sector: the skyline is another
MOST_STARS_CHI2 = 22.0  # of the step against the fix by the stars: one in 60,000


def refine_by_sky_light(located: Located, stars: bool = True) -> Located:
    """`located` with its fix by the stars refined; as it was where the image shows no light that stops at the skyline.

    With `stars` their rows stay in the posterior, otherwise the sky's light alone determines it: then raises NotLocated
    (insufficient_geometry) where there is none.
    """
    refined = None if located.fix.ambiguous else _refined(located, stars)
    if refined is None and not stars:
        raise NotLocated("the image shows no light of the sky that stops at the skyline: expose longer?")
    return refined or located


def _refined(measured: Located, stars: bool) -> Located | None:
    fix = measured.fix
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
    else:
        return None
    moved = position - fix.position_enu_m[:2]
    if fit.chi2 > MOST_CHI2 or moved @ np.linalg.solve(prior_m2, moved) > MOST_STARS_CHI2:
        return None
    by_terrain = fit.raised_px(of_terrain=True)
    rows = sky.evidence(fit.used, by_terrain + fit.raised_px(of_terrain=False), max(fit.chi2, 1.0))
    if stars:
        scale = float(np.median(pixels.px_per_rad))
        rows = Evidence.concatenate(_stars_near(measured, horizon, scale, by_terrain / sky.px_per_rad), rows)
    by_shared = fit.step_by_shared
    smear = by_shared @ fit.shared_covariance @ by_shared.T
    error_rad = float(fit.shared[5]) if terrain.common_sigma_rad > 0.0 else 0.0
    refined = refine_fix(rows, fix, terrain, position, fit.step_covariance, smear, error_rad)
    return replace(measured, fix=refined, sky_light=sky, skyline_fit=fit, by_stars=stars)


def _fit_step(measured: Measured, sky: SkyLight, position_m: Array, fix: Fix) -> SkylineFit | None:
    """The step from a position (2,) that explains the skyline which the sky shows there."""
    terrain = measured.terrain
    used = sectors_with_step(sky) & terrain.is_informative(MIDDLES_RAD, sky.elevation_rad)
    if not used.any():
        return None
    map_sigma_px = terrain.horizon_sigma_rad(position_m[None], MIDDLES_RAD) * sky.px_per_rad
    variance = np.where(used, sky.variance_px2 + np.square(map_sigma_px), np.inf)
    slopes = horizon_slopes(terrain, position_m, MIDDLES_RAD) * sky.px_per_rad[:, None]
    shared = _shared_errors(measured, sky, position_m, fix)
    return fit_skyline(sky.shift_px, variance, slopes, shared, fix.position_enu_m[:2] - position_m, fix.covariance_m2)


def _shared_errors(measured: Measured, sky: SkyLight, position_m: Array, fix: Fix) -> SharedErrors:
    """Errors of the image (attitude, lens, edge model) and of the terrain (its common error and its shape)."""
    terrain, horizon = measured.terrain, sky.horizon
    offsets = _star_offsets(measured, horizon)
    columns, means, variances = [offset_terms(MIDDLES_RAD)], list(offsets.mean_px), []
    if terrain.common_sigma_rad > 0.0:
        columns.append(sky.px_per_rad[:, None])
        means.append(fix.horizon_error_rad)
        variances.append(terrain.common_sigma_rad**2)
    here = terrain.horizon_rad(position_m[None], MIDDLES_RAD)
    for k, sigma in enumerate(terrain.shape_sigma):
        if sigma > 0.0:
            changed = terrain.reshaped(SHAPE_STEP * np.eye(2)[k])
            change = (changed.horizon_rad(position_m[None], MIDDLES_RAD) - here) / SHAPE_STEP
            columns.append((change * sky.px_per_rad)[:, None])
            means.append(0.0)
            variances.append(sigma**2)
    covariance = np.zeros((len(means),) * 2)
    covariance[:5, :5] = offsets.covariance_px2
    covariance[0, 0] += EDGE_SIGMA_PX**2
    covariance[5:, 5:] = np.diag(variances)
    return SharedErrors(np.concatenate(columns, axis=1), np.array(means), covariance, np.arange(len(means)) >= 5)


def _star_offsets(measured: Measured, horizon: Horizon) -> StarOffsets:
    """Offset of the image at the skyline, by attitude, lens and the identified stars near it."""
    found, fit, camera = measured.identification, measured.attitude_fit, measured.camera
    rays_cam = measured.stars.rays_icrs[found.star[fit.used]] @ fit.attitude.R_cam_icrs.T
    centroids = measured.detections.covariance_px2[found.detection[fit.used]]
    variance = 0.5 * np.trace(centroids, axis1=1, axis2=2) + fit.extra_sigma_px**2
    return measure_star_offsets(
        camera, measured.R_cam_enu, fit.centroid_covariance_rad2, horizon, rays_cam, fit.residual_px[fit.used], variance
    )


def _stars_near(measured: Measured, horizon: Skyline, px_per_rad: float, raised_rad: Array) -> Evidence:
    """The rows of the stars that a small step of the position may hide or show, above the map's horizon.

    `raised_rad` (SECTORS,): how much higher the true horizon stands than the map's.
    """
    rows = measured.evidence()
    above = rows.elevation_rad - horizon(rows.azimuth_rad)
    near = rows.take(np.abs(above) < NEAR_PX / px_per_rad)
    return replace(near, elevation_rad=near.elevation_rad - raised_rad[sector_of(near.azimuth_rad)])
