"""Camera calibration from the stars: lens with covariance, throughput, sensor, and acceptance checks."""

from startrack.applications.calibration.initial_camera import initial_state
from startrack.applications.calibration.lens_fit import LensFit, fit_lens
from startrack.applications.calibration.photometry import KnownSensor
from startrack.applications.calibration.run import Calibration, calibrate
from startrack.estimation.normal_equations import Observations, observations

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
