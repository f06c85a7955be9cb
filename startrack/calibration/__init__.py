"""Camera calibration from the stars: lens with covariance, throughput, sensor, and acceptance checks."""

from startrack.calibration.initial_camera import initial_state
from startrack.calibration.lens_fit import LensFit, fit_lens
from startrack.calibration.photometry import KnownSensor
from startrack.calibration.run import Calibration, calibrate
from startrack.normal_equations import Observations, observations

__all__ = [
    "Calibration",
    "KnownSensor",
    "LensFit",
    "Observations",
    "calibrate",
    "fit_lens",
    "initial_state",
    "observations",
]
