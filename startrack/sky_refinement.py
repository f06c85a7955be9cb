"""The fix by the stars, refined by the light of the sky that stops at the skyline near it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from startrack.crater_depth import OtherDepth
from startrack.evidence import Skyline
from startrack.evidence.sky_checks import MIN_SECTORS, sectors_with_step
from startrack.evidence.sky_levels import SECTORS, sector_of
from startrack.evidence.sky_light import MIDDLES_RAD, SkyLight, measure_sky_light, sum_cells
from startrack.evidence.sky_pixels import pixels_near_skyline
from startrack.evidence.star_offsets import OFFSET_TERMS
from startrack.localization import ExactPosterior
from startrack.localization.clock import WrongTime, clock_matters
from startrack.localization.clock_posterior import spread_on_arc
from startrack.localization.explored import Explored
from startrack.localization.integrity import assess_integrity
from startrack.localization.refinement import horizon_slopes, refine_fix
from startrack.localization.skyline_fit import SkylineFit, fit_skyline
from startrack.localization.summary import camera_at
from startrack.sky_errors import shared_errors
from startrack.stages import Located, Measured
from startrack.terrain import Cylinder
from startrack.types import Array, Bools, Clock, ClockError, Evidence, Fix, NotLocated

ROUNDS = 8  # of predicted skylines
SETTLED_PX = 0.3  # a skyline that moves by less need not be predicted anew
SAME_PIXELS_PX = 1.5  # after larger steps the pixels are chosen anew: the levels begin 4 px from the skyline
SAME_TIME_RAD = np.radians(0.02)  # of the sky's turn: after more they are, too
WIDE = 100.0  # times the stars' error: the sky's light alone
NEAR_PX = 20.0  # stars farther from the skyline do not depend on the position here
FREE_CLOCK_RAD = np.radians(6.0)  # standard deviation of the sky's turn where the clock is fitted freely
CLOCK_GAIN_NATS = 8.0  # of a free clock over the stated one: four sigma
CLOCK_FLOOR_RAD = np.radians(0.02)  # of the turn: what a map's errors can feign
MOST_CHI2 = 3.0  # of a sector: the skyline is another
MOST_STARS_CHI2 = 22.0  # of the step against the fix by the stars: one in 60,000


FREE_STEEPNESS = 0.02  # relative standard deviation of a crater's depth where it is fitted freely
MOST_STEEPER = 0.01  # beyond this the crater is another one
SHAPE_SIGMAS = 3.0  # of a free depth over the stated one; of 0.3 % wrong depths in the thesis's crater 7 of 9 show more


class NoSkyLight(Exception):
    """The light of the sky cannot refine the fix; the message has the reason."""


def refine_by_sky_light(located: Located, stars: bool = True, depth_is_right: bool = False) -> Located:
    """`located` with its fix by the stars refined; as it was, with the reason, where the sky's light cannot refine it.

    With `stars` their rows stay in the posterior, otherwise the sky's light alone determines it: then raises NotLocated
    (insufficient_geometry) where it cannot. Raises NotLocated (inconsistent_evidence) where the light of the sky shows
    another time than the one stated, and, unless `depth_is_right`, OtherDepth where it shows a crater of another depth.
    """
    try:
        if located.damage is not None and not located.damage.has_levels:
            raise NoSkyLight("the image is damaged")
        _require_refinable(located.fix)
        if not located.terrain.axisymmetric:
            _check_clock(located)
        return _refine(located, stars, depth_is_right)
    except WrongTime:
        raise
    except (NoSkyLight, NotLocated) as cause:
        if not stars:
            raise NotLocated(f"the light of the sky gives no position: {cause}") from cause
        return replace(located, sky_unused=str(cause))


def _require_refinable(fix: Fix) -> None:
    """Raises NoSkyLight for a `fix` that is no single position with its error."""
    if fix.ambiguous:
        raise NoSkyLight("several positions fit the stars")
    if fix.search == "approximate":
        raise NoSkyLight("the method of localization has no posterior")
    if not np.isfinite(fix.covariance_m2).all() or np.linalg.eigvalsh(fix.covariance_m2)[0] <= 0.0:
        raise NoSkyLight("the fix by the stars states no error")


def _check_clock(located: Located) -> None:
    """Raises WrongTime where the sky's light shows a time that the stated one, with its error, excludes."""
    clock = located.clock
    turn = float(np.linalg.norm(clock.turn_rad_s))
    try:
        fix = _widened(located.fix)  # the stars' position depends on the time
        _, _, fit, there = _settle(located, fix, FREE_CLOCK_RAD / turn)
    except NoSkyLight:
        return
    shown = _clock_error(there.clock, fit)
    variance = clock.sigma_s**2 + fit.excess * shown.sigma_s**2 + (CLOCK_FLOOR_RAD / turn) ** 2
    if shown.offset_s**2 > 2 * CLOCK_GAIN_NATS * variance:
        raise WrongTime(replace(shown, sigma_s=shown.sigma_s * fit.excess**0.5), clock.sigma_s, "the light of the sky")


