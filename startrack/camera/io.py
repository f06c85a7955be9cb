"""Camera files: declared keys (TOML), read, check and write; a camera by name or path, and those of other programs.

Other programs share our axes (x right, y down, z along the boresight) and, but for RMS, our radial polynomial; none of
them has mirrored images, image circles, calibrated angles, sensors or covariances.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from startrack.camera.camera import (
    MIN_THROUGHPUT_1,
    REFRACTION_CONTAINED,
    REFRACTION_REMOVED,
    ZENITH_MOUNT_R_BODY_CAM,
    Camera,
    Decentring,
    Sensor,
    cap_grid,
    difference_px,
    require_not_mirrored,
)
from startrack.camera.formats import FOREIGN_FORMATS, choose_part, find_program
from startrack.camera.lens import Lens
from startrack.camera.lenses import default_lens, lens_kinds
from startrack.core.declaration import Choice, Flag, Key, List, Number, Table, Text
from startrack.core.file_kinds import PROGRAMS, PROGRAMS_TEXT
from startrack.core.files import (
    FOREIGN_CAMERA_SUFFIXES,
    MAX_CAUSE_CHARS,
    parse_toml,
    printable,
    read_text,
    relative_path,
    require_reference,
    resolve_named,
    split_camera,
    write_atomically,
)
from startrack.core.obstacles import Obstacles
from startrack.core.types import MAX_PIXELS, Array, BadInput, Mask
from startrack.frames import R_from_quat_xyzw, quat_xyzw_from_R

UNIT_QUATERNION_1 = 1e-3  # largest error of the length
MIN_SIGMA = 1e-15  # of a parameter, px or 1; smaller ones count as zero
CORRELATION_ROUNDING_1 = 1e-6  # of correlations: asymmetry and negative eigenvalues up to this are rounding
MAX_PARAMETERS = 32
CAMERA_PARAMETERS = ("fx", "fy", "cx", "cy", "p1", "p2")  # beside those of the lens
SENSOR = Table(closed=True, keys={
    "zero_point_e_per_s": Number(low=1e-6, high=1e15, required=True,
                                 description="electrons per second of a V = 0 star on the axis, whole PSF"),
    "gain_e_per_adu": Number(low=1e-6, high=1e6, default=Sensor.gain_e_per_adu),
    "bias_adu": Number(low=-1e9, high=1e9, default=Sensor.bias_adu),
    "read_noise_e": Number(low=0, high=1e6, default=Sensor.read_noise_e),
    "dark_e_per_s": Number(low=0, high=1e9, default=Sensor.dark_e_per_s, description="per pixel"),
    "saturation_adu": Number(low=1, high=1e12, default=Sensor.saturation_adu),
    "psf_sigma_px": Number(low=0.01, high=50, default=Sensor.psf_sigma_px,
                           description="before integration over the pixel"),
    "vignetting": List(each=Number(low=-100, high=100), count=2, default=Sensor.vignetting,
                       description="relative throughput 1 + v1 a^2 + v2 a^4"),
})  # fmt: skip
MOUNT = Table(keys={
    "quat_xyzw_body_cam": List(each=Number(low=-1, high=1), count=4, description="x, y, z, w of the rotation from cam "
                               "to body; default: a camera that looks up"),
})  # fmt: skip
COVARIANCE = Table(keys={
    "order": List(each=Text(max_chars=20), required=True, least=1, most=MAX_PARAMETERS),
    "matrix": List(each=List(each=Number(), most=MAX_PARAMETERS), required=True, least=1, most=MAX_PARAMETERS,
                   description="px and 1"),
})  # fmt: skip
LOG = logging.getLogger(__name__)
SMALL_ANGLE_DEG = 1e-3  # of an image circle within any lens


def camera_keys(lens: type[Lens] | None = None) -> Table:
    """The declared keys of camera files with this lens; None: those of all lenses, none of which is then required.

    Raises ValueError for a key of all lenses that has two declarations.
    """
    first: dict[str, Key] = {
        "format": Choice(values=(1,), default=1),
        "name": Text(max_chars=200),
        "model": Choice(values=tuple(lens_kinds()), default=default_lens().model),
        "size_px": List(each=Number(low=1, high=65_535, integer=True), count=2, required=True),
        "focal_px": List(each=Number(low=1e-3, high=1e6), count=2, required=True,
                         description="pixels per radian on the axis"),
        "centre_px": List(each=Number(low=-1e6, high=1e6), count=2, required=True,
                          description="(0, 0) is the centre of the top-left pixel"),
    }  # fmt: skip
    last: dict[str, Key] = {
        "max_angle_deg": Number(low=0, high=180, above=True, required=True,
                                description="edge of the image circle, off the axis"),
        "calibrated_angle_deg": Number(low=0, high=360, above=True,
                                       description="beyond this the lens is not known; default: max_angle_deg"),
        "mirrored": Flag(default=False),
        "mask": Text(is_path=True,
                     description="8-bit image of this size, relative to this file: pixels below 128 do not count"),
        "obstacles": Text(is_path=True,
                          description="CSV file, relative to this one: azimuth_deg from body x to the right, and "
                          "elevation_deg above the body's x y plane, below which the view is hidden"),
        "refraction": Choice(values=(REFRACTION_REMOVED, REFRACTION_CONTAINED),
                             description="of the Earth's air: contained in a lens calibrated without a site"),
        "decentring": List(each=Number(low=-1, high=1), count=2, description="p1, p2 of a decentred lens"),
        "mount": MOUNT,
        "sensor": SENSOR,
        "covariance": COVARIANCE,
    }  # fmt: skip
    return Table(
        description="x_px = cx + fx rho cos b, y_px = cy + fy rho sin b; rho = "
        + ", or ".join(one.law for one in lens_kinds().values() if one.law),
        keys={**first, **(_keys_of_lenses({**first, **last}) if lens is None else lens.file_keys()), **last},
    )


def _keys_of_lenses(common: Mapping[str, Key]) -> dict[str, Key]:
    """The keys of all lenses beside those `common` to camera files; none is required.

    Raises ValueError for a key that a lens declares otherwise than another lens or all camera files.
    """
    found = {key: replace(one, required=False) for key, one in common.items()}
    for lens in lens_kinds().values():
        for key, one in lens.file_keys().items():
            declared = replace(one, required=False)
            if found.setdefault(key, declared) != declared:
                raise ValueError(
                    f"the {lens.model} lens declares the key {key!r} of camera files otherwise than another lens or "
                    "than all camera files: give it another name"
                )
    return {key: one for key, one in found.items() if key not in common}


def save_camera(camera: Camera, path: str | Path) -> None:
    """Write the camera to the file `path`; `load_camera` gives it back.

    Raises BadInput if it cannot be written, ValueError for a mask that is no file.
    """
    if isinstance(camera.mask, Mask):
        raise ValueError("the camera's mask is an array: write it as an image, and give its path")
    if isinstance(camera.obstacles, Obstacles):
        raise ValueError("the camera's obstacles are no file: write them as one, and give its path")
    write_atomically(path, camera_text(camera, Path(path).parent).encode("utf-8"), overwrite=True)


def camera_text(camera: Camera, folder: Path | None = None) -> str:
    """Text of the `camera`'s file; mask and obstacles as seen from the `folder` of the file (None: the current one)."""
    import tomli_w

    values = camera_to_dict(camera)
    for key in ("mask", "obstacles"):
        if key in values and folder is not None:
            values[key] = relative_path(values[key], folder)
    return tomli_w.dumps(values)


