"""Camera files of ROS, Kalibr, COLMAP and OpenCV: their texts from a camera, and our own file's keys from them.

Pixel (0, 0) is the centre of the first pixel, as here and in ROS (REP 104), Kalibr and OpenCV.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from startrack.camera.camera import Camera
from startrack.camera.lenses import MAX_COEFFICIENTS, KannalaBrandt, Pinhole
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
MAX_YAML_CHARS = 2**18  # the loader takes 3 s for 2^20
Coefficients = tuple[float, ...] | None  # of a fisheye; None of a pinhole


class Format(NamedTuple):
    """The camera files of one program.

    `write` takes a camera and the coefficients of its fisheye, None for a pinhole. `read` gives keys of our own camera
    file, beside them `R_body_cam` where the text has a mount, and no angles; it raises ValueError, KeyError or
    TypeError.
    """

    title: str
    write: Callable[[Camera, Coefficients], str]
    read: Callable[[str], dict[str, Any]]


def find_program(text: str) -> str | None:
    """The program whose camera file the `text` is, a key of FOREIGN_FORMATS; None if it is of none of them."""
    if "<opencv_storage>" in text or OPENCV_HEAD.search(text):
        return "opencv"
    lines = (line.strip() for line in text.splitlines())
    if COLMAP_LINE.match(next((line for line in lines if line and not line.startswith("#")), "")):
        return "colmap"
    try:
        keys = _read_yaml(text).keys()
    except ValueError:
        return None
    if "cam0" in keys or keys >= {"camera_model", "intrinsics"}:
        return "kalibr"
    if keys >= {"camera_matrix", "distortion_model"}:
        return "ros"
    return "opencv" if keys >= {"camera_matrix", OPENCV_DISTORTION} else None


def _write_ros(camera: Camera, k: Coefficients) -> str:
    """A camera_info file (camera_calibration_parsers): equidistant for fisheyes, plumb_bob for pinholes."""
    model, coefficients = ("plumb_bob", (0.0,) * 5) if k is None else ("equidistant", k)
    (fx, fy), (cx, cy) = camera.focal_px, camera.centre_px
    name = json.dumps(camera.name, ensure_ascii=False)  # a JSON string is one of YAML
    return (
        f"image_width: {camera.size_px[0]}\nimage_height: {camera.size_px[1]}\ncamera_name: {name}\n"
        f"camera_matrix:\n  rows: 3\n  cols: 3\n  data: {_yaml_list(_matrix_of(camera))}\n"
        f"distortion_model: {model}\n"
        f"distortion_coefficients:\n  rows: 1\n  cols: {len(coefficients)}\n  data: {_yaml_list(coefficients)}\n"
        "rectification_matrix:\n  rows: 3\n  cols: 3\n  data: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]\n"
        "projection_matrix:\n  rows: 3\n  cols: 4\n"
        f"  data: {_yaml_list([fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0])}\n"
    )


def _read_ros(text: str) -> dict[str, Any]:
    d = _read_yaml(text)
    k = _read_distortion(
        d["distortion_model"], d["distortion_coefficients"]["data"],
        ("equidistant", "fisheye"), ("plumb_bob", "rational_polynomial"),
    )  # fmt: skip
    matrix = _read_numbers(d["camera_matrix"]["data"], 9, "camera_matrix")
    return _keys_of_matrix(d, matrix, k) | {"name": str(d.get("camera_name") or "")}


def _write_kalibr(camera: Camera, k: Coefficients) -> str:
    """A camchain of one camera, cam0: pinhole with equidistant distortion for fisheyes; the mount as T_cam_imu."""
    model, coefficients = ("radtan", (0.0,) * 4) if k is None else ("equidistant", k)
    rows = "".join(f"  - {_yaml_list([*row, 0.0])}\n" for row in np.asarray(camera.R_body_cam).T.tolist())
    return (
        f"cam0:\n  cam_overlaps: []\n  camera_model: pinhole\n  distortion_coeffs: {_yaml_list(coefficients)}\n"
        f"  distortion_model: {model}\n  intrinsics: {_yaml_list([*camera.focal_px, *camera.centre_px])}\n"
        f"  resolution: [{camera.size_px[0]}, {camera.size_px[1]}]\n"
        f"  T_cam_imu:\n{rows}  - [0.0, 0.0, 0.0, 1.0]\n"
    )


def _read_kalibr(text: str) -> dict[str, Any]:
    """The first camera of a camchain."""
    chain = _read_yaml(text)
    d = chain.get("cam0", chain)
    if d["camera_model"] != "pinhole":
        raise ValueError(f"camera_model {d['camera_model']!r} has no counterpart")
    fx, fy, cx, cy = _read_numbers(d["intrinsics"], 4, "intrinsics")
    width, height = _read_numbers(d["resolution"], 2, "resolution")
    k = _read_distortion(
        d["distortion_model"], d.get("distortion_coeffs", []), ("equidistant", "equi"), ("radtan", "none")
    )
    keys = _keys((width, height), (fx, fy), (cx, cy), k)
    if "T_cam_imu" in d:
        keys["R_body_cam"] = R_body_cam = np.array(
            [_read_numbers(row, 4, "T_cam_imu")[:3] for row in d["T_cam_imu"][:3]]
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


def _read_colmap(text: str) -> dict[str, Any]:
    """The first camera of a cameras.txt file."""
    lines = [line.split() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if not lines or len(lines[0]) < 4:
        raise ValueError("no line CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]")
    _number, model, width, height, *words = lines[0]
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
    keys = _keys((width, height), (fx, fy), (cx - CORNER_PX, cy - CORNER_PX), k)
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
        f"fisheye_model: {int(k is not None)}\ncamera_matrix: {matrix(3, 3, _matrix_of(camera))}"
        f"{OPENCV_DISTORTION}: {matrix(len(coefficients), 1, coefficients)}"
    )


def _read_opencv(text: str) -> dict[str, Any]:
    """YAML or XML; OpenCV's own parser is not used: damaged files end its process."""
    d = _read_xml(text) if text.lstrip().startswith("<") else _read_yaml(OPENCV_HEAD.sub("", text))
    arrays = []
    for key, counts in (("camera_matrix", (9,)), (OPENCV_DISTORTION, OPENCV_COUNTS)):
        count = int(d[key]["rows"]) * int(d[key]["cols"])
        if count not in counts:
            raise ValueError(f"{key} must hold {' or '.join(map(str, counts))} numbers, not {count}")
        arrays.append(_read_numbers(d[key]["data"], count, key))
    model = "fisheye" if float(d.get("fisheye_model", 0)) == 1 else "pinhole"
    k = _read_distortion(model, arrays[1], ("fisheye",), ("pinhole",))
    return _keys_of_matrix(d, arrays[0], k)