def check_depth(located: Located, there: tuple[Array, SkyLight] | None = None) -> None:
    """Raises OtherDepth where the sky's light shows a cylinder's depth that the stated one, with its error, excludes.

    `there`: position (2,) and light of the skyline by the stated depth; None where that fails, or is not known.
    """
    terrain, fix = located.terrain, located.fix_at_time
    if not isinstance(terrain, Cylinder):
        return
    free = replace(located, terrain=replace(terrain, depth_sigma_m=FREE_STEEPNESS * terrain.depth_m))
    try:
        _require_refinable(fix)
        fix = _widened(fix)  # the stars' position depends on the depth
        position, sky = _settle(free, fix, None)[:2] if there is None else there
        fit = _fit_step(free, sky, position, fix, None)
    except NoSkyLight:
        return
    steeper, variance = float(fit.shared[OFFSET_TERMS]), fit.shared_covariance[OFFSET_TERMS, OFFSET_TERMS]
    least = SHAPE_SIGMAS * np.hypot(np.sqrt(fit.excess * variance), terrain.shape_sigma[0])
    if least < abs(steeper) < MOST_STEEPER:
        raise OtherDepth(terrain, steeper)


def _refine(located: Located, stars: bool, depth_is_right: bool) -> Located:
    """`located` refined. Raises NoSkyLight, and NotLocated as `refine_fix` does."""
    terrain, by_arc = located.terrain, located.terrain.axisymmetric
    fix = located.fix_at_time if by_arc else located.fix
    clock_sigma_s = located.clock.sigma_s if clock_matters(located.clock, terrain) and not by_arc else None
    try:
        position, sky, fit, there = _settle(located, fix, clock_sigma_s)
    except NoSkyLight:
        if not depth_is_right:
            check_depth(located)
        raise
    if not depth_is_right:
        check_depth(there, (position, sky))
    excess = fit.excess
    if not stars:  # the errors that all rows share, without the stars' position
        fix = _widened(fix)
    if excess > 1.0 or not stars:
        fit = _fit_step(there, sky, position, fix, clock_sigma_s, excess)
    by_terrain = fit.raised_px(of_terrain=True)
    rows = sky.evidence(fit.used, by_terrain + fit.raised_px(of_terrain=False), excess)
    if stars:
        rows = Evidence.concatenate(_stars_near(there, sky, by_terrain / sky.px_per_rad), rows)
    rows = replace(rows, near=located.near)
    by_shared = fit.step_by_shared
    smear = by_shared @ fit.shared_covariance @ by_shared.T
    error_rad = float(fit.shared[OFFSET_TERMS]) if terrain.common_sigma_rad > 0.0 else 0.0
    refined = refine_fix(rows, fix, terrain, position, fit.step_covariance, smear, error_rad, _over_arc(located))
    moved = refined.position_enu_m[:2] - located.fix.position_enu_m[:2]
    if moved @ np.linalg.solve(located.fix.covariance_m2 + refined.covariance_m2, moved) > MOST_STARS_CHI2:
        raise NoSkyLight("the stars contradict it")
    middle, by_rows = refined.position_enu_m[:2], refined.covariance_m2 - smear
    if refined.clock is not None or np.linalg.eigvalsh(by_rows)[0] <= 0.0:  # spread over an arc, or all smear
        middle, by_rows = position, fit.step_covariance
    integrity = assess_integrity(rows, middle, by_rows, refined, terrain)
    refined = replace(refined, clock=refined.clock or _clock_error(there.clock, fit))
    if not stars:
        refined = replace(refined, search="beam", dropped_probability=1.0)
    at_time = replace(there.fix_at_time, position_enu_m=camera_at(position, terrain)) if by_arc else there.fix_at_time
    return replace(
        there,
        fix=refined,
        fix_at_time=at_time,
        sky_light=sky,
        skyline_fit=fit,
        integrity=integrity,
        by_stars=stars,
        sky_variance_factor=excess,
    )


