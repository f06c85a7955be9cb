"""Evidence without pixels: what the pipeline measures of a scene, drawn without pixels."""

from startrack.simulation.ground_errors import draw_ground
from startrack.simulation.star_rays import simulate_rays
from startrack.simulation.starlight import Starlight

__all__ = ["Starlight", "draw_ground", "simulate_rays"]
