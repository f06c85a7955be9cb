"""A camera by the name of a shipped file or by the path of a file: ours, or one of another program."""

from __future__ import annotations

import logging
from functools import lru_cache
from pathlib import Path

import numpy as np

from startrack.camera.camera import Camera
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
        program = _other_program(path, text)
        if program is None:
            return camera_from_dict(parse_toml(text, "bad_calibration"), default_name=path.stem, folder=path.parent)
        return _converted(path, text, program)
    except BadInput as cause:
        raise BadInput(cause.reason, f"{printable(path)}: {cause}") from cause


def _other_program(path: Path, text: str) -> str | None:
    """The program whose camera file the `text` is, None for ours. Raises BadInput for a file of none."""
    if path.suffix == ".toml":
        return None
    from startrack.camera.convert.recognize import find_program

    program = find_program(text)
    if program is None and path.suffix in FOREIGN_CAMERA_SUFFIXES:
        raise BadInput("bad_calibration", "not a camera file of startrack (.toml), ROS, Kalibr, COLMAP or OpenCV")
    return program


def _converted(path: Path, text: str, program: str) -> Camera:
    """The camera of another `program`; the log names the calibrated angle, which no such file states."""
    from startrack.camera.convert import from_text

    camera = from_text(text, program, path.stem)
    _log_angle(printable(path), program, float(np.degrees(camera.calibrated_angle_rad)))
    return camera


@lru_cache  # once for a file, however many images name it
def _log_angle(path: str, program: str, angle_deg: float) -> None:
    LOG.warning(
        "%s: the lens is taken as calibrated to %.1f degrees off the axis, the frame's nearest edge: the file states "
        "no angle (startrack calibrate convert --from %s --calibrated-angle DEG sets one)",
        path, angle_deg, program,
    )  # fmt: skip