FOREIGN_FORMATS = {
    "ros": Format("ROS", _write_ros, _read_ros),
    "kalibr": Format("Kalibr", _write_kalibr, _read_kalibr),
    "colmap": Format("COLMAP", _write_colmap, _read_colmap),
    "opencv": Format("OpenCV", _write_opencv, _read_opencv),
}


def _matrix_of(camera: Camera) -> list[float]:
    """Camera matrix K (9,), row by row."""
    (fx, fy), (cx, cy) = camera.focal_px, camera.centre_px
    return [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]


def _keys_of_matrix(d: dict[str, Any], matrix: list[float], k: Coefficients) -> dict[str, Any]:
    """The keys of a camera matrix (9,), and of the image's size in `d`. Raises ValueError if it is skewed."""
    fx, skew, cx, _, fy, cy, *_ = matrix
    if skew:
        raise ValueError("a skewed camera matrix has no counterpart")
    return _keys((d["image_width"], d["image_height"]), (fx, fy), (cx, cy), k)


def _keys(
    size_px: Sequence[Any], focal_px: tuple[float, float], centre_px: tuple[float, float], k: Coefficients
) -> dict[str, Any]:
    """The keys of a camera file."""
    keys = {"size_px": tuple(map(int, size_px)), "focal_px": focal_px, "centre_px": centre_px}
    if k is None:
        return {**keys, "model": Pinhole.model}
    return {**keys, "model": KannalaBrandt.model, **({"k": k} if any(k) else {})}


def _read_numbers(values: Any, count: int, key: str) -> list[float]:
    """`count` finite numbers. Raises ValueError naming the key."""
    if not isinstance(values, Sequence) or isinstance(values, str) or len(values) != count:
        raise ValueError(f"{key} must be {count} numbers")
    numbers = [float(v) for v in values]
    if not all(map(math.isfinite, numbers)):
        raise ValueError(f"{key} must be {count} finite numbers")
    return numbers


def _read_distortion(
    model: str, coefficients: Any, fisheyes: tuple[str, ...], pinholes: tuple[str, ...]
) -> tuple[float, ...] | None:
    """k1 to k4 of a fisheye `model`, None for a pinhole without distortion. Raises ValueError for any other."""
    if model in fisheyes:
        return tuple(_read_numbers(coefficients, MAX_COEFFICIENTS, "distortion coefficients"))
    if model not in pinholes:
        raise ValueError(f"the distortion model {model!r} has no counterpart")
    if any(float(c) for c in coefficients):
        raise ValueError(f"distortion {model} with coefficients other than 0 has no counterpart; fisheye models have")
    return None


def _read_yaml(text: str) -> dict[str, Any]:
    """The mapping of a YAML file. Raises ValueError if there is none."""
    import yaml

    class Loader(yaml.SafeLoader):
        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):  # a few of them are a file of any size
                raise yaml.YAMLError("aliases (*name) are not read")
            return super().compose_node(parent, index)

    if len(text) > MAX_YAML_CHARS:
        raise ValueError(f"more than {MAX_YAML_CHARS // 2**10} KiB")
    try:
        value = yaml.load(text, Loader)
    except (yaml.YAMLError, RecursionError) as cause:
        raise ValueError(str(cause)) from cause
    if not isinstance(value, dict):
        raise ValueError("no keys")
    return value


def _yaml_list(values: Sequence[float]) -> str:
    """A list in one line of YAML, numbers to the last digit."""
    import yaml

    return str(yaml.safe_dump([float(v) for v in values], default_flow_style=True, width=math.inf)).strip()


def _read_xml(text: str) -> dict[str, Any]:
    """The entries of a FileStorage in XML: texts, and matrices as dictionaries. Raises ValueError."""
    from xml.etree import ElementTree

    try:
        entries = ElementTree.fromstring(text)
    except ElementTree.ParseError as cause:
        raise ValueError(str(cause)) from cause
    found: dict[str, Any] = {}
    for entry in entries:
        parts = {part.tag: (part.text or "").strip() for part in entry}
        found[entry.tag] = {**parts, "data": parts.get("data", "").split()} if parts else (entry.text or "").strip()
    return found
