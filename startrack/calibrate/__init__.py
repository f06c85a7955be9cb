"""Camera calibration from the stars themselves: lens with covariance, sensor, and what speaks for or against them."""

from startrack.calibrate.fit import LensFit, fit_lens
from startrack.calibrate.observations import Observations, observations
from startrack.calibrate.photometry import Given
from startrack.calibrate.run import Calibration, calibrate
from startrack.calibrate.start import first_state

__all__ = ["Calibration", "Given", "LensFit", "Observations", "calibrate", "first_state", "fit_lens", "observations"]
