"""The numbers that all formats share, and what none of them can hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from startrack.camera import Camera, Decentring, KannalaBrandt, Pinhole
from startrack.camera.uncertainty import cap_grid
from startrack.types import BadInput

COEFFICIENTS = 4


@dataclass(frozen=True)
class Plain:
    """A lens by numbers: pixel (0, 0) is the centre of the first pixel; `k` is None for a pinhole."""

    size_px: tuple[int, int]
    focal_px: tuple[float, float]
    centre_px: tuple[float, float]
    k: tuple[float, ...] | None

    @property
    def matrix(self) -> list[float]:
        """K, row by row."""
        (fx, fy), (cx, cy) = self.focal_px, self.centre_px
        return [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]


def plain(camera: Camera) -> Plain:
    """The camera's numbers. Raises BadInput for a mirrored camera; of decentring see `centred`."""
    if camera.mirrored:
        raise BadInput(
            "bad_calibration",
            "the camera is mirrored, which no other program's format can say: flip the images left to right and "
            "calibrate those",
        )
    k = None if camera.lens.model == "pinhole" else (*camera.lens.k, *(COEFFICIENTS * (0.0,)))[:COEFFICIENTS]
    fx, fy, cx, cy = (float(v) for v in (*camera.focal_px, *camera.centre_px))
    return Plain(camera.size_px, (fx, fy), (cx, cy), k)


def centred(camera: Camera) -> Camera:
    """The camera without its decentring, for formats that have none."""
    return replace(camera, decentring=Decentring())


def lost_px(camera: Camera) -> float:
    """RMS [px] over the calibrated cap by which `centred` differs, once the attitude has adapted."""
    grid = cap_grid(camera.calibrated_angle_rad)
    bare = centred(camera)
    difference = (camera.project(grid)[0] - bare.project(grid)[0]).reshape(-1)
    turn = bare.jacobian_px_per_rad(grid).reshape(-1, 3)
    rest = difference - turn @ np.linalg.lstsq(turn, difference, rcond=None)[0]
    return float(np.sqrt(np.mean(np.sum(rest.reshape(-1, 2) ** 2, axis=1))))


def camera_from(numbers: Plain, name: str, decentring: Decentring | None = None) -> Camera:
    """A camera of ours: its image circle ends at the frame's corner, or where the polynomial turns back."""
    if min(*numbers.focal_px, *numbers.size_px) <= 0 or not np.isfinite([*numbers.matrix, *(numbers.k or ())]).all():
        raise BadInput("bad_calibration", "image size and focal lengths must be positive, and all numbers finite")
    lens: Any = Pinhole() if numbers.k is None else KannalaBrandt(numbers.k if any(numbers.k) else ())
    camera = Camera(
        name=name,
        size_px=numbers.size_px,
        focal_px=numbers.focal_px,
        centre_px=numbers.centre_px,
        max_angle_rad=lens.max_invertible_rad,
        calibrated_angle_rad=lens.max_invertible_rad,
        lens=lens,
        decentring=decentring or Decentring(),
    )
    width, height = numbers.size_px
    corners = np.array([[-0.5, -0.5], [width - 0.5, -0.5], [-0.5, height - 0.5], [width - 0.5, height - 0.5]])
    edge = float(np.max(camera.angle_rad(corners)))
    return replace(camera, max_angle_rad=edge, calibrated_angle_rad=edge)


def unreadable(program: str, cause: object) -> BadInput:
    """The refusal of a file that is not what it should be."""
    return BadInput("bad_calibration", f"not a {program} camera file that can be used: {cause}")


def numbers(values: Any, count: int, what: str) -> list[float]:
    """`count` numbers. Raises ValueError naming what is wrong."""
    if not isinstance(values, Sequence) or isinstance(values, str) or len(values) != count:
        raise ValueError(f"{what} must be {count} numbers")
    return [float(v) for v in values]


def no_other_distortion(coefficients: list[float], model: str) -> None:
    """Raise ValueError unless a pinhole's distortion is nil: ours has none."""
    if any(coefficients):
        raise ValueError(f"distortion {model} with coefficients other than 0 has no counterpart; fisheye models have")
