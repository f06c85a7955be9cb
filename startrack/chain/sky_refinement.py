"""The light of the sky that stops at the skyline of a fix by the stars, as evidence beside them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from startrack.chain.stages import Located, Measured
from startrack.chain.star_fix import fix_position
from startrack.core.types import Array, Bools, Evidence, ImageErrors, NotLocated
from startrack.evidence import Skyline
from startrack.evidence.sky_checks import MIN_SECTORS, sectors_with_step
from startrack.evidence.sky_levels import SECTORS
from startrack.evidence.sky_light import MIDDLES_RAD, SkyLight, measure_sky_light
from startrack.evidence.sky_pixels import pixels_near_skyline
from startrack.evidence.sky_step import Horizon
from startrack.evidence.star_offsets import StarOffsets, measure_star_offsets, offset_terms
from startrack.localization import Localizer

EDGE_SIGMA_PX = 0.02  # of the whole skyline, from the models of the PSF and of both levels; see benchmarks
MOVED_PX = 1.0  # of the skyline, after which the pixels are chosen anew: the levels begin 4 px from it
ROUNDS = 4


class NoSkyLight(Exception):
    """The light of the sky is no evidence; the message has the reason."""


def refine_by_sky_light(located: Located, localizer: Localizer, stars: bool = True) -> Located:
    """`located` with the position by its stars and the light of the sky; as it was, with the reason, without that.

    With `stars` their rows are in the posterior too, otherwise the sky's light alone determines the position: then
    raises NotLocated (insufficient_geometry) where there is none. Raises NotLocated as the `localizer` does.
    """
    try:
        _require_refinable(located)
        for _ in range(ROUNDS):
            before = located
            sky, used, errors = _measure(located)
            rows = sky.evidence(used, np.zeros(SECTORS))
            parts = (located.evidence(), rows) if stars else (rows,)
            evidence = replace(
                Evidence.concatenate(*parts), image_errors=errors, support=located.fix.samples, clock=located.clock,
                near=located.near,
            )  # fmt: skip
            located = replace(
                fix_position(located, Located, localizer, evidence),
                sky_light=sky,
                sky_used=used,
                image_errors=errors,
                by_stars=stars,
            )
            if _moved_px(before, located, sky) < MOVED_PX:
                return located
        raise NoSkyLight("it points to no single position")
    except NoSkyLight as cause:
        if not stars:
            raise NotLocated(f"the light of the sky gives no position: {cause}") from cause
        return replace(located, sky_unused=str(cause), sky_light=None, sky_used=None, image_errors=None)


def predicted_skyline(located: Located) -> Horizon:
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


def _measure(located: Located) -> tuple[SkyLight, Bools, ImageErrors]:
    """The light of the sky at the predicted skyline, the sectors where it counts, and errors of the image."""
    horizon = predicted_skyline(located)
    pixels = pixels_near_skyline(located.detections, located.camera, located.R_cam_enu, horizon, located.light)
    if not len(pixels.light_e):
        raise NoSkyLight("the skyline is not in view")
    sky = measure_sky_light(pixels, horizon)
    used = sectors_with_step(sky) & located.terrain.is_informative(MIDDLES_RAD, sky.elevation_rad)
    if np.count_nonzero(used) < MIN_SECTORS:
        raise NoSkyLight(_too_few(sky, used))
    return sky, used, _image_errors(located, sky, used)


def _image_errors(measured: Measured, sky: SkyLight, used: Bools) -> ImageErrors:
    """Errors of attitude and lens at the skyline, by the identified stars near it."""
    offsets = _star_offsets(measured, sky.horizon)
    covariance = offsets.covariance_px2.copy()
    covariance[0, 0] += EDGE_SIGMA_PX**2
    return ImageErrors(
        raised_rad=offset_terms(MIDDLES_RAD) / sky.px_per_rad[:, None], mean=offsets.mean_px, covariance=covariance,
        variance_rad2=np.where(used, sky.variance_px2 / np.square(sky.px_per_rad), np.inf),
    )  # fmt: skip


def _star_offsets(measured: Measured, horizon: Horizon) -> StarOffsets:
    """Offset of the image at the skyline, by attitude, lens and the identified stars near it."""
    found, fit, camera = measured.identification, measured.attitude_fit, measured.camera
    rays_cam = measured.stars.rays_icrs[found.star[fit.used]] @ fit.attitude.R_cam_icrs.T
    centroids = measured.detections.covariance_px2[found.detection[fit.used]]
    variance = 0.5 * np.trace(centroids, axis1=1, axis2=2) + fit.extra_sigma_px**2
    return measure_star_offsets(
        camera, measured.R_cam_enu, fit.centroid_covariance_rad2, horizon, rays_cam, fit.residual_px[fit.used], variance
    )


def _moved_px(before: Located, after: Located, sky: SkyLight) -> float:
    """By how much the predicted skyline moves from one fix to the next, at most, where the sky's light is used."""
    moved = predicted_skyline(after)(MIDDLES_RAD) - predicted_skyline(before)(MIDDLES_RAD)
    return float(np.quantile(np.abs(moved) * sky.px_per_rad, 0.9))


def _too_few(sky: SkyLight, used: Bools) -> str:
    """Why too few sectors (SECTORS,) are `used`: the skyline is not in view, has no step, or is not in the map."""
    in_view, on_map, needed = (n * 360.0 / SECTORS for n in (sky.levels.covered.sum(), used.sum(), MIN_SECTORS))
    if in_view < needed:
        return f"the image shows sky and ground beside {in_view:.0f}° of the skyline, and {needed:.0f}° are needed"
    if not on_map:
        return f"no step of light is clear over {needed:.0f}° of the skyline"
    return f"the terrain gives {on_map:.0f}° of the skyline that has a step of light, and {needed:.0f}° are needed"


def raised_by_image(located: Located) -> Array:
    """How much (SECTORS,) the image shows the sky's light too high [rad], in the mean."""
    errors = located.image_errors
    return np.zeros(SECTORS) if errors is None else np.asarray(errors.raised_rad @ errors.mean)
