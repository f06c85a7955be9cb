"""An exposure and its truth from catalogue, camera, terrain and a true pose."""

from startrack.rendering.compose import draw_hot_pixels, light_e, read_out, render, truth_of, truth_paths, write_truth
from startrack.rendering.scene import HotPixels, Scene, Truth
from startrack.rendering.series import (
    FAINTEST_V_MAG,
    STEP_ROUNDING_1,
    Drive,
    Pose,
    Series,
    draw_odometry,
    load_sky_catalog,
    read_drive,
)
from startrack.rendering.sky import EDGE_WIDTH_SIGMAS, diffuse_at_e, sky_e_per_s, sky_gradient
from startrack.rendering.sources import (
    draw_field_stars,
    draw_v_errors,
    exposure_for_snr,
    flux_e,
    limiting_v_mag,
    splat,
)  # fmt: skip

__all__ = [
    "EDGE_WIDTH_SIGMAS", "FAINTEST_V_MAG", "STEP_ROUNDING_1", "Drive", "HotPixels", "Pose", "Scene", "Series", "Truth",
    "diffuse_at_e", "draw_field_stars", "draw_hot_pixels", "draw_odometry", "draw_v_errors", "exposure_for_snr",
    "flux_e", "light_e", "limiting_v_mag", "load_sky_catalog", "read_drive", "read_out", "render", "sky_e_per_s",
    "sky_gradient", "splat", "truth_of", "truth_paths", "write_truth",
]  # fmt: skip
