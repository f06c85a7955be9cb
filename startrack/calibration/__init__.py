"""Camera calibration from the stars themselves: lens with covariance, sensor, and what speaks for or against them."""

from startrack.calibration.fit import LensFit, fit_lens
from startrack.calibration.initial_camera import first_state
from startrack.calibration.observations import Observations, observations
from startrack.calibration.photometry import Given
from startrack.calibration.run import Calibration, calibrate

__all__ = ["Calibration", "Given", "LensFit", "Observations", "calibrate", "first_state", "fit_lens", "observations"]
