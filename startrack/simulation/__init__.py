"""Measurements of a scene as the pipeline makes them, drawn without an image or with its pixels beside the skyline."""

from startrack.simulation.ground_errors import draw_ground
from startrack.simulation.skyline_image import draw_band, draw_camera, simulate_measured
from startrack.simulation.star_rays import Starlight, simulate_rays, simulate_stars

__all__ = [
    "Starlight", "draw_band", "draw_camera", "draw_ground", "simulate_measured", "simulate_rays", "simulate_stars",
]  # fmt: skip
