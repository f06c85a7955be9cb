"""The skyline that one located image shows, by azimuth: from stars seen and missing, and from the light of the sky."""

from __future__ import annotations

import numpy as np

from startrack.chain.sky_refinement import raised_by_image
from startrack.chain.stages import Located
from startrack.core.types import Array, Evidence, MeasuredSkyline
from startrack.evidence import Skyline
from startrack.evidence.sky_levels import SECTORS, sector_of
from startrack.evidence.sky_light import MIDDLES_RAD, SkyLight

REACH_RAD, STEP_RAD = np.radians(3.0), np.radians(0.01)  # of the skyline about the terrain's, which gives its shape
SHIFTS_RAD = np.arange(-REACH_RAD, REACH_RAD + STEP_RAD, STEP_RAD)
MOST_SIGMA_RAD = np.radians(1.0)  # a skyline that is known no better counts as unknown
MOST_NATS = 3.0  # of one star: a wrong one must not place the skyline alone
END_DENSITY = 0.05  # at either end of the window, beside the mean density
SIMILAR = 3.0  # sigma by the stars, in that by the sky's light, up to which both count as sources


def measured_skyline(located: Located) -> MeasuredSkyline | None:
    """The skyline of a `located` image at the middles of 240 sectors of azimuth, without the terrain's heights.

    The terrain serves for the shape of the skyline within each sector only: the elevation is that of the image. None
    where several positions fit, and of a method of localization that is not right to the error of the image.
    """
    if located.fix.ambiguous or located.fix.search == "approximate":
        return None
    horizon = Skyline.trace(located.position_at_time_m, located.terrain)
    elevation, sigma = _by_stars(located.evidence(), horizon)
    source = np.where(sigma < MOST_SIGMA_RAD, "stars", "").astype("<U9")
    if located.sky_light is not None and located.sky_used is not None:
        used = located.sky_used if located.blocked is None else located.sky_used & ~located.blocked.whole
        by_sky, sky_sigma = _by_sky_light(located, located.sky_light)
        both = used & (sigma < SIMILAR * sky_sigma)
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


def _by_stars(rows: Evidence, horizon: Skyline) -> tuple[Array, Array]:
    """Elevation and sigma (SECTORS,) of the skyline by stars seen and missing, every shift equally likely before."""
    above = rows.elevation_rad - horizon(rows.azimuth_rad)
    column = np.searchsorted(SHIFTS_RAD, above)  # the star is visible at the shifts below its height
    sums = np.zeros((SECTORS, len(SHIFTS_RAD) + 1))
    np.add.at(sums, (sector_of(rows.azimuth_rad), column), np.clip(rows.llr, -MOST_NATS, MOST_NATS))
    log = sums.sum(axis=1, keepdims=True) - np.cumsum(sums, axis=1)[:, :-1]
    weight = np.exp(log - log.max(axis=1, keepdims=True))
    weight /= weight.sum(axis=1, keepdims=True)
    mean = weight @ SHIFTS_RAD
    variance = weight @ np.square(SHIFTS_RAD) - np.square(mean)
    sigma = np.sqrt(np.maximum(variance, STEP_RAD**2 / 12))
    bounded = weight[:, [0, -1]].max(axis=1) * len(SHIFTS_RAD) < END_DENSITY  # stars on both sides of the skyline
    return horizon(MIDDLES_RAD) + mean, np.where(bounded, sigma, np.inf)


def _by_sky_light(located: Located, sky: SkyLight) -> tuple[Array, Array]:
    """Elevation and sigma (SECTORS,) of the skyline by the sky's light, offsets of the image taken out."""
    errors, variance = located.image_errors, sky.variance_px2 / np.square(sky.px_per_rad)
    if errors is not None:
        variance = variance + np.einsum("ni,ij,nj->n", errors.raised_rad, errors.covariance, errors.raised_rad)
    return sky.elevation_rad + sky.shift_px / sky.px_per_rad - raised_by_image(located), np.sqrt(variance)
