"""Camera files (TOML): read, check and write. The format is in docs/formats.md."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from startrack.camera.camera import ZENITH_MOUNT_R_BODY_CAM, Camera, Lens, Sensor
from startrack.camera.decentring import Decentring
from startrack.camera.kannala_brandt import KannalaBrandt
from startrack.camera.pinhole import Pinhole
from startrack.files import resolve_named
from startrack.frames import R_from_quat_xyzw, quat_xyzw_from_R
from startrack.types import BadInput

FORMAT = 1
KEYS = {
    "format", "name", "model", "size_px", "focal_px", "centre_px", "k", "max_angle_deg", "calibrated_angle_deg",
    "mirrored", "decentring", "mount", "sensor", "covariance",
}  # fmt: skip
KINDS = {str: "text", bool: "truth value (true or false)", list: "list", dict: "table"}
T = TypeVar("T")


def load_camera(name_or_path: str | Path) -> Camera:
    """The camera of a file (a path if it ends in .toml or contains a separator) or of a shipped name.

    Raises BadInput no_calibration where there is no such file, bad_calibration where it cannot be used.
    """
    path = resolve_named(name_or_path, "calib", "no_calibration")
    try:
        return camera_from_dict(tomllib.loads(path.read_text(encoding="utf-8")), default_name=path.stem)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as cause:
        raise BadInput("bad_calibration", f"{path}: not a TOML file: {cause}") from cause
    except BadInput as cause:
        raise BadInput(cause.reason, f"{path}: {cause}") from cause


def save_camera(camera: Camera, path: str | Path) -> None:
    """Write the camera file; `load_camera` gives the same camera back."""
    Path(path).write_text(camera_text(camera), encoding="utf-8")


def camera_text(camera: Camera) -> str:
    """The camera file as text."""
    import tomli_w

    return tomli_w.dumps(camera_to_dict(camera))


def camera_from_dict(d: dict[str, Any], default_name: str = "camera") -> Camera:
    """The camera of a camera file's keys. Raises BadInput bad_calibration naming the key that is wrong."""
    if d.get("format", FORMAT) != FORMAT:
        raise BadInput("bad_calibration", f"format {d['format']!r} is not known; this version reads format {FORMAT}")
    _refuse_misspelt(d)
    focal = tuple(_numbers(d, "focal_px", 2))
    width, height = _numbers(d, "size_px", 2)
    if min(focal) <= 0 or min(width, height) < 1 or width % 1 or height % 1:
        raise BadInput("bad_calibration", "focal_px must be positive and size_px positive whole numbers")
    lens = _lens(d)
    max_angle, calibrated = _angles(d, lens)
    order, covariance = _covariance(_table(d, "covariance"))
    return Camera(
        name=_typed(d, "name", str, default_name),
        size_px=(int(width), int(height)),
        focal_px=(focal[0], focal[1]),
        centre_px=tuple(_numbers(d, "centre_px", 2)),  # type: ignore[arg-type]
        max_angle_rad=max_angle,
        calibrated_angle_rad=calibrated,
        lens=lens,
        mirrored=_typed(d, "mirrored", bool, False),
        decentring=Decentring(*_numbers(d, "decentring", 2)) if "decentring" in d else Decentring(),
        R_body_cam=_mount(_table(d, "mount")),
        sensor=_sensor(_table(d, "sensor")) if "sensor" in d else None,
        covariance_order=order,
        covariance=covariance,
    )


def camera_to_dict(camera: Camera) -> dict[str, Any]:
    """The camera file's keys of a camera."""
    d: dict[str, Any] = {
        "format": FORMAT,
        "name": camera.name,
        "model": camera.lens.model,
        "size_px": [int(n) for n in camera.size_px],
        "focal_px": [float(f) for f in camera.focal_px],
        "centre_px": [float(c) for c in camera.centre_px],
    }
    if camera.lens.model == "kannala_brandt":
        d["k"] = [float(k) for k in camera.lens.k]
    d |= {
        "max_angle_deg": float(np.degrees(camera.max_angle_rad)),
        "calibrated_angle_deg": float(np.degrees(camera.calibrated_angle_rad)),
        "mirrored": camera.mirrored,
    }
    if camera.decentring:
        d["decentring"] = [float(camera.decentring.p1), float(camera.decentring.p2)]
    if not np.array_equal(camera.R_body_cam, ZENITH_MOUNT_R_BODY_CAM):
        d["mount"] = {"quat_xyzw_body_cam": [float(q) for q in quat_xyzw_from_R(camera.R_body_cam)]}
    if camera.sensor is not None:
        d["sensor"] = {**vars(camera.sensor), "vignetting": list(camera.sensor.vignetting)}
    if camera.covariance is not None:
        d["covariance"] = {"order": list(camera.covariance_order), "matrix": camera.covariance.tolist()}
    return d


