"""Camera files of other programs: their texts from a camera, and our own file's keys from them.

Pixel (0, 0) is the centre of the first pixel, as here and in ROS (REP 104), Kalibr and OpenCV.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from startrack.camera.camera import Camera
from startrack.camera.format_parts import (
    Coefficients,
    Part,
    keys_of,
    matrix_of,
    read_distortion,
    read_numbers,
    read_xml,
    read_yaml,
    yaml_list,
)
from startrack.camera.lenses import MAX_COEFFICIENTS
from startrack.camera.platepar_reading import plate_in, read_platepar
from startrack.camera.ros import read_ros, split_ros, write_ros
from startrack.core.types import BadInput
from startrack.frames import ORTHONORMAL_1, quat_xyzw_from_R

CORNER_PX = 0.5  # COLMAP's origin is the corner of the first pixel
COLMAP_HEAD = "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
COLMAP_LINE = re.compile(r"\d+\s+[A-Z_]+\s+\d+\s+\d+\s")  # CAMERA_ID, MODEL, WIDTH, HEIGHT
COLMAP_COUNTS = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL_FISHEYE": 4, "RADIAL_FISHEYE": 5, "OPENCV_FISHEYE": 8,
    "THIN_PRISM_FISHEYE": 12,
}  # fmt: skip
OPENCV_DISTORTION = "distortion_coefficients"
OPENCV_COUNTS = 4, 5, 8, 12, 14  # of distortion coefficients of OpenCV's models
OPENCV_HEAD = re.compile(r"\A\s*%YAML[: ]1\.0|!!opencv-matrix")  # which YAML itself does not have
MESSAGE_KEYS = {"k", "d", "distortion_model", "width", "height"}  # of sensor_msgs/CameraInfo
SHOWN_PARTS = 6  # cameras named in a refusal


class Format(NamedTuple):
    """The camera files of one program.

    `write` takes a camera and the coefficients of its fisheye, None for a pinhole; None where a file holds a pointing
    too. `split` finds the cameras of a text; `read` gives of one's content, and of the calibrated angle [rad] (None:
    not stated), the keys of our own camera file, beside them `R_body_cam` where there is a mount and `notes` on what
    was chosen or left out, and no angles. Both raise ValueError, LookupError, TypeError or AttributeError.
    """

    title: str
    write: Callable[[Camera, Coefficients], str] | None
    split: Callable[[str], list[Part]]
    read: Callable[[Any, float | None], dict[str, Any]]


def find_program(text: str) -> str | None:
    """The program whose camera file the `text` is, a key of FOREIGN_FORMATS; None if it is of none of them."""
    if "<opencv_storage>" in text or OPENCV_HEAD.search(text):
        return "opencv"
    if plate_in(text) is not None:
        return "platepar"
    lines = (line.strip() for line in text.splitlines())
    if COLMAP_LINE.match(next((line for line in lines if line and not line.startswith("#")), "")):
        return "colmap"
    try:
        keys = read_yaml(text)[0].keys()
    except ValueError:
        return None
    if "cam0" in keys or keys >= {"camera_model", "intrinsics"}:
        return "kalibr"
    if keys >= {"camera_matrix", "distortion_model"} or {key.lower() for key in map(str, keys)} >= MESSAGE_KEYS:
        return "ros"
    return "opencv" if keys >= {"camera_matrix", OPENCV_DISTORTION} else None


def choose_part(program: str, text: str, wanted: str | None) -> Any:
    """The content of the camera called `wanted` in the `text` of a file of `program`; None: of the only one.

    Raises BadInput bad_calibration that names the cameras of the file, and as `Format.split` does.
    """
    parts = FOREIGN_FORMATS[program].split(text)
    alike = all(part.content == parts[0].content for part in parts)
    found = next((part for part in parts if part.name == wanted or (wanted is None and alike)), None)
    if found is None:
        names = ", ".join(f"{part.name} ({part.size})" for part in parts[:SHOWN_PARTS])
        names += f" and {len(parts) - SHOWN_PARTS} more" if len(parts) > SHOWN_PARTS else ""
        if not parts[0].name:
            raise BadInput("bad_calibration", f"its one camera has no name: leave #{wanted} out")
        which = f"has no camera {wanted!r}" if wanted else "has several cameras"
        raise BadInput("bad_calibration", f"{which}: choose by the file's name, as FILE#{parts[0].name}, of {names}")
    return found.content


def _write_kalibr(camera: Camera, k: Coefficients) -> str:
    """A camchain of one camera, cam0: pinhole with equidistant distortion for fisheyes; the mount as T_cam_imu."""
    model, coefficients = ("radtan", (0.0,) * 4) if k is None else ("equidistant", k)
    rows = "".join(f"  - {yaml_list([*row, 0.0])}\n" for row in np.asarray(camera.R_body_cam).T.tolist())
    return (
        f"cam0:\n  cam_overlaps: []\n  camera_model: pinhole\n  distortion_coeffs: {yaml_list(coefficients)}\n"
        f"  distortion_model: {model}\n  intrinsics: {yaml_list([*camera.focal_px, *camera.centre_px])}\n"
        f"  resolution: [{camera.size_px[0]}, {camera.size_px[1]}]\n"
        f"  T_cam_imu:\n{rows}  - [0.0, 0.0, 0.0, 1.0]\n"
    )


def _split_kalibr(text: str) -> list[Part]:
    """The cameras of a camchain, cam0 and so on, or the one of a file without these names."""
    chain = {key: value for document in read_yaml(text) for key, value in document.items()}
    cameras = {str(key): value for key, value in chain.items() if re.fullmatch(r"cam\d+", str(key))}
    parts = (cameras or {"": chain}).items()
    return [Part(name, " x ".join(str(n) for n in d.get("resolution", ())), d) for name, d in parts]


def _read_kalibr(d: dict[str, Any], _angle_rad: float | None) -> dict[str, Any]:
    """One camera of a camchain."""
    if d["camera_model"] != "pinhole":
        raise ValueError(f"camera_model {d['camera_model']!r} has no counterpart")
    fx, fy, cx, cy = read_numbers(d["intrinsics"], 4, "intrinsics")
    width, height = read_numbers(d["resolution"], 2, "resolution")
    k = read_distortion(
        d["distortion_model"], d.get("distortion_coeffs", []), ("equidistant", "equi"), ("radtan", "none")
    )
    keys = keys_of((width, height), (fx, fy), (cx, cy), k)
    if "T_cam_imu" in d:
        keys["R_body_cam"] = R_body_cam = np.array(
            [read_numbers(row, 4, "T_cam_imu")[:3] for row in d["T_cam_imu"][:3]]
        ).T
        if R_body_cam.shape != (3, 3) or np.abs(R_body_cam).max() > 1 + ORTHONORMAL_1:
            raise ValueError("T_cam_imu holds no rotation")
        quat_xyzw_from_R(R_body_cam.T)  # ValueError for what is no proper rotation
    return keys


def _write_colmap(camera: Camera, k: Coefficients) -> str:
    """A cameras.txt file of one camera: PINHOLE, OPENCV_FISHEYE, or THIN_PRISM_FISHEYE where the lens is decentred."""
    (fx, fy), (cx, cy), bent = camera.focal_px, camera.centre_px, camera.decentring
    values = [fx, fy, cx + CORNER_PX, cy + CORNER_PX]
    model = "PINHOLE"
    if bent:
        if k is None:
            raise BadInput("bad_calibration", "COLMAP has no decentred pinhole on angles")
        model = "THIN_PRISM_FISHEYE"
        values += [*k[:2], bent.p1, bent.p2, *k[2:], 0.0, 0.0]
    elif k is not None:
        model = "OPENCV_FISHEYE"
        values += k
    numbers = " ".join(repr(float(v)) for v in values)
    return f"{COLMAP_HEAD}# Number of cameras: 1\n1 {model} {camera.size_px[0]} {camera.size_px[1]} {numbers}\n"


def _split_colmap(text: str) -> list[Part]:
    """The cameras of a cameras.txt file, by their CAMERA_ID."""
    lines = [line.split() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if not lines or any(len(words) < 4 for words in lines):
        raise ValueError("no line CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]")
    return [Part(number, f"{words[1]} x {words[2]}", words) for number, *words in lines]


def _read_colmap(content: list[str], _angle_rad: float | None) -> dict[str, Any]:
    """One camera of a cameras.txt file, from its words after the number."""
    model, width, height, *words = content
    values = [float(word) for word in words]
    if len(values) != COLMAP_COUNTS.get(model, -1):
        raise ValueError(f"camera model {model} with {len(values)} parameters has no counterpart")
    if model.startswith("SIMPLE") or model == "RADIAL_FISHEYE":
        values = [values[0], *values]
    fx, fy, cx, cy, *rest = values
    decentring = None
    if model == "THIN_PRISM_FISHEYE":
        k1, k2, p1, p2, k3, k4, sx, sy = rest
        if sx or sy:
            raise ValueError("thin-prism coefficients other than 0 have no counterpart")
        rest, decentring = [k1, k2, k3, k4], (p1, p2)
    k = None if model.endswith("PINHOLE") else (*rest, *(MAX_COEFFICIENTS * (0.0,)))[:MAX_COEFFICIENTS]
    keys = keys_of((width, height), (fx, fy), (cx - CORNER_PX, cy - CORNER_PX), k)
    return keys if decentring is None else keys | {"decentring": decentring}


def _write_opencv(camera: Camera, k: Coefficients) -> str:
    """OpenCV's FileStorage as YAML, with the keys of its calibration program.

    fisheye_model = 1: cv2.fisheye's four coefficients, which are k1 to k4. cv2.fisheye itself mirrors rays past 90
    degrees: the numbers are right, that program's geometry there is not.
    """

    def matrix(rows: int, columns: int, data: Sequence[float]) -> str:
        text = ", ".join(repr(float(v)) for v in data)
        return f"!!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [ {text} ]\n"

    coefficients = (0.0,) * 5 if k is None else k
    return (
        f"%YAML:1.0\n---\nimage_width: {camera.size_px[0]}\nimage_height: {camera.size_px[1]}\n"
        f"fisheye_model: {int(k is not None)}\ncamera_matrix: {matrix(3, 3, matrix_of(camera))}"
        f"{OPENCV_DISTORTION}: {matrix(len(coefficients), 1, coefficients)}"
    )


def _split_opencv(text: str) -> list[Part]:
    """The one camera of YAML or XML; OpenCV's own parser is not used: damaged files end its process."""
    xml = text.lstrip().startswith("<")
    return [Part("", "", read_xml(text) if xml else read_yaml(OPENCV_HEAD.sub("", text))[0])]


