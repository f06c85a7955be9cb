"""Catalogue, camera, terrain and a true pose in; an exposure and the truth about it out."""

from startrack.render.compose import light_e, render, truth_of
from startrack.render.defects import draw_hot_pixels
from startrack.render.light import exposure_reaching
from startrack.render.nature import draw_field_stars, draw_v_errors, joined
from startrack.render.scene import HotPixels, Scene, Truth
from startrack.render.series import Series, sky_turn_rad
from startrack.render.write import truth_paths, write_truth

__all__ = [
    "HotPixels",
    "Scene",
    "Series",
    "Truth",
    "draw_field_stars",
    "draw_hot_pixels",
    "draw_v_errors",
    "exposure_reaching",
    "joined",
    "light_e",
    "render",
    "sky_turn_rad",
    "truth_of",
    "truth_paths",
    "write_truth",
]