def camera_from_dict(d: dict[str, Any], default_name: str = "camera", folder: Path | None = None) -> Camera:
    """The camera of the keys `d` of a camera file, called `default_name` if they have no name.

    Paths of mask and obstacles are relative to `folder` (None: the current one). Raises BadInput bad_calibration with
    a line that names the wrong key.
    """
    try:
        model = d.get("model", default_lens().model)
        lens = lens_kinds().get(model) if isinstance(model, str) else None
        return _camera_of_values(camera_keys(lens).check(d, ""), default_name, folder or Path())
    except ValueError as cause:
        raise BadInput("bad_calibration", str(cause)) from cause


def camera_to_dict(camera: Camera) -> dict[str, Any]:
    """Keys and values of the file of a `camera`."""
    d: dict[str, Any] = {
        "format": 1,
        "name": camera.name,
        "model": camera.lens.model,
        "size_px": [int(n) for n in camera.size_px],
        "focal_px": [float(f) for f in camera.focal_px],
        "centre_px": [float(c) for c in camera.centre_px],
        **camera.lens.file_values(),
        "max_angle_deg": float(np.degrees(camera.max_angle_rad)),
        "calibrated_angle_deg": float(np.degrees(camera.calibrated_angle_rad)),
        "mirrored": camera.mirrored,
    }
    if camera.refraction:
        d["refraction"] = camera.refraction
    for key, value in (("mask", camera.mask), ("obstacles", camera.obstacles)):
        if isinstance(value, str):
            d[key] = value
    if camera.decentring:
        d["decentring"] = [float(camera.decentring.p1), float(camera.decentring.p2)]
    if not np.array_equal(camera.R_body_cam, ZENITH_MOUNT_R_BODY_CAM):
        d["mount"] = {"quat_xyzw_body_cam": [float(q) for q in quat_xyzw_from_R(camera.R_body_cam)]}
    if camera.sensor is not None:
        d["sensor"] = {**vars(camera.sensor), "vignetting": list(camera.sensor.vignetting)}
    if camera.covariance is not None:
        d["covariance"] = {"order": list(camera.covariance_order), "matrix": camera.covariance.tolist()}
    return d


