"""The fix by the stars, refined by the light of the sky that stops at the skyline near it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from startrack.evidence import Skyline
from startrack.evidence.sky_checks import MIN_SECTORS, sectors_with_step
from startrack.evidence.sky_levels import SECTORS, sector_of
from startrack.evidence.sky_light import MIDDLES_RAD, SkyLight, measure_sky_light, sum_cells
from startrack.evidence.sky_pixels import pixels_near_skyline
from startrack.evidence.sky_step import Horizon
from startrack.evidence.star_offsets import OFFSET_TERMS, StarOffsets, measure_star_offsets, offset_terms
from startrack.localization.refinement import horizon_slopes, refine_fix
from startrack.localization.skyline_fit import SharedErrors, SkylineFit, fit_skyline
from startrack.stages import Located, Measured
from startrack.types import Array, Bools, Evidence, Fix, NotLocated

ROUNDS = 8  # of predicted skylines
SETTLED_PX = 0.3  # a skyline that moves by less need not be predicted anew
SAME_PIXELS_PX = 1.5  # after larger steps the pixels are chosen anew: the levels begin 4 px from the skyline
WIDE = 100.0  # times the stars' error: the sky's light alone
NEAR_PX = 20.0  # stars farther from the skyline do not depend on the position here
EDGE_SIGMA_PX = 0.02  # of the whole skyline, from the models of the PSF and of both levels; see benchmarks
SHAPE_STEP = 1e-4  # relative, at which the horizon's change with the terrain's shape is taken
MOST_CHI2 = 3.0  # of a sector: the skyline is another
MOST_STARS_CHI2 = 22.0  # of the step against the fix by the stars: one in 60,000


class NoSkyLight(Exception):
    """The light of the sky cannot refine the fix; the message has the reason."""


def refine_by_sky_light(located: Located, stars: bool = True) -> Located:
    """`located` with its fix by the stars refined; as it was, with the reason, where the sky's light cannot refine it.

    With `stars` their rows stay in the posterior, otherwise the sky's light alone determines it: then raises NotLocated
    (insufficient_geometry) where it cannot.
    """
    try:
        return _refine(located, stars)
    except (NoSkyLight, NotLocated) as cause:
        if not stars:
            raise NotLocated(f"the light of the sky gives no position: {cause}") from cause
        return replace(located, sky_unused=str(cause))


def _refine(located: Located, stars: bool) -> Located:
    """`located` refined. Raises NoSkyLight, and NotLocated as `refine_fix` does."""
    fix, terrain = located.fix, located.terrain
    if fix.ambiguous:
        raise NoSkyLight("several positions fit the stars")
    if fix.search == "approximate":
        raise NoSkyLight("the method of localization has no posterior")
    if not np.isfinite(fix.covariance_m2).all() or np.linalg.eigvalsh(fix.covariance_m2)[0] <= 0.0:
        raise NoSkyLight("the fix by the stars states no error")
    position, sky, fit = _settle(located, fix)
    excess = fit.excess
    if not stars:  # the errors that all rows share, without the stars' position
        fix = replace(fix, covariance_m2=WIDE**2 * fix.covariance_m2)
    if excess > 1.0 or not stars:
        fit = _fit_step(located, sky, position, fix, excess)
    by_terrain = fit.raised_px(of_terrain=True)
    rows = sky.evidence(fit.used, by_terrain + fit.raised_px(of_terrain=False), excess)
    if stars:
        near = _stars_near(located, Skyline.trace(position, terrain), sky, by_terrain / sky.px_per_rad)
        rows = Evidence.concatenate(near, rows)
    by_shared = fit.step_by_shared
    smear = by_shared @ fit.shared_covariance @ by_shared.T
    error_rad = float(fit.shared[OFFSET_TERMS]) if terrain.common_sigma_rad > 0.0 else 0.0
    refined = refine_fix(rows, fix, terrain, position, fit.step_covariance, smear, error_rad)
    moved = refined.position_enu_m[:2] - located.fix.position_enu_m[:2]
    if moved @ np.linalg.solve(located.fix.covariance_m2 + refined.covariance_m2, moved) > MOST_STARS_CHI2:
        raise NoSkyLight("the stars contradict it")
    if not stars:
        refined = replace(refined, search="beam", dropped_probability=1.0)
    return replace(located, fix=refined, sky_light=sky, skyline_fit=fit, by_stars=stars)


def _settle(located: Located, fix: Fix) -> tuple[Array, SkyLight, SkylineFit]:
    """Position (2,) whose predicted skyline is that of the sky's light, the light there, and its fit."""
    terrain, position, moved_px = located.terrain, fix.position_enu_m[:2], np.inf
    for _ in range(ROUNDS):
        horizon = Skyline.trace(position, terrain)
        if moved_px > SAME_PIXELS_PX:
            pixels = pixels_near_skyline(
                located.detections, located.camera, located.R_cam_enu, horizon, located.light
            )  # fmt: skip
            if not len(pixels.light_e):
                raise NoSkyLight("the skyline is not in view")
            sky, moved_px = measure_sky_light(pixels, horizon), 0.0
        else:
            sky = sum_cells(pixels.above(horizon), sky.levels, horizon)
        fit = _fit_step(located, sky, position, fix)
        step_px = float(np.abs(fit.px_per_m @ fit.step_m).max())
        position, moved_px = position + fit.step_m, moved_px + step_px
        if not np.asarray(terrain.allowed(position[None]))[0]:
            raise NoSkyLight("it points to where no camera can stand")
        if step_px < SETTLED_PX:
            break
    else:
        raise NoSkyLight("it points to no single position")
    if fit.chi2 > MOST_CHI2:
        raise NoSkyLight("it shows another skyline")
    return position, sky, fit


