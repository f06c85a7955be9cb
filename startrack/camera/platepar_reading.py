"""The lens of a platepar of the Raspberry Meteor Station (RMS), as keys of our own camera file.

RMS's models (github.com/CroatianMeteorNetwork/RMS, RMS/Astrometry/CyFunctions.pyx, cyXYToRADec) turn a pixel into an
equidistant position, whose length is the angle off the axis times `F_scale` [px/deg]. `radialN-odd` and `radialN-all`
scale the place from the distortion centre by a polynomial of the radius in half widths of the frame; `poly3+radial...`
add polynomials of the place from the frame's middle. RMS fits the way back apart; it is not read.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from startrack.camera.camera import Camera, lens_jacobian, with_update
from startrack.camera.io import REFRACTION_CONTAINED, REFRACTION_REMOVED
from startrack.camera.platepar import MAX_PLATEPAR_PX, RADIAL_POWERS
from startrack.core.types import Array
from startrack.frames import R_from_rotvec, length_xy

POLYNOMIAL_TERMS = {"poly3+radial": 12, "poly3+radial3": 13, "poly3+radial5": 14}
MAX_TERMS = 14
GRID_COLUMNS = 50  # of the pixels whose directions are fitted
FIT_STEPS = 6  # of Gauss-Newton: the fourth moves no pixel by 1e-6 px


@np.errstate(all="ignore")  # of absurd numbers: the fit fails
def read_platepar(plate: Mapping[str, Any], calibrated_angle_rad: float | None) -> dict[str, Any]:
    """Keys of a camera file from the values of a `plate`; `notes` state the largest error and what is left out.

    The lens is fitted to RMS's directions of the frame's pixels up to `calibrated_angle_rad` off the axis, None: to the
    edge of the frame that is nearest to it. Raises ValueError if they differ by more than MAX_PLATEPAR_PX.
    """
    kind = str(plate.get("distortion_type", "poly3+radial"))
    if kind not in RADIAL_POWERS and kind not in POLYNOMIAL_TERMS:
        known = ", ".join((*POLYNOMIAL_TERMS, *RADIAL_POWERS))
        raise ValueError(f"the distortion_type {kind!r} has no counterpart: known are {known}")
    width, height = int(_number(plate, "X_res")), int(_number(plate, "Y_res"))
    if not (2 <= width <= 2**16 and 2 <= height <= 2**16):
        raise ValueError(f"X_res and Y_res are {width} and {height}")
    scale_px = math.degrees(_number(plate, "F_scale"))  # per radian
    if not scale_px > 0:
        raise ValueError(f"F_scale is {plate['F_scale']}: it must be above 0")
    plane_of = _polynomial(plate, kind) if kind in POLYNOMIAL_TERMS else _radial(plate, kind, width, height)

    def position(px: Array) -> Array:
        """Equidistant positions (n, 2) [rad] of pixels (n, 2)."""
        return plane_of(px - [width / 2, height / 2]) / scale_px

    x, y = np.linspace(-0.5, width - 0.5, GRID_COLUMNS), np.linspace(-0.5, height - 0.5, GRID_COLUMNS)
    px = np.stack(np.meshgrid(x, y), axis=-1)
    place = position(px.reshape(-1, 2)).reshape(px.shape)
    angle_rad = length_xy(place[..., 0], place[..., 1])
    border = np.ones(px.shape[:2], dtype=bool)
    border[1:-1, 1:-1] = False
    if calibrated_angle_rad is None and angle_rad.min() == angle_rad[border].min():
        raise ValueError("the centre is outside the frame: give the angle of the lens's edge, --calibrated-angle")
    limit_rad = float(angle_rad[border].min()) if calibrated_angle_rad is None else calibrated_angle_rad
    within = angle_rad <= limit_rad
    if within.sum() < MAX_TERMS:
        raise ValueError(f"too small a part of the frame is within {math.degrees(limit_rad):g} degrees of the axis")
    is_bent = kind in POLYNOMIAL_TERMS or bool(plate.get("asymmetry_corr"))
    is_square = kind in RADIAL_POWERS and bool(plate.get("equal_aspect"))
    middle = px.reshape(-1, 2)[np.argmin(angle_rad)]
    start = Camera(
        name="", size_px=(width, height), focal_px=(scale_px, scale_px), centre_px=(float(middle[0]), float(middle[1])),
        max_angle_rad=np.pi, calibrated_angle_rad=np.pi,
    )  # fmt: skip
    order = *(("f",) if is_square else ("fx", "fy")), "cx", "cy", *start.lens.parameter_names
    lens, largest_px, rms_px = _fit_lens(
        start, px[within], place[within], (*order, "p1", "p2") if is_bent else order, free_axis=is_bent
    )
    up_to = f"up to {math.degrees(limit_rad):.1f} degrees off the axis"
    if not largest_px <= MAX_PLATEPAR_PX:
        raise ValueError(
            f"no lens follows its {kind} to {MAX_PLATEPAR_PX:g} px {up_to}: the best differs by up to "
            f"{largest_px:.2f} px; try a smaller --calibrated-angle"
        )
    apart = plate.get("refraction") or plate.get("measurement_apparent_to_true_refraction")
    name, bent = str(plate.get("station_code") or ""), lens.decentring
    return {
        "name": "" if name == "None" else name, "model": lens.lens.model, "size_px": (width, height),
        "focal_px": lens.focal_px, "centre_px": lens.centre_px, **lens.lens.file_values(),
        **({"decentring": (bent.p1, bent.p2)} if bent else {}),
        "refraction": REFRACTION_REMOVED if apart else REFRACTION_CONTAINED,
        "notes": (
            f"the lens follows RMS's {kind} to {largest_px:.2f} px ({rms_px:.2f} px RMS) {up_to}; its pointing, time, "
            "site and photometry are not part of a camera file",
        ),
    }  # fmt: skip


def _number(plate: Mapping[str, Any], key: str) -> float:
    """The finite number of a `key`. Raises KeyError or ValueError that names it."""
    value = float(plate[key])
    if not math.isfinite(value):
        raise ValueError(f"{key} is no finite number")
    return value


def _terms(plate: Mapping[str, Any], axis: str, count: int) -> list[float]:
    """The first `count` coefficients from pixels to the sky, 0 where there are fewer, as RMS takes them.

    The first version of platepars has no name for this direction.
    """
    key = f"{axis}_poly_fwd" if f"{axis}_poly_fwd" in plate else f"{axis}_poly"
    values = plate[key]
    if not isinstance(values, list) or not all(math.isfinite(float(v)) for v in values):
        raise ValueError(f"{key} must be finite numbers")
    return [*map(float, values[:count]), *(MAX_TERMS * (0.0,))][:count]


def _radial(plate: Mapping[str, Any], kind: str, width: int, height: int) -> Callable[[Array], Array]:
    """Equidistant positions (n, 2) [px] of places (n, 2) from the middle, by a radial distortion."""
    powers, half = RADIAL_POWERS[kind], width / 2
    has_centre, has_aspect = not plate.get("force_distortion_centre"), not plate.get("equal_aspect")
    has_asymmetry = bool(plate.get("asymmetry_corr"))
    rest = _terms(plate, "x", 2 * has_centre + has_aspect + 2 * has_asymmetry + len(powers))
    centre = np.array([0.5, 0.5])
    if has_centre:  # within the frame, whatever is stated
        frame = np.array([width, height])
        centre = (np.array([rest.pop(0), rest.pop(0)]) * frame / 2 + frame / 2) % frame - frame / 2
    stretch = np.array([1.0, 1.0 + (rest.pop(0) if has_aspect else 0.0)])
    amplitude, turns = (rest.pop(0), rest.pop(0)) if has_asymmetry else (0.0, 0.0)
    side = amplitude * np.array([-np.sin(2 * np.pi * turns), np.cos(2 * np.pi * turns)])

    def plane(place: Array) -> Array:
        xy = (place - centre) * stretch
        r = (length_xy(xy[:, 0], xy[:, 1]) + xy @ side) / half
        return np.asarray(xy * (1.0 + (r[:, None] ** (np.array(powers) - 1)) @ rest)[:, None])

    return plane


def _polynomial(plate: Mapping[str, Any], kind: str) -> Callable[[Array], Array]:
    """Equidistant positions (n, 2) [px] of places (n, 2) from the middle, by polynomials with radial terms."""
    a, b = (np.array(_terms(plate, axis, POLYNOMIAL_TERMS[kind])) for axis in "xy")

    def plane(place: Array) -> Array:
        x, y = place.T
        r = length_xy(x - a[0], y - b[0])
        both = [np.ones_like(x), x, y, x**2, x * y, y**2, x**3, x**2 * y, x * y**2, y**3]
        along = [x * r**3, x * r**5], [y * r**3, y * r**5]
        dx = np.stack([*both, x * r, y * r, *along[0]], axis=1)[:, : len(a)] @ a
        dy = np.stack([*both, y * r, x * r, *along[1]], axis=1)[:, : len(b)] @ b
        return place + np.stack([dx, dy], axis=1)

    return plane


def _fit_lens(
    start: Camera, px: Array, place: Array, order: tuple[str, ...], *, free_axis: bool
) -> tuple[Camera, float, float]:
    """The lens whose pixels are nearest to `px` (n, 2) for the equidistant positions `place` (n, 2) [rad].

    Its largest and RMS differences [px] follow. Gauss-Newton steps from the camera `start` in the parameters of `order`
    and, with `free_axis`, in a rotation, which an attitude takes up.
    """
    angle = length_xy(place[:, 0], place[:, 1])
    rays = np.column_stack([np.sinc(angle / np.pi)[:, None] * place, np.cos(angle)])
    camera = start
    for _ in range(FIT_STEPS):
        jacobian = lens_jacobian(camera, rays, order)
        if free_axis:
            jacobian = np.concatenate([jacobian, camera.jacobian_px_per_rad(rays)], axis=-1)
        flat = jacobian.reshape(2 * len(px), -1)
        length = np.linalg.norm(flat, axis=0)
        missing = (px - camera.project_unlimited(rays)).ravel()
        step = np.linalg.lstsq(flat / length, missing, rcond=None)[0] / length
        camera = with_update(camera, dict(zip(order, step.tolist(), strict=False)))
        if free_axis:
            rays = rays @ R_from_rotvec(step[-3:]).T
    off_px = length_xy(*(camera.project_unlimited(rays) - px).T)
    return camera, float(off_px.max()), float(np.sqrt(np.mean(off_px**2)))


def plate_in(text: str) -> dict[str, Any] | None:
    """The values of a platepar in JSON, the form that RMS writes; None for any other `text`."""
    if not text.lstrip().startswith("{"):
        return None
    try:
        values = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return values if isinstance(values, dict) and values.keys() >= {"F_scale", "X_res", "Y_res"} else None
