"""The skyline of a fixed camera on the Earth, from photographs of the night sky."""

from startrack.applications.horizon.frames import LeftOut, SkyFrame
from startrack.applications.horizon.measure import SkylineResult, measure_skyline, predicted_visible

__all__ = ["LeftOut", "SkyFrame", "SkylineResult", "measure_skyline", "predicted_visible"]