def _camera_of_values(values: dict[str, Any], default_name: str, folder: Path) -> Camera:
    """The camera of checked values. Raises ValueError for values that contradict each other."""
    width, height = values["size_px"]
    if width * height > MAX_PIXELS:
        raise ValueError(f"size_px is {width} x {height}: more than {MAX_PIXELS / 1e6:.0f} Mpx")
    lens = lens_kinds()[values["model"]].from_file(values)
    max_angle = float(np.radians(values["max_angle_deg"]))
    if max_angle > lens.max_invertible_rad + 1e-9:
        limit = np.degrees(lens.max_invertible_rad)
        raise ValueError(f"max_angle_deg: the radius of this lens only rises to {limit:.2f} degrees")
    calibrated = float(np.radians(min(values.get("calibrated_angle_deg", np.inf), values["max_angle_deg"])))
    order, covariance = _covariance(values.get("covariance"), lens)
    sensor = None if "sensor" not in values else Sensor(**values["sensor"])
    lowest = 1.0 if sensor is None else sensor.lowest_throughput(calibrated)
    if lowest < MIN_THROUGHPUT_1:
        raise ValueError(
            f"sensor.vignetting: within the calibrated angle of {np.degrees(calibrated):.1f} degrees the "
            f"throughput falls to {lowest:.2g} of that on the axis, below {MIN_THROUGHPUT_1:g}: no lens is that dark"
        )
    R_body_cam, quat_xyzw = ZENITH_MOUNT_R_BODY_CAM, values.get("mount", {}).get("quat_xyzw_body_cam")
    if quat_xyzw is not None:
        if abs(np.linalg.norm(quat_xyzw) - 1) > UNIT_QUATERNION_1:
            raise ValueError("mount.quat_xyzw_body_cam is not a unit quaternion")
        R_body_cam = R_from_quat_xyzw(quat_xyzw)
    return Camera(
        **{key: values[key] for key in ("size_px", "focal_px", "centre_px", "mirrored")},
        name=values.get("name", default_name),
        refraction=values.get("refraction", ""),
        max_angle_rad=max_angle,
        calibrated_angle_rad=calibrated,
        lens=lens,
        decentring=Decentring(*values.get("decentring", ())),
        R_body_cam=R_body_cam,
        sensor=sensor,
        covariance_order=order,
        covariance=covariance,
        mask=str(folder / values["mask"]) if "mask" in values else None,
        obstacles=str(folder / values["obstacles"]) if "obstacles" in values else None,
    )


