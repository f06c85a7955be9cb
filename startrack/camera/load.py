"""A camera by the name of a shipped file or by the path of a file: ours, or one of another program."""

from __future__ import annotations

import logging
from functools import lru_cache
from pathlib import Path

import numpy as np

from startrack.camera.camera import Camera
from startrack.camera.convert import camera_from_foreign_text
from startrack.camera.formats import find_program
from startrack.camera.io import camera_from_dict
from startrack.core.files import FOREIGN_CAMERA_SUFFIXES, parse_toml, printable, read_text, resolve_named
from startrack.core.types import BadInput

LOG = logging.getLogger(__name__)


def load_camera(name_or_path: str | Path) -> Camera:
    """The camera of a file of startrack, ROS, Kalibr, COLMAP or OpenCV; the program is found by the content.

    `name_or_path` is a path if it contains a separator or ends in .toml, .yaml, .yml, .xml or .txt, else the name of a
    shipped file. Raises BadInput: no_calibration if there is no such file, bad_calibration if it cannot be used.
    """
    path = resolve_named(name_or_path, "calib", "no_calibration")
    text = read_text(path, "bad_calibration")
    try:
        program = None if path.suffix == ".toml" else find_program(text)
        if program is not None:
            camera = camera_from_foreign_text(text, program, path.stem)
            _log_angle(printable(path), program, float(np.degrees(camera.calibrated_angle_rad)))
            return camera
        if path.suffix in FOREIGN_CAMERA_SUFFIXES:
            raise BadInput("bad_calibration", "not a camera file of startrack (.toml), ROS, Kalibr, COLMAP or OpenCV")
        return camera_from_dict(parse_toml(text, "bad_calibration"), default_name=path.stem, folder=path.parent)
    except BadInput as cause:
        raise BadInput(cause.reason, f"{printable(path)}: {cause}") from cause


@lru_cache  # once for a file, however many images name it
def _log_angle(path: str, program: str, angle_deg: float) -> None:
    LOG.warning(
        "%s: the lens is taken as calibrated to %.1f degrees off the axis, the frame's nearest edge: the file states "
        "no angle (startrack calibrate convert --from %s --calibrated-angle DEG sets one)",
        path, angle_deg, program,
    )  # fmt: skip
