"""Rays from exposure, attitude and catalogue, each with the log-likelihood ratio of sky against ground."""

from startrack.evidence.double_exposure import check_single_skyline
from startrack.evidence.expected_stars import expect_stars
from startrack.evidence.flux_scale import (
    SCALE_SNR,
    SCALE_STARS,
    FluxScale,
    expected_flux_scale,
    fit_flux_scale,
    flux_scale,
)
from startrack.evidence.obstacles import add_obstacles, mask_obstacles
from startrack.evidence.photometry import (
    SURE_SIGMAS,
    Photometry,
    Sources,
    half_width,
    measure,
    neighbour_profiles,
    order_by_cell,
    profiles_of,
)
from startrack.evidence.sky_levels import SkylineBand, SkyPixels, pixels_near_skyline
from startrack.evidence.sky_light import (
    NEEDED_SECTORS,
    SkyLight,
    average_shifts,
    brightness_mag_arcsec2,
    exceeds_noise,
    measure_sky_light,
    sectors_with_step,
    take_out_sky_step,
)
from startrack.evidence.skyline import (
    BAND_PX,
    SKYLINE_POINTS,
    SKYLINE_SIGMAS,
    Horizon,
    Skyline,
    SkylineEstimate,
    skyline_band,
)
from startrack.evidence.star_offsets import measure_star_offsets, offset_terms
from startrack.evidence.star_photometer import (
    DECIDABLE_SNR,
    SEEN_LLR,
    DamagedResponse,
    StarPhotometer,
    StarPhotometry,
    filtered_noise_e,
    measure_response,
    with_noise_of_blocks,
)

__all__ = [
    "BAND_PX", "DECIDABLE_SNR", "NEEDED_SECTORS", "SCALE_SNR", "SCALE_STARS", "SEEN_LLR", "SKYLINE_POINTS",
    "SKYLINE_SIGMAS", "SURE_SIGMAS", "DamagedResponse", "FluxScale", "Horizon", "Photometry", "SkyLight", "SkyPixels",
    "Skyline", "SkylineBand", "SkylineEstimate", "Sources", "StarPhotometer", "StarPhotometry", "add_obstacles",
    "average_shifts", "brightness_mag_arcsec2", "check_single_skyline", "exceeds_noise", "expect_stars",
    "expected_flux_scale", "filtered_noise_e", "fit_flux_scale", "flux_scale", "half_width", "mask_obstacles",
    "measure", "measure_response", "measure_sky_light", "measure_star_offsets", "neighbour_profiles", "offset_terms",
    "order_by_cell", "pixels_near_skyline", "profiles_of", "sectors_with_step", "skyline_band", "take_out_sky_step",
    "with_noise_of_blocks",
]  # fmt: skip