def _covariance(values: dict[str, Any] | None, lens: Lens) -> tuple[tuple[str, ...], Array | None]:
    """Names (m,) and covariance (m, m) of parameters. Raises ValueError for what is no covariance of this lens's."""
    if values is None:
        return (), None
    order, rows = values["order"], values["matrix"]
    if len(rows) != len(order) or any(len(row) != len(order) for row in rows):
        raise ValueError(f"covariance.matrix must hold {len(order)} x {len(order)} numbers, as covariance.order has")
    known = (*CAMERA_PARAMETERS, *lens.parameter_names)
    if len(set(order)) < len(order) or not set(order) <= set(known):
        raise ValueError(f"covariance.order must name parameters of this lens, each once: {', '.join(known)}")
    matrix = np.array(rows)
    sigma = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    sigma[sigma < MIN_SIGMA] = 1.0
    correlation = matrix / np.outer(sigma, sigma)
    if (
        np.abs(correlation - correlation.T).max() > CORRELATION_ROUNDING_1
        or np.linalg.eigvalsh(correlation).min() < -CORRELATION_ROUNDING_1
    ):
        raise ValueError("covariance.matrix is no covariance: it must be symmetric and positive semi-definite")
    return order, matrix


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
            raise BadInput("bad_calibration", f"not a camera file of startrack (.toml), {PROGRAMS_TEXT}")
        keys = parse_toml(text, "bad_calibration")
        return camera_from_dict(keys, default_name=printable(path.stem), folder=path.parent)
    except BadInput as cause:
        raise BadInput(cause.reason, f"{printable(path)}: {cause}") from cause


def read_foreign_camera(name_or_path: str | Path, program: str | None, calibrated_angle_rad: float | None) -> Camera:
    """The camera of a file of `program`; None: a program that is found by the content.

    `name_or_path` is the file, or FILE#NAME, one camera of a file of several; `calibrated_angle_rad` is the angle off
    the axis up to which the lens was calibrated, None: that of the frame's nearest edge. Raises BadInput as
    `load_camera`.
    """
    file, wanted = split_camera(name_or_path)
    text = read_text(file, "no_calibration")
    program = program or find_program(text)
    if program is None:
        raise BadInput("bad_calibration", f"{printable(file)}: not a camera file of {PROGRAMS_TEXT}")
    return camera_from_foreign_text(text, program, _stem(Path(file), wanted), calibrated_angle_rad, wanted)


def _stem(path: Path, wanted: str | None) -> str:
    """Name of a camera, from that of its file and, of several cameras there, the `wanted` one's."""
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
    refusal = f"not a camera file of {PROGRAMS[program]} that can be used"
    try:
        content = choose_part(program, text, wanted)
        camera = _framed_camera(FOREIGN_FORMATS[program].read(content, calibrated_angle_rad), name)
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


def _framed_camera(keys: dict[str, Any], name: str) -> Camera:
    """A camera whose image circle ends at the frame's farthest corner, or where the radius stops rising."""
    R_body_cam, notes = keys.pop("R_body_cam", None), keys.pop("notes", ())
    named = {"name": keys.get("name") or name, "max_angle_deg": SMALL_ANGLE_DEG}
    camera = camera_from_dict(keys | named)  # the limits are checked here
    if R_body_cam is not None:
        camera = replace(camera, R_body_cam=R_body_cam)
    edge = float(np.max(camera.angle_rad(np.stack(np.meshgrid(*_frame_edges(camera)), axis=-1))))
    return replace(camera, max_angle_rad=edge, calibrated_angle_rad=edge, notes=notes)


def _frame_edges(camera: Camera) -> Array:
    """Edges (2, 2) of the frame [px]: left and right, top and bottom."""
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
