"""The skyline of a fixed camera on the Earth, from photographs of the night sky."""

from startrack.applications.horizon.frames import LeftOut, SkyFrame, orient_frames
from startrack.applications.horizon.measure import SkylineResult, measure_frames, measure_skyline, predicted_visible
from startrack.applications.horizon.write import check_outputs, needs_all_azimuths, write_skyline

__all__ = [
    "LeftOut", "SkyFrame", "SkylineResult", "check_outputs", "measure_frames",
    "measure_skyline", "needs_all_azimuths", "orient_frames", "predicted_visible", "write_skyline",
]  # fmt: skip