def _read_opencv(d: dict[str, Any], _angle_rad: float | None) -> dict[str, Any]:
    """The camera of a FileStorage."""
    arrays = []
    for key, counts in (("camera_matrix", (9,)), (OPENCV_DISTORTION, OPENCV_COUNTS)):
        count = int(d[key]["rows"]) * int(d[key]["cols"])
        if count not in counts:
            raise ValueError(f"{key} must hold {' or '.join(map(str, counts))} numbers, not {count}")
        arrays.append(read_numbers(d[key]["data"], count, key))
    model = "fisheye" if float(d.get("fisheye_model", 0)) == 1 else "pinhole"
    k = read_distortion(model, arrays[1], ("fisheye",), ("pinhole",))
    fx, skew, cx, _, fy, cy, *_ = arrays[0]
    if skew:
        raise ValueError("a skewed camera matrix has no counterpart")
    return keys_of((d["image_width"], d["image_height"]), (fx, fy), (cx, cy), k)


def _split_platepar(text: str) -> list[Part]:
    """The one lens of a platepar."""
    plate = plate_in(text)
    if plate is None:
        raise ValueError("no JSON with F_scale, X_res and Y_res")
    return [Part("", "", plate)]


FOREIGN_FORMATS = {
    "ros": Format("ROS", write_ros, split_ros, read_ros),
    "kalibr": Format("Kalibr", _write_kalibr, _split_kalibr, _read_kalibr),
    "colmap": Format("COLMAP", _write_colmap, _split_colmap, _read_colmap),
    "opencv": Format("OpenCV", _write_opencv, _split_opencv, _read_opencv),
    "platepar": Format("RMS", None, _split_platepar, read_platepar),
}
