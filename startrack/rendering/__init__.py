"""An exposure and its truth from catalogue, camera, terrain and a true pose."""

from startrack.rendering.compose import light_e, render, truth_of
from startrack.rendering.defects import draw_hot_pixels
from startrack.rendering.drive import Drive, draw_odometry, read_drive
from startrack.rendering.field_stars import concatenate_stars, draw_field_stars, draw_v_errors
from startrack.rendering.scene import HotPixels, Scene, Truth
from startrack.rendering.series import Pose, Series, load_sky_catalog
from startrack.rendering.sources import exposure_for_snr, limiting_v_mag
from startrack.rendering.write import truth_paths, write_truth

__all__ = [
    "Drive",
    "HotPixels",
    "Pose",
    "Scene",
    "Series",
    "Truth",
    "concatenate_stars",
    "draw_field_stars",
    "draw_hot_pixels",
    "draw_odometry",
    "draw_v_errors",
    "exposure_for_snr",
    "light_e",
    "limiting_v_mag",
    "load_sky_catalog",
    "read_drive",
    "render",
    "truth_of",
    "truth_paths",
    "write_truth",
]
