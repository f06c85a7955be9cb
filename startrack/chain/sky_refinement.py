"""The light of the sky that stops at the skyline of a fix, as evidence beside the stars; the skyline by both."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from startrack.chain.measurement import fix_position
from startrack.chain.stages import Located, Measured, SkyEvidence
from startrack.core.types import (
    MIDDLES_RAD,
    SECTORS,
    Array,
    Bools,
    Evidence,
    ImageErrors,
    MeasuredSkyline,
    NotLocated,
    sector_of,
)
from startrack.evidence import (
    CLIP_SHIFT_PX,
    NEEDED_SECTORS,
    SEEN_LLR,
    SkyLight,
    Skyline,
    average_shifts,
    measure_sky_light,
    measure_star_offsets,
    offset_terms,
    pixels_near_skyline,
    sectors_with_step,
)
from startrack.localization import Localizer

EDGE_SIGMA_PX = 0.02  # of the whole skyline, from the models of the PSF and of both levels; see benchmarks
MOVED_PX = CLIP_SHIFT_PX  # of the skyline, after which the pixels are chosen anew: the levels begin 4 px from it
SKY_ROUNDS = 4
WINDOW_RAD, WINDOW_STEP_RAD = np.radians(3.0), np.radians(0.01)  # about the terrain's skyline, which gives the shape
SHIFTS_RAD = np.arange(-WINDOW_RAD, WINDOW_RAD + WINDOW_STEP_RAD, WINDOW_STEP_RAD)
MOST_SIGMA_RAD = WINDOW_RAD / 3  # a skyline that is known no better counts as unknown
END_DENSITY = 0.05  # at either end of the window, beside the mean density
SIMILAR_SIGMAS = 3.0  # sigma by the stars, in that by the sky's light, up to which both count as sources


class NoSkyLight(Exception):
    """The light of the sky is no evidence; the message has the reason."""


def refine_by_sky_light(located: Located, localizer: Localizer, stars: bool = True) -> Located:
    """`located` with the position by its stars and the light of the sky; as it was, with the reason, without that.

    With `stars` their rows are in the posterior too, otherwise the sky's light alone determines the position: then
    raises NotLocated (insufficient_geometry) where there is none. Raises NotLocated as the `localizer` does.
    """
    try:
        _require_refinable(located)
        for _ in range(SKY_ROUNDS):
            before = located
            sky = _measure_sky(located)
            rows = sky.light.evidence(sky.used)
            parts = (located.evidence(), rows) if stars else (rows,)
            evidence = replace(
                Evidence.concatenate(*parts), image_errors=sky.errors, support=located.fix.samples, clock=located.clock,
                near=located.near,
            )  # fmt: skip
            located, fix = fix_position(located, localizer, evidence)
            located = replace(located, fix=fix, sky=sky, by_stars=stars)
            moved_rad = predicted_skyline(located)(MIDDLES_RAD) - predicted_skyline(before)(MIDDLES_RAD)
            if np.quantile(np.abs(moved_rad) * sky.light.px_per_rad, 0.9) < MOVED_PX:
                return located
        raise NoSkyLight("it points to no single position")
    except NoSkyLight as cause:
        if not stars:
            raise NotLocated(f"the light of the sky gives no position: {cause}") from cause
        return replace(located, sky_unused=str(cause), sky=None)


def predicted_skyline(located: Located) -> Skyline:
    """The skyline of the map at a fix, with the errors of the map that it shows."""
    horizon = Skyline.trace(located.position_at_time_m, located.terrain)
    raised = located.fix.raised_rad
    return horizon if raised is None else horizon.raised(raised)


def _require_refinable(located: Located) -> None:
    """Raises NoSkyLight for a fix that is no single position with its error, and for levels that are damaged."""
    if located.damage is not None and not located.damage.has_levels:
        raise NoSkyLight("the image is damaged")
    if located.fix.ambiguous:
        raise NoSkyLight("several positions fit the stars")
    if located.fix.search == "approximate":
        raise NoSkyLight("the method of localization has no posterior")


def _measure_sky(located: Located) -> SkyEvidence:
    """The light of the sky at the predicted skyline, the sectors where it counts, and errors of the image."""
    horizon = predicted_skyline(located)
    pixels = pixels_near_skyline(located.detections, located.camera, located.R_cam_enu, horizon, located.light)
    if not len(pixels.light_e):
        raise NoSkyLight("the skyline is not in view")
    sky = measure_sky_light(pixels, horizon)
    used = sectors_with_step(sky) & located.terrain.is_informative(MIDDLES_RAD, sky.elevation_rad)
    if np.count_nonzero(used) < NEEDED_SECTORS:
        raise NoSkyLight(_too_few_text(sky, used))
    return SkyEvidence(sky, used, _image_errors(located, sky, used))


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
        raised_rad=offset_terms(MIDDLES_RAD) / sky.px_per_rad[:, None], mean=offsets.mean_px, covariance=covariance,
        variance_rad2=np.where(used, sky.variance_px2 / np.square(sky.px_per_rad), np.inf),
    )  # fmt: skip


def _too_few_text(sky: SkyLight, used: Bools) -> str:
    """Why too few sectors (SECTORS,) are `used`: the skyline is not in view, has no step, or is not in the map."""
    in_view, on_map, needed = (n * 360.0 / SECTORS for n in (sky.levels.covered.sum(), used.sum(), NEEDED_SECTORS))
    if in_view < needed:
        return f"the image shows sky and ground beside {in_view:.0f}° of the skyline, and {needed:.0f}° are needed"
    if not on_map:
        return f"no step of light is clear over {needed:.0f}° of the skyline"
    return f"the terrain gives {on_map:.0f}° of the skyline that has a step of light, and {needed:.0f}° are needed"


def measured_skyline(located: Located) -> MeasuredSkyline | None:
    """The skyline of a `located` image at the middles of 240 sectors of azimuth, without the terrain's heights.

    The terrain serves for the shape of the skyline within each sector only: the elevation is that of the image. None
    where several positions fit, and of a method of localization that is not right to the error of the image.
    """
    if located.fix.ambiguous or located.fix.search == "approximate":
        return None
    horizon = Skyline.trace(located.position_at_time_m, located.terrain)
    elevation, sigma = _skyline_by_stars(located.evidence(), horizon)
    source = np.where(sigma < MOST_SIGMA_RAD, "stars", "").astype("<U9")
    if located.sky is not None:
        sky, used, errors = located.sky
        used = used if located.fix.blocked is None else used & ~located.fix.blocked.whole
        by_image = np.einsum("ni,ij,nj->n", errors.raised_rad, errors.covariance, errors.raised_rad)
        by_sky = sky.elevation_rad + sky.shift_px / sky.px_per_rad - errors.raised_rad @ errors.mean
        sky_sigma = np.sqrt(sky.variance_px2 / np.square(sky.px_per_rad) + by_image)
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
