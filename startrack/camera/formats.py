"""Camera files of other programs: their texts from a camera, and our own file's keys from them.

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
from startrack.camera.platepar import plate_in, read_platepar
from startrack.core.types import BadInput
from startrack.frames import ORTHONORMAL_1, quat_xyzw_from_R

MAX_YAML_CHARS = 2**18  # the loader takes 3 s for 2^20
Coefficients = tuple[float, ...] | None  # of a fisheye; None of a pinhole
ROS_FILE_ARRAYS = {
    "k": "camera_matrix", "d": "distortion_coefficients", "r": "rectification_matrix", "p": "projection_matrix",
}  # fmt: skip
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


class Part(NamedTuple):
    """A camera in a file of another program: its name there, the size of its pictures as text, and its content."""

    name: str
    size: str
    content: Any


def matrix_of(camera: Camera) -> list[float]:
    """Camera matrix K (9,), row by row."""
    (fx, fy), (cx, cy) = camera.focal_px, camera.centre_px
    return [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]


def keys_of(
    size_px: Sequence[Any], focal_px: tuple[float, float], centre_px: tuple[float, float], k: Coefficients
) -> dict[str, Any]:
    """Keys of a camera file: size, focal lengths, centre [px], and coefficients `k` of the lens (None: a pinhole)."""
    keys = {"size_px": tuple(map(int, size_px)), "focal_px": focal_px, "centre_px": centre_px}
    if k is None:
        return {**keys, "model": Pinhole.model}
    return {**keys, "model": KannalaBrandt.model, **({"k": k} if any(k) else {})}


def read_numbers(values: Any, count: int, key: str) -> list[float]:
    """List of `count` finite numbers that a `key` holds. Raises ValueError naming the key."""
    if not isinstance(values, Sequence) or isinstance(values, str) or len(values) != count:
        raise ValueError(f"{key} must be {count} numbers")
    numbers = [float(v) for v in values]
    if not all(map(math.isfinite, numbers)):
        raise ValueError(f"{key} must be {count} finite numbers")
    return numbers


def read_distortion(
    model: str, coefficients: Any, fisheyes: tuple[str, ...], pinholes: tuple[str, ...]
) -> tuple[float, ...] | None:
    """Coefficients k1 to k4 of a fisheye `model`, None for a pinhole without distortion; else raises ValueError."""
    if model in fisheyes:
        return tuple(read_numbers(coefficients, MAX_COEFFICIENTS, "distortion coefficients"))
    if model not in pinholes:
        raise ValueError(f"the distortion model {model!r} has no counterpart")
    if any(float(c) for c in coefficients):
        raise ValueError(f"distortion {model} with coefficients other than 0 has no counterpart; fisheye models have")
    return None


def read_yaml(text: str) -> list[dict[str, Any]]:
    """The mappings of a YAML file, one of each document that is not empty. Raises ValueError if there is none."""
    import yaml

    class Loader(yaml.SafeLoader):
        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):  # a few of them are a file of any size
                raise yaml.YAMLError("aliases (*name) are not read")
            return super().compose_node(parent, index)

    if len(text) > MAX_YAML_CHARS:
        raise ValueError(f"more than {MAX_YAML_CHARS // 2**10} KiB")
    try:
        found = [value for value in yaml.load_all(text, Loader) if value is not None]
    except (yaml.YAMLError, RecursionError) as cause:
        raise ValueError(str(cause)) from cause
    if not found or not all(isinstance(value, dict) for value in found):
        raise ValueError("no keys")
    return found


def yaml_list(values: Sequence[float]) -> str:
    """Text of a list in one line of YAML, numbers to the last digit."""
    import yaml

    return str(yaml.safe_dump([float(v) for v in values], default_flow_style=True, width=math.inf)).strip()


def read_xml(text: str) -> dict[str, Any]:
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


def write_ros(camera: Camera, k: Coefficients) -> str:
    """Text of a camera_info file (camera_calibration_parsers): equidistant for fisheyes, plumb_bob for pinholes."""
    model, coefficients = ("plumb_bob", (0.0,) * 5) if k is None else ("equidistant", k)
    (fx, fy), (cx, cy) = camera.focal_px, camera.centre_px
    name = json.dumps(camera.name, ensure_ascii=False)  # a JSON string is one of YAML
    return (
        f"image_width: {camera.size_px[0]}\nimage_height: {camera.size_px[1]}\ncamera_name: {name}\n"
        f"camera_matrix:\n  rows: 3\n  cols: 3\n  data: {yaml_list(matrix_of(camera))}\n"
        f"distortion_model: {model}\n"
        f"distortion_coefficients:\n  rows: 1\n  cols: {len(coefficients)}\n  data: {yaml_list(coefficients)}\n"
        "rectification_matrix:\n  rows: 3\n  cols: 3\n  data: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]\n"
        "projection_matrix:\n  rows: 3\n  cols: 4\n"
        f"  data: {yaml_list([fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0])}\n"
    )


def split_ros(text: str) -> list[Part]:
    """Cameras of a camera_info file, or of messages printed from a topic, whose keys ROS 1 writes in capitals.

    Names are their numbers; the message's header does not count.
    """
    found = []
    for number, document in enumerate(read_yaml(text), 1):
        d = {str(key).lower(): value for key, value in document.items() if key != "header"}
        if "camera_matrix" in d:
            for key, name in ROS_FILE_ARRAYS.items():
                if name in d:
                    d[key] = d.pop(name)["data"]
            d["width"], d["height"] = d.pop("image_width"), d.pop("image_height")
        found.append(Part(str(number), f"{d['width']} x {d['height']}", d))
    return found


def read_ros(d: dict[str, Any], _angle_rad: float | None) -> dict[str, Any]:
    """Keys of a camera file from a camera_info `d`, whose width, height and matrix are of the whole sensor.

    Region of interest, then binning, are applied: the centre of a binned pixel is between those of the sensor's.
    """
    coefficients = read_distortion(
        d["distortion_model"], d["d"], ("equidistant", "fisheye"), ("plumb_bob", "rational_polynomial")
    )
    fx, skew, cx, _, fy, cy, *_ = read_numbers(d["k"], 9, "camera matrix")
    if skew:
        raise ValueError("a skewed camera matrix has no counterpart")
    size = np.array([int(d["width"]), int(d["height"])])
    roi = d.get("roi") or {}
    start, window = ([int(roi.get(key, 0)) for key in keys] for keys in (("x_offset", "y_offset"), ("width", "height")))
    window = window if any(window) else size.tolist()  # 0: the whole sensor
    by = [max(int(d.get(key, 0)), 1) for key in ("binning_x", "binning_y")]  # 0: none
    if min(start) < 0 or min(window) < 1 or (np.add(start, window) > size).any():
        raise ValueError(f"roi {window[0]} x {window[1]} at {start[0]}, {start[1]} is not within the sensor")
    centre_px = (np.array([cx, cy]) - start + 0.5) / by - 0.5
    picture = np.array(window) // by
    notes = []
    if max(by) > 1 or (picture != size).any():
        notes.append(
            f"binning {by[0]} x {by[1]} and region of interest {window[0]} x {window[1]} at {start[0]}, {start[1]} are "
            f"applied: the camera is of pictures of {picture[0]} x {picture[1]} px"
        )
    r, p = read_numbers(d.get("r", np.eye(3).ravel().tolist()), 9, "r"), d.get("p")
    shift = [] if p is None else read_numbers(p, 12, "p")[3::4]
    if (any(r) and not np.array_equal(np.reshape(r, (3, 3)), np.eye(3))) or any(shift):
        notes.append("the rectification of a stereo camera (r, p) is left out: the camera is of pictures as taken")
    keys = keys_of(picture.tolist(), (fx / by[0], fy / by[1]), (float(centre_px[0]), float(centre_px[1])), coefficients)
    return keys | {"name": str(d.get("camera_name") or ""), "notes": tuple(notes)}


class Format(NamedTuple):
    """The format of one program's camera files.

    `write` takes a camera and the coefficients of its fisheye, None for a pinhole; None where a file holds a pointing
    too. `split` finds the cameras of a text; `read` gives, from the content of one and from the calibrated angle [rad]
    (None: not stated), the keys of our own camera file, beside them `R_body_cam` where there is a mount and `notes` on
    what was chosen or left out, and no angles. Both raise ValueError, LookupError, TypeError or AttributeError.
    """

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
    """Text of a camchain of one camera, cam0: equidistant distortion for fisheyes; the mount as T_cam_imu."""
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
    """Keys of a camera file from one camera `d` of a camchain."""
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
    """Text of a cameras.txt of one camera: PINHOLE, OPENCV_FISHEYE, or THIN_PRISM_FISHEYE for a decentred lens."""
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
    """Keys of a camera file from the words after the number in a line of cameras.txt."""
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
    """Text of OpenCV's FileStorage in YAML, with the keys of its calibration program.

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
    """Keys of a camera file from the entries `d` of a FileStorage."""
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


FOREIGN_FORMATS = {  # by the names of PROGRAMS in startrack.core.file_kinds
    "ros": Format(write_ros, split_ros, read_ros),
    "kalibr": Format(_write_kalibr, _split_kalibr, _read_kalibr),
    "colmap": Format(_write_colmap, _split_colmap, _read_colmap),
    "opencv": Format(_write_opencv, _split_opencv, _read_opencv),
    "platepar": Format(None, _split_platepar, read_platepar),
}