def _fit_step(
    located: Located, sky: SkyLight, position_m: Array, fix: Fix, variance_factor: float = 1.0
) -> SkylineFit:  # fmt: skip
    """The step from a position (2,) that explains the skyline which the sky shows there. Raises NoSkyLight."""
    terrain = located.terrain
    used = sectors_with_step(sky) & terrain.is_informative(MIDDLES_RAD, sky.elevation_rad)
    if np.count_nonzero(used) < MIN_SECTORS:
        raise NoSkyLight(_too_few(sky, used))
    map_sigma_px = terrain.horizon_sigma_rad(position_m[None], MIDDLES_RAD) * sky.px_per_rad
    variance = np.where(used, variance_factor * sky.variance_px2 + np.square(map_sigma_px), np.inf)
    slopes = horizon_slopes(terrain, position_m, MIDDLES_RAD) * sky.px_per_rad[:, None]
    shared = _shared_errors(located, sky, position_m, fix)
    expected_m = fix.position_enu_m[:2] - position_m
    fit = fit_skyline(sky.shift_px, variance, slopes, shared, expected_m, fix.covariance_m2)
    if fit is None:
        raise NoSkyLight("too much of it contradicts the predicted skyline")
    return fit


def _too_few(sky: SkyLight, used: Bools) -> str:
    """Why too few sectors (SECTORS,) are `used`: the skyline is not in view, has no step, or is not in the map."""
    in_view, on_map, needed = (n * 360.0 / SECTORS for n in (sky.levels.covered.sum(), used.sum(), MIN_SECTORS))
    if in_view < needed:
        return f"the image shows sky and ground beside {in_view:.0f}° of the skyline, and {needed:.0f}° are needed"
    if not on_map:
        return f"no step of light is clear over {needed:.0f}° of the skyline"
    return f"the terrain gives {on_map:.0f}° of the skyline that has a step of light, and {needed:.0f}° are needed"


def _shared_errors(measured: Measured, sky: SkyLight, position_m: Array, fix: Fix) -> SharedErrors:
    """Errors of the image (attitude, lens, edge model) and of the terrain (its common error and its shape)."""
    terrain, horizon = measured.terrain, sky.horizon
    offsets = _star_offsets(measured, horizon)
    columns, means, variances = [offset_terms(MIDDLES_RAD)], list(offsets.mean_px), []
    if terrain.common_sigma_rad > 0.0:
        columns.append(sky.px_per_rad[:, None])
        means.append(fix.horizon_error_rad)
        variances.append(terrain.common_sigma_rad**2)
    for k, sigma in enumerate(terrain.shape_sigma):
        if sigma > 0.0:
            here, changed = (
                ground.horizon_rad(position_m[None], MIDDLES_RAD)
                for ground in (terrain, terrain.reshaped(SHAPE_STEP * np.eye(2)[k]))
            )
            change = (changed - here) / SHAPE_STEP
            columns.append((change * sky.px_per_rad)[:, None])
            means.append(0.0)
            variances.append(sigma**2)
    covariance = np.zeros((len(means),) * 2)
    covariance[:OFFSET_TERMS, :OFFSET_TERMS] = offsets.covariance_px2
    covariance[0, 0] += EDGE_SIGMA_PX**2
    covariance[OFFSET_TERMS:, OFFSET_TERMS:] = np.diag(variances)
    of_terrain = np.arange(len(means)) >= OFFSET_TERMS
    return SharedErrors(np.concatenate(columns, axis=1), np.array(means), covariance, of_terrain)


def _star_offsets(measured: Measured, horizon: Horizon) -> StarOffsets:
    """Offset of the image at the skyline, by attitude, lens and the identified stars near it."""
    found, fit, camera = measured.identification, measured.attitude_fit, measured.camera
    rays_cam = measured.stars.rays_icrs[found.star[fit.used]] @ fit.attitude.R_cam_icrs.T
    centroids = measured.detections.covariance_px2[found.detection[fit.used]]
    variance = 0.5 * np.trace(centroids, axis1=1, axis2=2) + fit.extra_sigma_px**2
    return measure_star_offsets(
        camera, measured.R_cam_enu, fit.centroid_covariance_rad2, horizon, rays_cam, fit.residual_px[fit.used], variance
    )


def _stars_near(measured: Measured, horizon: Skyline, sky: SkyLight, raised_rad: Array) -> Evidence:
    """The rows of the stars that a small step of the position may hide or show, above the map's horizon.

    `raised_rad` (SECTORS,): how much higher the true horizon stands than the map's.
    """
    rows = measured.evidence()
    above = rows.elevation_rad - horizon(rows.azimuth_rad)
    near = rows.take(np.abs(above) < NEAR_PX / float(np.median(sky.px_per_rad)))
    return replace(near, elevation_rad=near.elevation_rad - raised_rad[sector_of(near.azimuth_rad)])
