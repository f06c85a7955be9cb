"""A camera by the name or the path of a file, and cameras from and to the files of other programs.

Other programs share our axes (x right, y down, z along the boresight) and, but for RMS, our radial polynomial; none of
them has mirrored images, image circles, calibrated angles, sensors or covariances.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from startrack.camera.camera import Camera, cap_grid, difference_px, require_not_mirrored
from startrack.camera.formats import FOREIGN_FORMATS, choose_part, find_program
from startrack.camera.io import camera_from_dict
from startrack.camera.optics import Decentring
from startrack.core.files import (
    FOREIGN_CAMERA_SUFFIXES,
    MAX_CAUSE_CHARS,
    parse_toml,
    printable,
    read_text,
    require_reference,
    resolve_named,
    split_camera,
)
from startrack.core.types import Array, BadInput

LOG = logging.getLogger(__name__)
SMALL_ANGLE_DEG = 1e-3  # of an image circle within any lens


def load_camera(name_or_path: str | Path) -> Camera:
    """The camera of a file of startrack or of another program, which is found by the content.

    `name_or_path` is a path if it contains a separator or ends in .toml, .yaml, .yml, .xml, .txt or .cal, else the name
    of a shipped file. FILE#NAME is one camera of a file of several. What was chosen or left out stands in its `notes`,
    and is logged. Raises BadInput: no_calibration if there is no such file, bad_calibration if it cannot be used.
    """
    camera = read_camera(name_or_path)
    _log_notes(printable(name_or_path), camera.notes)
    return camera


def read_camera(name_or_path: str | Path) -> Camera:
    """The camera of `name_or_path` as by `load_camera`, but nothing is logged."""
    require_reference(name_or_path, "no_calibration")
    file, wanted = split_camera(name_or_path)
    path = resolve_named(file, "calib", "no_calibration")
    text = read_text(path, "bad_calibration")
    try:
        program = None if path.suffix == ".toml" else find_program(text)
        if program is not None:
            return camera_from_foreign_text(text, program, _stem(path, wanted), wanted=wanted)
        if path.suffix in FOREIGN_CAMERA_SUFFIXES:
            raise BadInput("bad_calibration", f"not a camera file of startrack (.toml), {known_programs()}")
        keys = parse_toml(text, "bad_calibration")
        return camera_from_dict(keys, default_name=printable(path.stem), folder=path.parent)
    except BadInput as cause:
        raise BadInput(cause.reason, f"{printable(path)}: {cause}") from cause


def read_foreign_camera(name_or_path: str | Path, program: str | None, calibrated_angle_rad: float | None) -> Camera:
    """The camera of a file of `program`, None: found by the content.

    `name_or_path` is the file, or FILE#NAME, one camera of a file of several; `calibrated_angle_rad` is the angle off
    the axis up to which the lens was calibrated, None: that of the frame's nearest edge. Raises BadInput as
    `load_camera`.
    """
    file, wanted = split_camera(name_or_path)
    text = read_text(file, "no_calibration")
    program = program or find_program(text)
    if program is None:
        raise BadInput("bad_calibration", f"{printable(file)}: not a camera file of {known_programs()}")
    return camera_from_foreign_text(text, program, _stem(Path(file), wanted), calibrated_angle_rad, wanted)


def known_programs() -> str:
    """The programs whose camera files are read, as text."""
    *titles, last = [one.title for one in FOREIGN_FORMATS.values()]
    return f"{', '.join(titles)} or {last}"


def _stem(path: Path, wanted: str | None) -> str:
    """The name of a camera from that of its file."""
    return printable(path.stem + (f"-{wanted}" if wanted else ""))


@lru_cache  # once for a file, however many images name it
def _log_notes(path: str, notes: tuple[str, ...]) -> None:
    for note in notes:
        LOG.warning("%s: %s", path, note)


def foreign_text(camera: Camera, program: str) -> str:
    """The camera as text of a file of `program`, a key of FOREIGN_FORMATS.

    Raises BadInput bad_calibration for a mirrored camera, and if the format cannot hold the lens.
    """
    require_not_mirrored(camera)
    distortion = camera.lens.opencv_coefficients
    if distortion is None:
        raise BadInput("bad_calibration", f"no other program's format has the {camera.lens.model} lens")
    model, coefficients = distortion
    write = FOREIGN_FORMATS[program].write
    if write is None:
        raise ValueError(f"a file of {program} holds a pointing too: it is not written from a camera alone")
    return write(camera, None if model == "pinhole" else coefficients)


def camera_from_foreign_text(
    text: str, program: str, name: str, calibrated_angle_rad: float | None = None, wanted: str | None = None
) -> Camera:
    """The camera of the `text` of a file of `program`, called `name` unless the file names it.

    No such file states `calibrated_angle_rad`, the angle off the axis up to which the lens was calibrated: None takes
    the angle at the edge of the frame that is nearest to the centre. `wanted` is the name of one camera of several.
    Raises BadInput bad_calibration.
    """
    refusal = f"not a camera file of {FOREIGN_FORMATS[program].title} that can be used"
    try:
        content = choose_part(program, text, wanted)
        camera = _camera(FOREIGN_FORMATS[program].read(content, calibrated_angle_rad), name)
        if calibrated_angle_rad is not None:
            return replace(camera, calibrated_angle_rad=min(calibrated_angle_rad, camera.max_angle_rad))
        angle = min(_nearest_edge_rad(camera), camera.max_angle_rad)
        note = (
            f"the lens is taken as calibrated to {np.degrees(angle):.1f} degrees off the axis, the frame's nearest "
            "edge: the file states none; startrack calibrate convert --calibrated-angle DEG sets it"
        )
        return replace(camera, calibrated_angle_rad=angle, notes=(*camera.notes, note))
    except BadInput as error:
        raise BadInput("bad_calibration", f"{refusal}: {error}") from error
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
        cause = f"{error} is missing" if isinstance(error, KeyError) else error
        raise BadInput("bad_calibration", f"{refusal}: {' '.join(str(cause)[:MAX_CAUSE_CHARS].split())}") from error


def _camera(keys: dict[str, Any], name: str) -> Camera:
    """A camera whose image circle ends at the frame's farthest corner, or where the radius stops rising."""
    R_body_cam, notes = keys.pop("R_body_cam", None), keys.pop("notes", ())
    named = {"name": keys.get("name") or name, "max_angle_deg": SMALL_ANGLE_DEG}
    camera = camera_from_dict(keys | named)  # the limits are checked here
    if R_body_cam is not None:
        camera = replace(camera, R_body_cam=R_body_cam)
    edge = float(np.max(camera.angle_rad(np.stack(np.meshgrid(*_frame_edges(camera)), axis=-1))))
    return replace(camera, max_angle_rad=edge, calibrated_angle_rad=edge, notes=notes)


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
