"""A camera by the name or the path of a file, and cameras from and to the files of other programs.

Other programs share our axes (x right, y down, z along the boresight) and our radial polynomial; none of them has
mirrored images, image circles, calibrated angles, sensors or covariances.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from startrack.camera.camera import Camera, cap_grid, difference_px, require_not_mirrored
from startrack.camera.formats import FOREIGN_FORMATS, find_program
from startrack.camera.io import camera_from_dict
from startrack.camera.optics import Decentring
from startrack.core.files import (
    FOREIGN_CAMERA_SUFFIXES,
    MAX_CAUSE_CHARS,
    parse_toml,
    printable,
    read_text,
    resolve_named,
)
from startrack.core.types import Array, BadInput

LOG = logging.getLogger(__name__)
SMALL_ANGLE_DEG = 1e-3  # of an image circle within any lens


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
            camera = camera_from_foreign_text(text, program, printable(path.stem))
            _log_angle(printable(path), program, float(np.degrees(camera.calibrated_angle_rad)))
            return camera
        if path.suffix in FOREIGN_CAMERA_SUFFIXES:
            raise BadInput("bad_calibration", "not a camera file of startrack (.toml), ROS, Kalibr, COLMAP or OpenCV")
        keys = parse_toml(text, "bad_calibration")
        return camera_from_dict(keys, default_name=printable(path.stem), folder=path.parent)
    except BadInput as cause:
        raise BadInput(cause.reason, f"{printable(path)}: {cause}") from cause


@lru_cache  # once for a file, however many images name it
def _log_angle(path: str, program: str, angle_deg: float) -> None:
    LOG.warning(
        "%s: the lens is taken as calibrated to %.1f degrees off the axis, the frame's nearest edge: the file states "
        "no angle (startrack calibrate convert --from %s --calibrated-angle DEG sets one)",
        path, angle_deg, program,
    )  # fmt: skip


def foreign_text(camera: Camera, program: str) -> str:
    """The camera as text of a file of `program`, a key of FOREIGN_FORMATS.

    Raises BadInput bad_calibration for a mirrored camera, and if the format cannot hold the lens.
    """
    require_not_mirrored(camera)
    distortion = camera.lens.opencv_coefficients
    if distortion is None:
        raise BadInput("bad_calibration", f"no other program's format has the {camera.lens.model} lens")
    model, coefficients = distortion
    return FOREIGN_FORMATS[program].write(camera, None if model == "pinhole" else coefficients)


def camera_from_foreign_text(text: str, program: str, name: str, calibrated_angle_rad: float | None = None) -> Camera:
    """The camera of the `text` of a file of `program`, called `name` unless the file names it.

    No such file states `calibrated_angle_rad`, the angle off the axis up to which the lens was calibrated: None takes
    the angle at the edge of the frame that is nearest to the centre. Raises BadInput bad_calibration.
    """
    refusal = f"not a camera file of {FOREIGN_FORMATS[program].title} that can be used"
    try:
        camera = _camera(FOREIGN_FORMATS[program].read(text), name)
        angle = _nearest_edge_rad(camera) if calibrated_angle_rad is None else calibrated_angle_rad
        return replace(camera, calibrated_angle_rad=min(angle, camera.max_angle_rad))
    except BadInput as error:
        raise BadInput("bad_calibration", f"{refusal}: {error}") from error
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
        cause = f"{error} is missing" if isinstance(error, KeyError) else error
        raise BadInput("bad_calibration", f"{refusal}: {' '.join(str(cause)[:MAX_CAUSE_CHARS].split())}") from error


def _camera(keys: dict[str, Any], name: str) -> Camera:
    """A camera whose image circle ends at the frame's farthest corner, or where the radius stops rising."""
    R_body_cam = keys.pop("R_body_cam", None)
    named = {"name": keys.get("name") or name, "max_angle_deg": SMALL_ANGLE_DEG}
    camera = camera_from_dict(keys | named)  # the limits are checked here
    if R_body_cam is not None:
        camera = replace(camera, R_body_cam=R_body_cam)
    edge = float(np.max(camera.angle_rad(np.stack(np.meshgrid(*_frame_edges(camera)), axis=-1))))
    return replace(camera, max_angle_rad=edge, calibrated_angle_rad=edge)


def _frame_edges(camera: Camera) -> Array:
    """Left and right, and top and bottom, edge (2, 2) of the frame [px]."""
    return np.array([[-0.5, n - 0.5] for n in camera.size_px])


def _nearest_edge_rad(camera: Camera) -> float:
    """The angle off the axis [rad] of the point of the frame's edge that is nearest to the centre."""
    (cx, cy), (x, y) = camera.centre_px, _frame_edges(camera)
    if not (x[0] < cx < x[1] and y[0] < cy < y[1]):
        raise BadInput(
            "bad_calibration",
            "the centre is outside the frame: give the angle up to which the lens is calibrated, --calibrated-angle",
        )
    return float(np.min(camera.angle_rad(np.array([[x[0], cy], [x[1], cy], [cx, y[0]], [cx, y[1]]]))))


def decentring_rms_px(camera: Camera) -> float:
    """RMS difference [px] over the calibrated cap to the camera without decentring, the best rotation removed."""
    centred = replace(camera, decentring=Decentring())
    difference = difference_px(centred, camera, cap_grid(camera.calibrated_angle_rad))
    return float(np.sqrt(np.mean(np.sum(difference**2, axis=1))))
