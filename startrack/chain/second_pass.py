"""The second pass over an image: what it shows beside the skyline of a first fix, and the position by all of that."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from startrack.chain.measurement import fix_again, fix_position, remeasure_stars
from startrack.chain.stages import Located, Measured, Settings, SkyEvidence
from startrack.core.statistics import relative_weights
from startrack.core.types import MIDDLES_RAD, SECTORS, Bools, Evidence, ImageErrors, NotLocated
from startrack.evidence import (
    NEEDED_SECTORS,
    SkyLight,
    SkylineEstimate,
    brightness_mag_arcsec2,
    exceeds_noise,
    measure_sky_light,
    measure_star_offsets,
    offset_terms,
    pixels_near_skyline,
    sectors_with_step,
)
from startrack.localization import Localizer, moments

EDGE_SIGMA_PX = 0.02  # of the whole skyline, from the models of the PSF and of both levels; see docs/method.md
MOST_MOVED = 3.0  # of nine tenths of the skyline by the second fix, in its reach; in 30 rendered frames 0.3 at most


def fix_by_stars(measured: Measured, localizer: Localizer) -> Located:
    """First look: roughly the position by the stars, and the other positions that they allow.

    Raises NotLocated as the `localizer` does.
    """
    measured, fix = fix_position(measured, localizer, replace(measured.evidence(), is_first_look=True))
    return Located(**vars(measured), fix=fix)


def see_skyline(first: Located) -> SkylineEstimate | None:
    """Skyline as it stands by a `first` fix; None where nothing can be measured there, see `why_unseen`."""
    if why_unseen(first):
        return None
    fix, covariance = first.fix, first.fix.covariance_m2
    if fix.samples is not None:  # without the arc on which an error of the clock turns a position in a round crater
        _, covariance = moments(fix.samples.centres_m, relative_weights(fix.samples.log_likelihood))
    return SkylineEstimate.of(first.position_at_time_m, covariance, first.terrain, fix.raised_rad)


def why_unseen(first: Located) -> str:
    """Reason why nothing can be measured at the skyline of a `first` fix; "" where it can."""
    if first.damage is not None and not first.damage.has_levels:
        return "the image is damaged"
    if first.fix.ambiguous:
        return "several positions fit the stars"
    return "the method of localization has no posterior" if first.fix.search == "approximate" else ""


def measure_at(near: SkylineEstimate | None, first: Located, settings: Settings) -> Located:
    """Copy of `first` with the light of the sky at the skyline `near`, stars beside it without the step of that light.

    Without a skyline, or without such light, it is as it was, and `sky_unused` has the reason; where nothing but the
    light of the sky counts, raises NotLocated (insufficient_geometry).
    """
    sky, unused = None, why_unseen(first)
    if near is not None:
        band = pixels_near_skyline(first.detections, first.camera, first.R_cam_enu, near)
        light = measure_sky_light(band.without_stars(first.light), near.skyline)
        if exceeds_noise(light):
            first = remeasure_stars(first, band, light, settings.evidence)
        brightness = brightness_mag_arcsec2(light, first.camera, first.R_cam_enu, first.exposure.exposure_s)
        first = replace(first, sky_brightness_mag_arcsec2=brightness)
        used = sectors_with_step(light) & first.terrain.is_informative(MIDDLES_RAD, light.elevation_rad)
        unused = _too_few_text(light, used) if np.count_nonzero(used) < NEEDED_SECTORS else ""
        sky = None if unused else SkyEvidence(light, used, _image_errors(first, light, used))
    if settings.evidence_sources == "stars":
        return first
    if sky is None and settings.evidence_sources == "sky":
        raise NotLocated(f"the light of the sky gives no position: {unused}")
    return replace(first, sky=sky, sky_unused=unused, by_stars=sky is None or settings.evidence_sources == "both")


def fix_by_all(complete: Located, localizer: Localizer) -> Located:
    """Position by all that was measured, found from the points of the first look.

    Raises NotLocated as the `localizer` does.
    """
    rows, sky = complete.evidence(), complete.sky
    if sky is not None:
        light = replace(sky.light.evidence(sky.used), clock=rows.clock, near=rows.near)
        rows = replace(Evidence.concatenate(rows, light) if complete.by_stars else light, image_errors=sky.errors)
    located, fix = fix_again(complete, complete.fix, localizer, rows)
    located = replace(located, fix=fix)
    if sky is not None and fix.lit is not None:
        used = sky.used & ~fix.lit.whole
        sky = sky._replace(used=used) if used.any() else None
        text = f"at azimuths {fix.lit.text}, where its edge is not the skyline that the stars show: lit ground?"
        located = replace(located, sky=sky, sky_unused=text)
    if sky is not None and not fix.ambiguous:
        _require_near(located, sky)
    return located


def _require_near(located: Located, sky: SkyEvidence) -> None:
    """Raise NotLocated (inconsistent_evidence) where the skyline of the fix is far from where the sky was measured."""
    skyline = located.terrain.horizon_rad(located.position_at_time_m[None], MIDDLES_RAD)
    if located.fix.raised_rad is not None:
        skyline = skyline + located.fix.raised_rad
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
        raised_rad=offset_terms(MIDDLES_RAD) / sky.px_per_rad[:, None], mean=offsets.mean_px, covariance=covariance,
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