def _lens(d: dict[str, Any]) -> Lens:
    model = d.get("model", "kannala_brandt")
    if model == "pinhole":
        return Pinhole()
    if model != "kannala_brandt":
        raise BadInput("bad_calibration", f"model {model!r} is not known: kannala_brandt or pinhole")
    k = tuple(_numbers(d, "k")) if "k" in d else ()
    if len(k) > 4:
        raise BadInput("bad_calibration", f"k has {len(k)} coefficients; at most k1..k4")
    return KannalaBrandt(k)


def _sensor(d: dict[str, Any]) -> Sensor:
    known = set(Sensor.__dataclass_fields__)
    unknown = set(d) - known
    if unknown:
        raise BadInput("bad_calibration", f"[sensor] has unknown keys: {', '.join(sorted(unknown))}")
    values: dict[str, Any] = {key: _number(d, key) for key in d if key != "vignetting"}
    if "vignetting" in d:
        values["vignetting"] = tuple(_numbers(d, "vignetting", 2))
    if "zero_point_e_per_s" not in values:
        raise BadInput("bad_calibration", "[sensor] needs zero_point_e_per_s")
    for key in ("zero_point_e_per_s", "gain_e_per_adu", "psf_sigma_px", "saturation_adu"):
        if values.get(key, 1.0) <= 0:
            raise BadInput("bad_calibration", f"[sensor] {key} must be positive, not {values[key]:g}")
    for key in ("read_noise_e", "dark_e_per_s"):
        if values.get(key, 0.0) < 0:
            raise BadInput("bad_calibration", f"[sensor] {key} must not be negative")
    return Sensor(**values)


def _angles(d: dict[str, Any], lens: Lens) -> tuple[float, float]:
    """max_angle and calibrated_angle [rad]."""
    max_angle = np.radians(_number(d, "max_angle_deg"))
    if not 0 < max_angle <= np.pi:
        raise BadInput("bad_calibration", f"max_angle_deg must be between 0 and 180, not {d['max_angle_deg']!r}")
    if max_angle > lens.max_invertible_rad + 1e-9:
        limit = np.degrees(lens.max_invertible_rad)
        raise BadInput("bad_calibration", f"max_angle_deg: the lens polynomial only rises to {limit:.2f} degrees")
    calibrated = np.radians(_number(d, "calibrated_angle_deg", np.degrees(max_angle)))
    if calibrated <= 0:
        raise BadInput("bad_calibration", f"calibrated_angle_deg must be positive, not {d['calibrated_angle_deg']!r}")
    return float(max_angle), float(min(calibrated, max_angle))


def _mount(d: dict[str, Any]) -> np.ndarray:
    if "quat_xyzw_body_cam" not in d:
        return ZENITH_MOUNT_R_BODY_CAM
    q = np.array(_numbers(d, "quat_xyzw_body_cam", 4))
    if abs(np.linalg.norm(q) - 1) > 1e-3:
        raise BadInput("bad_calibration", "mount.quat_xyzw_body_cam is not a unit quaternion")
    return R_from_quat_xyzw(q)


def _covariance(d: dict[str, Any]) -> tuple[tuple[str, ...], np.ndarray | None]:
    if not d:
        return (), None
    order = tuple(str(name) for name in _typed(d, "order", list, []))
    try:
        matrix = np.array(d.get("matrix"), dtype=np.float64)
    except (TypeError, ValueError) as cause:
        raise BadInput("bad_calibration", "[covariance] matrix is not a matrix of numbers") from cause
    if matrix.shape != (len(order), len(order)) or not np.isfinite(matrix).all():
        raise BadInput(
            "bad_calibration", f"[covariance] matrix must hold {len(order)} x {len(order)} numbers, as its order says"
        )
    return order, matrix


def _refuse_misspelt(d: dict[str, Any]) -> None:
    """Other programs' keys are ignored; what is almost one of ours is a slip that must not pass in silence."""
    from difflib import get_close_matches

    for key in sorted(set(d) - KEYS):
        if meant := get_close_matches(key.lower(), KEYS, n=1, cutoff=0.8):
            raise BadInput("bad_calibration", f"{key} is not a key of camera files: is {meant[0]} meant?")


def _typed(d: dict[str, Any], key: str, kind: type[T], default: T) -> T:
    value = d.get(key, default)
    if not isinstance(value, kind):
        raise BadInput("bad_calibration", f"{key} must be a {KINDS[kind]}, not {value!r}")
    return value


def _table(d: dict[str, Any], key: str) -> dict[str, Any]:
    return _typed(d, key, dict, {})


def _number(d: dict[str, Any], key: str, default: float | None = None) -> float:
    value = d.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise BadInput("bad_calibration", f"{key} must be a number, not {value!r}")
    return float(value)


def _numbers(d: dict[str, Any], key: str, count: int | None = None) -> list[float]:
    values = d.get(key)
    if not isinstance(values, list) or (count is not None and len(values) != count):
        raise BadInput("bad_calibration", f"{key} must be a list of {count or 'some'} numbers, not {values!r}")
    return [_number({key: v}, key) for v in values]
