"""The skyline that an image itself shows, by the light of its sky and by its stars."""

from __future__ import annotations

import numpy as np

from startrack.chain.stages import Measured, SkyEvidence
from startrack.core.types import MIDDLES_RAD, SECTORS, Array, Evidence, Fix, MeasuredSkyline, sector_of
from startrack.evidence import SEEN_LLR, Skyline, average_shifts

WINDOW_RAD, WINDOW_STEP_RAD = np.radians(3.0), np.radians(0.01)  # about the terrain's skyline, which gives the shape
SHIFTS_RAD = np.arange(-WINDOW_RAD, WINDOW_RAD + WINDOW_STEP_RAD, WINDOW_STEP_RAD)
MOST_SIGMA_RAD = WINDOW_RAD / 3  # a skyline that is known no better counts as unknown
END_DENSITY = 0.05  # at either end of the window, beside the mean density
SIMILAR_SIGMAS = 3.0  # sigma by the stars, in that by the sky's light, up to which both count as sources


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
