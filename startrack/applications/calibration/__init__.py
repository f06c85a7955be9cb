"""Camera calibration from the stars: lens with covariance, throughput, sensor, and acceptance checks.

`run.py` tells the story; `lens_fit.py` and `frame_matching.py` of the estimation fit the lens. Boards: `board.py`.
"""

from startrack.applications.calibration.board import Board, calibrate_board
from startrack.applications.calibration.initial_states import initial_state
from startrack.applications.calibration.record import (
    CALIBRATION,
    VERIFICATION,
    board_dict,
    board_line,
    calibration_dict,
    camera_properties,
    camera_summary,
    refusal_dict,
    summary,
)
from startrack.applications.calibration.report import write_report
from startrack.applications.calibration.run import Calibration, calibrate, count_steps
from startrack.applications.calibration.sensor import KnownSensor
from startrack.applications.calibration.verify import (
    VERIFICATION_FORMAT,
    Verification,
    verify,
    verify_dict,
    verify_line,
)
from startrack.estimation.adjust import observations
from startrack.estimation.lens_fit import fit_lens

__all__ = [
    "CALIBRATION", "VERIFICATION", "VERIFICATION_FORMAT", "Board", "Calibration", "KnownSensor", "Verification",
    "board_dict", "board_line", "calibrate", "calibrate_board", "calibration_dict", "camera_properties",
    "camera_summary", "count_steps", "fit_lens", "initial_state", "observations", "refusal_dict", "summary", "verify",
    "verify_dict", "verify_line", "write_report",
]  # fmt: skip