def _over_arc(located: Located) -> Callable[[Explored], Explored]:
    """A posterior at one time to the one over all times, in a round crater, where nothing shows the time."""
    if not located.terrain.axisymmetric:
        return lambda found: found
    return lambda found: spread_on_arc(found, ExactPosterior().explore, located.evidence(), located.terrain)


def _widened(fix: Fix) -> Fix:
    """The `fix` with an error so large that it no longer determines the position."""
    return replace(fix, covariance_m2=WIDE**2 * fix.covariance_m2)


def _clock_error(clock: Clock, fit: SkylineFit) -> ClockError:
    """Of the stated time, as the skyline shows it."""
    at = fit.errors.clock
    if at is None:
        return ClockError(clock.offset_s, clock.sigma_s)
    return ClockError(clock.offset_s + float(fit.shared[at]), float(np.sqrt(fit.shared_covariance[at, at])))


def _settle(located: Located, fix: Fix, clock_sigma_s: float | None) -> tuple[Array, SkyLight, SkylineFit, Located]:
    """Position (2,) whose predicted skyline is that of the sky's light, the light there, its fit, and the time."""
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
        fit = _fit_step(located, sky, position, fix, clock_sigma_s)
        step_px = float(np.abs(fit.px_per_m @ fit.step_m).max())
        position, moved_px = position + fit.step_m, moved_px + step_px
        if not np.asarray(terrain.allowed(position[None]))[0]:
            raise NoSkyLight("it points to where no camera can stand")
        later_s = 0.0 if fit.errors.clock is None else float(fit.shared[fit.errors.clock])
        turned = abs(later_s) * float(np.linalg.norm(located.clock.turn_rad_s)) > SAME_TIME_RAD
        if turned:
            located, moved_px = located.later(later_s, np.inf), np.inf
        elif step_px < SETTLED_PX:
            break
    else:
        raise NoSkyLight("it points to no single position")
    if fit.chi2 > MOST_CHI2:
        raise NoSkyLight("it shows another skyline")
    return position, sky, fit, located


def _fit_step(
    located: Located,
    sky: SkyLight,
    position_m: Array,
    fix: Fix,
    clock_sigma_s: float | None,
    variance_factor: float = 1.0,
) -> SkylineFit:
    """The step from a position (2,) that explains the skyline which the sky shows there. Raises NoSkyLight."""
    terrain = located.terrain
    used = sectors_with_step(sky) & terrain.is_informative(MIDDLES_RAD, sky.elevation_rad)
    if located.blocked is not None:
        used &= ~located.blocked.beside(MIDDLES_RAD)
    if np.count_nonzero(used) < MIN_SECTORS:
        raise NoSkyLight(_too_few(sky, used))
    map_sigma_px = terrain.horizon_sigma_rad(position_m[None], MIDDLES_RAD) * sky.px_per_rad
    variance = np.where(used, variance_factor * sky.variance_px2 + np.square(map_sigma_px), np.inf)
    slopes = horizon_slopes(terrain, position_m, MIDDLES_RAD) * sky.px_per_rad[:, None]
    clock = None if clock_sigma_s is None else replace(located.clock, sigma_s=clock_sigma_s)
    shared = shared_errors(located, sky, position_m, fix, clock)
    expected_m = fix.position_enu_m[:2] - position_m
    fit = fit_skyline(sky.shift_px, variance, slopes, shared, expected_m, fix.covariance_m2, min_sectors=MIN_SECTORS)
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


def _stars_near(measured: Measured, sky: SkyLight, raised_rad: Array) -> Evidence:
    """The rows of the stars that a small step of the position may hide or show, above the map's horizon.

    `raised_rad` (SECTORS,): how much higher the true horizon stands than the map's.
    """
    rows = measured.evidence()
    above = rows.elevation_rad - sky.horizon(rows.azimuth_rad)
    near = rows.take(np.abs(above) < NEAR_PX / float(np.median(sky.px_per_rad)))
    return replace(near, elevation_rad=near.elevation_rad - raised_rad[sector_of(near.azimuth_rad)])
