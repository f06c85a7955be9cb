"""The intrinsic parameters that ROS, Kalibr, COLMAP and OpenCV files share, and helpers to read and write them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from startrack.camera import Camera, Decentring
from startrack.camera.io import camera_from_dict
from startrack.camera.uncertainty import cap_grid
from startrack.core.types import BadInput

FISHEYE_COEFFICIENTS = 4
SMALL_ANGLE_DEG = 1e-3  # of an image circle within any lens


@dataclass(frozen=True)
class Intrinsics:
    """A camera by numbers: pixel (0, 0) is the centre of the first pixel; `k` is None for a pinhole."""

    size_px: tuple[int, int]
    focal_px: tuple[float, float]
    centre_px: tuple[float, float]
    k: tuple[float, ...] | None

    @property
    def matrix(self) -> list[float]:
        """Camera matrix K (9,), row by row."""
        (fx, fy), (cx, cy) = self.focal_px, self.centre_px
        return [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]

    @classmethod
    def from_matrix(cls, size_px: tuple[int, int], matrix: list[float], k: tuple[float, ...] | None) -> Intrinsics:
        """The numbers of a camera matrix (9,), row by row. Raises ValueError if it is skewed."""
        fx, skew, cx, _, fy, cy, *_ = matrix
        if skew:
            raise ValueError("a skewed camera matrix has no counterpart")
        return cls(size_px, (fx, fy), (cx, cy), k)

    def coefficients(self, count: int) -> list[float]:
        """The coefficients of a fisheye, or `count` zeros of a pinhole."""
        return [0.0] * count if self.k is None else list(self.k)


def intrinsics_of(camera: Camera) -> Intrinsics:
    """The camera's numbers, its decentring left out.

    Raises BadInput bad_calibration for a mirrored camera and for a lens that these formats do not have.
    """
    if camera.mirrored:
        raise BadInput(
            "bad_calibration",
            "the camera is mirrored, which no other program's format can express: flip the images left to right and "
            "calibrate those",
        )
    distortion = camera.lens.opencv_coefficients
    if distortion is None:
        raise BadInput("bad_calibration", f"no other program's format has the {camera.lens.model} lens")
    model, coefficients = distortion
    fx, fy, cx, cy = (float(v) for v in (*camera.focal_px, *camera.centre_px))
    return Intrinsics(camera.size_px, (fx, fy), (cx, cy), None if model == "pinhole" else coefficients)


def decentring_rms_px(camera: Camera) -> float:
    """RMS difference [px] over the calibrated cap to the camera without decentring, the best rotation removed."""
    grid = cap_grid(camera.calibrated_angle_rad)
    centred = replace(camera, decentring=Decentring())
    difference = (camera.project(grid)[0] - centred.project(grid)[0]).reshape(-1)
    rotation = centred.jacobian_px_per_rad(grid).reshape(-1, 3)
    rest = difference - rotation @ np.linalg.lstsq(rotation, difference, rcond=None)[0]
    return float(np.sqrt(np.mean(np.sum(rest.reshape(-1, 2) ** 2, axis=1))))


def camera_from_intrinsics(numbers: Intrinsics, name: str, decentring: Decentring | None = None) -> Camera:
    """A camera whose image circle ends at the frame's farthest corner, or where the radius stops rising.

    Raises BadInput bad_calibration for numbers beyond the limits of our own camera files.
    """
    keys: dict[str, Any] = {"name": name, "model": "pinhole" if numbers.k is None else "kannala_brandt"}
    keys |= {"size_px": numbers.size_px, "focal_px": numbers.focal_px, "centre_px": numbers.centre_px}
    keys |= {"k": numbers.k} if numbers.k and any(numbers.k) else {}
    keys |= {"decentring": (decentring.p1, decentring.p2)} if decentring else {}
    camera = camera_from_dict({**keys, "max_angle_deg": SMALL_ANGLE_DEG})  # the limits are checked here
    camera = replace(
        camera, max_angle_rad=camera.lens.max_invertible_rad, calibrated_angle_rad=camera.lens.max_invertible_rad
    )
    width, height = numbers.size_px
    corners = np.array([[-0.5, -0.5], [width - 0.5, -0.5], [-0.5, height - 0.5], [width - 0.5, height - 0.5]])
    edge = float(np.max(camera.angle_rad(corners)))
    return replace(camera, max_angle_rad=edge, calibrated_angle_rad=edge)


def nearest_edge_rad(camera: Camera) -> float:
    """The angle off the axis [rad] of the point of the frame's edge that is nearest to the centre.

    Raises BadInput bad_calibration if the centre is outside the frame.
    """
    (cx, cy), (width, height) = camera.centre_px, camera.size_px
    if not (-0.5 < cx < width - 0.5 and -0.5 < cy < height - 0.5):
        raise BadInput(
            "bad_calibration",
            "the centre is outside the frame: give the angle up to which the lens is calibrated, --calibrated-angle",
        )
    edges = np.array([[-0.5, cy], [width - 0.5, cy], [cx, -0.5], [cx, height - 0.5]])
    return float(np.min(camera.angle_rad(edges)))


def read_numbers(values: Any, count: int, key: str) -> list[float]:
    """`count` finite numbers. Raises ValueError naming the key."""
    if not isinstance(values, Sequence) or isinstance(values, str) or len(values) != count:
        raise ValueError(f"{key} must be {count} numbers")
    numbers = [float(v) for v in values]
    if not all(map(math.isfinite, numbers)):
        raise ValueError(f"{key} must be {count} finite numbers")
    return numbers


def read_distortion(
    model: str, coefficients: Any, fisheyes: tuple[str, ...], pinholes: tuple[str, ...]
) -> tuple[float, ...] | None:
    """k1 to k4 of a fisheye `model`, None for a pinhole without distortion. Raises ValueError for any other."""
    if model in fisheyes:
        return tuple(read_numbers(coefficients, FISHEYE_COEFFICIENTS, "distortion coefficients"))
    if model not in pinholes:
        raise ValueError(f"the distortion model {model!r} has no counterpart")
    if any(float(c) for c in coefficients):
        raise ValueError(f"distortion {model} with coefficients other than 0 has no counterpart; fisheye models have")
    return None


def read_yaml(text: str) -> dict[str, Any]:
    """The mapping of a YAML file. Raises ValueError if there is none."""
    import yaml

    try:
        value = yaml.safe_load(text)
    except (yaml.YAMLError, RecursionError) as cause:
        raise ValueError(str(cause)) from cause
    if not isinstance(value, dict):
        raise ValueError("no keys")
    return value


def yaml_list(values: list[float]) -> str:
    """A list in one line of YAML, numbers to the last digit."""
    return "[" + ", ".join(_yaml_number(v) for v in values) + "]"


def _yaml_number(value: float) -> str:
    """YAML needs a point in a number with an exponent."""
    text = repr(float(value))
    mantissa, exponent, power = text.partition("e")
    return mantissa + (".0" if exponent and "." not in mantissa else "") + exponent + power
