"""Both looks at an image: a rough position by the stars, what is at its skyline, and the position by all of that."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from startrack.chain.measurement import fix_again, fix_roughly, remeasure_stars
from startrack.chain.stages import FirstLook, Located, Measured, SecondLook, Settings, SkyEvidence
from startrack.core.statistics import relative_weights
from startrack.core.types import (
    MIDDLES_RAD,
    SECTORS,
    Array,
    Bools,
    Evidence,
    Fix,
    ImageErrors,
    MeasuredSkyline,
    NotLocated,
    sector_of,
)
from startrack.evidence import (
    NEEDED_SECTORS,
    SEEN_LLR,
    SkyLight,
    Skyline,
    SkylineEstimate,
    StarPhotometer,
    average_shifts,
    brightness_mag_arcsec2,
    check_single_skyline,
    exceeds_noise,
    measure_sky_light,
    measure_star_offsets,
    offset_terms,
    pixels_near_skyline,
    sectors_with_step,
)
from startrack.localization import Localizer, moments
from startrack.terrain import Terrain

WINDOW_RAD, WINDOW_STEP_RAD = np.radians(3.0), np.radians(0.01)  # about the terrain's skyline, which gives the shape
SHIFTS_RAD = np.arange(-WINDOW_RAD, WINDOW_RAD + WINDOW_STEP_RAD, WINDOW_STEP_RAD)
MOST_SIGMA_RAD = WINDOW_RAD / 3  # a skyline that is known no better counts as unknown
END_DENSITY = 0.05  # at either end of the window, beside the mean density
SIMILAR_SIGMAS = 3.0  # sigma by the stars, in that by the sky's light, up to which both count as sources
EDGE_SIGMA_PX = 0.02  # of the whole skyline, from the models of the PSF and of both levels; see docs/method.md
MOST_MOVED = 3.0  # of nine tenths of the skyline by the second fix, in its reach; in 30 rendered frames 0.3 at most


def look_first(measured: Measured, localizer: Localizer) -> FirstLook:
    """First look: roughly the position by the stars, and the other positions that they allow.

    Raises NotLocated as the `localizer` does.
    """
    turned, fix = fix_roughly(measured, localizer)
    return FirstLook(measured=turned, fix=fix)


def look_at_skyline(first: FirstLook, settings: Settings) -> SecondLook:
    """Second look: the light of the sky at the skyline of the `first` one, and the stars beside it without its step.

    The stars are measured anew wherever that light is above the noise, even if too few sectors show a clear step for it
    to count itself; `why_no_sky` has the reason. Where nothing but the light of the sky counts by the `settings`, that
    raises NotLocated (insufficient_geometry).
    """
    if unseen := why_unseen(first):
        second = SecondLook(first=first, measured=first.measured, why_no_sky=unseen)
    else:
        second = _measure_skyline(first, settings.photometer)
    if settings.evidence_sources == "stars":
        return replace(second, sky=None, why_no_sky="")
    if settings.evidence_sources == "sky":
        if second.sky is None:
            raise NotLocated(f"the light of the sky gives no position: {second.why_no_sky}")
        return replace(second, by_stars=False)
    return second


def why_unseen(first: FirstLook) -> str:
    """Reason why nothing can be measured at the skyline of a `first` look; "" where it can."""
    damage = first.measured.damage
    if damage is not None and not damage.has_levels:
        return "the image is damaged"
    if first.fix.ambiguous:
        return "several positions fit the stars"
    return "the method of localization has no posterior" if first.fix.is_approximate else ""


def _measure_skyline(first: FirstLook, photometer: StarPhotometer) -> SecondLook:
    """Light of the sky and stars beside the skyline of the `first` look, one position, in an image with levels."""
    known, estimate = first.measured, estimate_skyline(first)
    band = pixels_near_skyline(known.detections, known.camera, known.R_cam_enu, estimate)
    light = measure_sky_light(band.without_stars(known.photometry), estimate.skyline)
    measured = remeasure_stars(first, band, light, photometer) if exceeds_noise(light) else known
    used = sectors_with_step(light) & known.terrain.is_informative(MIDDLES_RAD, light.elevation_rad)
    why_no_sky = _too_few_text(light, used) if np.count_nonzero(used) < NEEDED_SECTORS else ""
    sky = None if why_no_sky else SkyEvidence(light, used, _image_errors(known, light, used))
    turn_rad = (known.exposure.exposure_s or 0.0) * known.clock.turn_rad_s
    moving = measured.photometry.moving(estimate.star_motion_rad(turn_rad))
    brightness = brightness_mag_arcsec2(light, known.camera, known.R_cam_enu, known.exposure.exposure_s)
    return SecondLook(
        first=first, measured=replace(measured, photometry=moving), sky=sky, why_no_sky=why_no_sky,
        sky_brightness_mag_arcsec2=brightness,
    )  # fmt: skip


def estimate_skyline(first: FirstLook) -> SkylineEstimate:
    """The skyline as it stands by the one position of a `first` look, and how well it is known."""
    fix, covariance = first.fix, first.fix.covariance_m2
    if fix.support is not None:  # points before the turn on an arc, by an error of the clock, in a round crater
        _, covariance = moments(fix.support.centres_m, relative_weights(fix.support.log_weight))
    return SkylineEstimate.of(fix.compared_at_m, covariance, first.measured.terrain, fix.raised_rad)


def fix_by_all(second: SecondLook, localizer: Localizer) -> Located:
    """Position by all that the `second` look shows, found from the points of the first one.

    Raises NotLocated as the `localizer` does, where two skylines explain the stars far better than one, and where the
    position contradicts the light that it is from.
    """
    known, rough = second.measured, second.first.fix
    if known.damage is None:  # damage changes the light of stars in part, as a second skyline does
        check_single_skyline(known.photometry, known.terrain, rough.compared_at_m)
    measured, fix = fix_again(known, rough, localizer, second.evidence())
    seen = None if second.sky is None else second.sky.at_skyline(fix)
    if seen is not None and not fix.ambiguous:
        _require_near(fix, measured.terrain, seen)
    return Located(
        **vars(measured), fix=fix, sky=second.sky, why_no_sky=second.why_no_sky, by_stars=second.by_stars,
        sky_brightness_mag_arcsec2=second.sky_brightness_mag_arcsec2, skyline=skyline_of_image(measured, fix, seen),
    )  # fmt: skip


def _require_near(fix: Fix, terrain: Terrain, sky: SkyEvidence) -> None:
    """Raise NotLocated (inconsistent_evidence) where the skyline of the fix is far from where the sky was measured."""
    skyline = terrain.horizon_rad(fix.compared_at_m[None], MIDDLES_RAD)
    if fix.raised_rad is not None:
        skyline = skyline + fix.raised_rad
    moved_px = np.abs(skyline - sky.light.elevation_rad) * sky.light.px_per_rad
    if np.quantile((moved_px / sky.light.reach_px)[sky.used], 0.9) > MOST_MOVED:
        raise NotLocated(
            f"the light of the sky moves the skyline by {np.quantile(moved_px[sky.used], 0.9):.0f} px from where the "
            "stars show it: wrong terrain, time or camera file, or light that is not the sky's?",
            reason="inconsistent_evidence",
        )


def _image_errors(measured: Measured, sky: SkyLight, used: Bools) -> ImageErrors:
    """Errors of attitude and lens at the skyline, by the identified stars near it."""
    found, fit = measured.identification, measured.attitude_fit
    rays_cam = measured.stars.rays_icrs[found.star[fit.used]] @ fit.attitude.R_cam_icrs.T
    centroids = measured.detections.covariance_px2[found.detection[fit.used]]
    offsets = measure_star_offsets(
        measured.camera, measured.R_cam_enu, fit.centroid_covariance_rad2, sky.horizon, rays_cam,
        fit.residual_px[fit.used], 0.5 * np.trace(centroids, axis1=1, axis2=2) + fit.extra_sigma_px**2,
    )  # fmt: skip
    covariance = offsets.covariance_px2.copy()
    covariance[0, 0] += EDGE_SIGMA_PX**2
    return ImageErrors(
        slopes_rad=offset_terms(MIDDLES_RAD) / sky.px_per_rad[:, None], mean=offsets.mean_px, covariance=covariance,
        variance_rad2=np.where(used, sky.variance_px2 / np.square(sky.px_per_rad), np.inf),
    )  # fmt: skip


def _too_few_text(sky: SkyLight, used: Bools) -> str:
    """Reason for too few `used` sectors (SECTORS,): the skyline is not in view, has no step, or is not in the map."""
    counts = sky.levels.covered.sum(), sectors_with_step(sky).sum(), used.sum(), NEEDED_SECTORS
    in_view, clear, on_map, needed = (n * 360.0 / SECTORS for n in counts)
    if in_view < needed:
        return f"the image shows sky and ground beside {in_view:.0f}° of the skyline, and {needed:.0f}° are needed"
    if not clear:
        return f"no step of light is clear over {needed:.0f}° of the skyline"
    return f"the terrain gives {on_map:.0f}° of the skyline that has a step of light, and {needed:.0f}° are needed"


def skyline_of_image(measured: Measured, fix: Fix, sky: SkyEvidence | None) -> MeasuredSkyline | None:
    """The skyline of a located image at the middles of 240 sectors of azimuth, without the terrain's heights.

    It is that by the stars of `measured` and by the light of the `sky`, None where that is not used. The terrain at the
    `fix` serves for the shape of the skyline within each sector only: the elevation is that of the image. None where
    several positions fit, and of a method of localization that is not right to the error of the image.
    """
    if fix.ambiguous or fix.is_approximate:
        return None
    horizon = Skyline.trace(fix.compared_at_m, measured.terrain)
    elevation, sigma = _skyline_by_stars(measured.evidence(), horizon)
    source = np.where(sigma < MOST_SIGMA_RAD, "stars", "").astype("<U9")
    if sky is not None:
        light, used, errors = sky
        used = used & np.isfinite(light.shift_sigma_px)
        used = used if fix.blocked is None else used & ~fix.blocked.likely
        by_image = np.einsum("ni,ij,nj->n", errors.slopes_rad, errors.covariance, errors.slopes_rad)
        by_sky = light.elevation_rad + light.shift_px / light.px_per_rad - errors.slopes_rad @ errors.mean
        sky_sigma = np.sqrt(light.variance_px2 / np.square(light.px_per_rad) + by_image)
        both = used & (sigma < SIMILAR_SIGMAS * sky_sigma)
        share = np.zeros(SECTORS)
        share[both] = 1.0 / (1.0 + np.square(sigma[both] / sky_sigma[both]))
        elevation[used] = (by_sky + share * (elevation - by_sky))[used]
        sigma[used] = (sky_sigma * np.sqrt(1.0 - share))[used]
        source = np.where(both, "both", np.where(used, "sky light", source))
    known = source != ""
    return MeasuredSkyline(
        azimuth_rad=MIDDLES_RAD,
        elevation_rad=np.where(known, elevation, np.nan),
        sigma_rad=np.where(known, sigma, np.inf),
        source=source,
    )


def _skyline_by_stars(rows: Evidence, horizon: Skyline) -> tuple[Array, Array]:
    """Elevation and sigma (SECTORS,) of the skyline by stars seen and missing, every shift equally likely before."""
    above = rows.elevation_rad - horizon(rows.azimuth_rad)
    column = np.searchsorted(SHIFTS_RAD, above)  # the star is visible at the shifts below its height
    sums = np.zeros((SECTORS, len(SHIFTS_RAD) + 1))
    np.add.at(sums, (sector_of(rows.azimuth_rad), column), np.clip(rows.llr, -SEEN_LLR, SEEN_LLR))
    log = sums.sum(axis=1, keepdims=True) - np.cumsum(sums, axis=1)[:, :-1]
    weight, mean, sigma = average_shifts(log, SHIFTS_RAD)
    bounded = weight[:, [0, -1]].max(axis=1) * len(SHIFTS_RAD) < END_DENSITY  # stars on both sides of the skyline
    return horizon(MIDDLES_RAD) + mean, np.where(bounded, sigma, np.inf)
