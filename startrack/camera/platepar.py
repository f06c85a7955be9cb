"""The platepar of the Raspberry Meteor Station (RMS): lens, pointing and site of a camera at a time, written and read.

RMS's model (github.com/CroatianMeteorNetwork/RMS, RMS/Astrometry/CyFunctions.pyx): from the distortion centre the
radius r of a pixel, in half widths of the frame, becomes r + k1 r^3 + k2 r^5 + k3 r^7 (+ k4 r^9), which is the angle
off the axis times `F_scale` [px/deg]. From the sky to pixels the law is r - k1 r^3 - ..., r that angle, with numbers of
its own, which are not read. `radialN-odd` and `radialN-all` have such a radius, `poly3+radial...` add polynomials of
the place from the frame's middle. Pixel (0, 0) is the centre of the first pixel.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np

from startrack.camera.camera import (
    REFRACTION_CONTAINED,
    REFRACTION_REMOVED,
    Camera,
    cap_grid,
    lens_jacobian,
    require_not_mirrored,
    with_update,
)
from startrack.core.types import Array, BadInput
from startrack.frames import R_enu_icrs, R_from_rotvec, Site, azel_from_rays, length_xy, seconds_since_2000

RADIAL_POWERS = {  # of RMS's distortion types, in the radius
    "radial3-all": (2, 3), "radial4-all": (2, 3, 4), "radial5-all": (2, 3, 4, 5), "radial3-odd": (3,),
    "radial5-odd": (3, 5), "radial7-odd": (3, 5, 7), "radial9-odd": (3, 5, 7, 9),
}  # fmt: skip
USUAL, FULL = "radial7-odd", "radial9-odd"  # RMS's default; and where it is not the lens to USUAL_PX
USUAL_PX = 0.1  # largest error: 5 % more than the 0.3 px of a meteor's centroid alone
MAX_PLATEPAR_PX = 0.5  # largest error of RMS's model against the lens; a centroid of a meteor has 0.3 or so
FITTED_RAYS = 2000
RIGHT_PX = 10.0  # from the axis to the pixel that shows its rotation above the horizon
J2000_DAYS, DAY_S, CENTURY_DAYS = 2451545.0, 86400.0, 36525.0
SIDEREAL_DEG = 280.46061837, 360.98564736629  # at J2000, and a day: Meeus, Astronomical Algorithms, ch. 12
FOCAL_EQUAL_1 = 1e-9  # relative difference of fx and fy
RMS_PHOTOMETRY = {"mag_0": -2.5, "mag_lev": 1.0, "mag_lev_stddev": 0.0, "gamma": 1.0, "vignetting_coeff": 0.001,
                  "vignetting_fixed": True, "extinction_scale": 0.6}  # fmt: skip
POLYNOMIAL_TERMS = {"poly3+radial": 12, "poly3+radial3": 13, "poly3+radial5": 14}
MAX_TERMS = 14
GRID_COLUMNS = 50  # of the pixels whose directions are fitted
FIT_STEPS = 6  # of Gauss-Newton: the fourth moves no pixel by 1e-6 px


@dataclass(frozen=True)
class Platepar:
    """Text of a platepar, with the errors of RMS's polynomials against the lens within the calibrated angle."""

    text: str
    kind: str  # RMS's distortion type
    to_sky_px: float  # largest error of a pixel's direction, in pixels on the axis
    to_image_px: float  # largest error of a direction's pixel


def platepar_of(camera: Camera, R_cam_icrs: Array, time: datetime, site: Site) -> Platepar:
    """The platepar of a `camera` with the attitude `R_cam_icrs` (3, 3) at a `time` and a `site` on the Earth.

    Raises BadInput bad_calibration for a mirrored camera, and where RMS's polynomials differ from the lens by more than
    MAX_PLATEPAR_PX; no_time outside the years of the ephemeris.
    """
    require_not_mirrored(camera)
    kind, lens = USUAL, _fit_lens(camera, len(RADIAL_POWERS[USUAL]))
    if not max(lens.to_sky_px, lens.to_image_px) <= USUAL_PX:
        kind, lens = FULL, _fit_lens(camera, len(RADIAL_POWERS[FULL]))
    to_sky_px, to_image_px = lens.to_sky_px, lens.to_image_px
    if not max(to_sky_px, to_image_px) <= MAX_PLATEPAR_PX:
        raise BadInput(
            "bad_calibration",
            f"RMS's {kind} differs from the lens by up to {max(to_sky_px, to_image_px):.2f} px within "
            f"{np.degrees(camera.calibrated_angle_rad):.1f} degrees of the axis (allowed are {MAX_PLATEPAR_PX:g}): no "
            "platepar of this lens is of use",
        )
    width, height = camera.size_px
    aspect = camera.focal_px[0] / camera.focal_px[1] - 1.0
    has_aspect, has_asymmetry = abs(aspect) > FOCAL_EQUAL_1, bool(camera.decentring)
    x_fwd, x_rev = (_rms_row(camera, p, [aspect] if has_aspect else []) for p in (lens.forward, lens.reverse))
    zeros = [0.0] * len(x_fwd)
    values: dict[str, Any] = {
        "version": 2, "station_code": "None", "lat": float(np.degrees(site.latitude_rad)),
        "lon": float(np.degrees(site.longitude_rad)), "elev": site.height_m, "X_res": width, "Y_res": height,
        "F_scale": float(np.radians(camera.focal_px[0])), "UT_corr": 0, **_fields_of_view_deg(camera),
        **_pointing(camera, lens.R_axis_cam @ np.asarray(R_cam_icrs, dtype=float), time, site),
        "distortion_type": kind, "poly_length": len(x_fwd), "equal_aspect": not has_aspect,
        "force_distortion_centre": False, "asymmetry_corr": has_asymmetry, "x_poly": x_fwd, "y_poly": zeros,
        "x_poly_fwd": x_fwd, "x_poly_rev": x_rev, "y_poly_fwd": zeros, "y_poly_rev": zeros, "refraction": False,
        "measurement_apparent_to_true_refraction": camera.refraction == REFRACTION_REMOVED,
        "auto_check_fit_refined": False, "auto_recalibrated": False, "star_list": [], **RMS_PHOTOMETRY,
    }  # fmt: skip
    return Platepar(json.dumps(values, indent=4, sort_keys=True) + "\n", kind, to_sky_px, to_image_px)


@dataclass(frozen=True)
class _RmsLens:
    """RMS's model nearest to a lens, (n,) for each way: shift [half widths], asymmetry (2 numbers each), k1, k2, ..."""

    R_axis_cam: Array  # (3, 3) to the camera about RMS's axis
    forward: Array
    reverse: Array
    to_sky_px: float
    to_image_px: float


def _fit_lens(camera: Camera, terms: int) -> _RmsLens:
    """RMS's model of a lens with so many `terms` k1, k2, ..., by least squares over the calibrated angle.

    RMS has no decentring. For a decentred lens its axis, centre and asymmetry are free, which leaves a fifth of the
    difference.
    """
    from scipy.optimize import least_squares

    rays = cap_grid(min(camera.calibrated_angle_rad, camera.lens.max_invertible_rad), FITTED_RAYS)
    px, inside = camera.project(rays)
    rays, fx, half = rays[inside], camera.focal_px[0], camera.size_px[0] / 2
    image = (px[inside] - np.array(camera.centre_px)) * [1.0, fx / camera.focal_px[1]] / half
    free = np.array([bool(camera.decentring)] * 4 + [True] * terms)

    def wide(p: Array, start: int = 0) -> Array:
        """All parameters (n,), from the free ones in `p` from `start` on."""
        full = np.zeros(len(free))
        full[free] = p[start:]
        return full

    def sky(rotation: Array) -> Array:
        """Equidistant positions (rays, 2) [half widths] about the axis turned by `rotation` (2,) [rad]."""
        turned = rays @ R_from_rotvec([*rotation, 0.0]).T
        off_axis = length_xy(turned[:, 0], turned[:, 1])
        angle = np.arctan2(off_axis, turned[:, 2]) / np.where(off_axis > 0, off_axis, 1.0)
        return angle[:, None] * turned[:, :2] * fx / half

    def to_sky(p: Array) -> Array:
        full = wide(p, 2)
        return (_bent(image - full[:2], full, 1.0) - sky(p[:2] * bool(camera.decentring))).ravel()

    first = least_squares(to_sky, np.zeros(2 + free.sum()))
    rotation = first.x[:2] * bool(camera.decentring)
    there = sky(rotation)
    second = least_squares(lambda p: (_bent(there, wide(p), -1.0) + wide(p)[:2] - image).ravel(), np.zeros(free.sum()))
    errors = [float(np.hypot(*fit.fun.reshape(-1, 2).T).max() * half) for fit in (first, second)]
    return _RmsLens(R_from_rotvec([*rotation, 0.0]), wide(first.x, 2), wide(second.x), *errors)


def _bent(xy: Array, parameters: Array, sign: float) -> Array:
    """Positions (n, 2) [half widths] times 1 + `sign` (k1 r^2 + k2 r^4 + ...), r the radius with its asymmetry."""
    radius = length_xy(xy[:, 0], xy[:, 1]) + xy[:, ::-1] @ parameters[2:4]
    powers = 2 * np.arange(1, len(parameters) - 3)
    return np.asarray(xy * (1.0 + sign * (radius[:, None] ** powers) @ parameters[4:])[:, None])


def _rms_row(camera: Camera, parameters: Array, aspect: list[float]) -> list[float]:
    """The numbers of RMS's x_poly: centre, aspect and asymmetry where they are in use, k1, k2, ..."""
    (width, height), half = camera.size_px, camera.size_px[0] / 2
    x = camera.centre_px[0] + half * parameters[0]
    y = camera.centre_px[1] + half * parameters[1] * camera.focal_px[1] / camera.focal_px[0]
    by_y, by_x = parameters[2:4]  # amplitude times cosine, and minus sine, of an angle in turns
    asymmetry = [np.hypot(by_x, by_y), np.arctan2(-by_x, by_y) / (2 * np.pi) % 1.0] if camera.decentring else []
    return [float(v) for v in (2 * x / width - 1.0, 2 * y / height - 1.0, *aspect, *asymmetry, *parameters[4:])]


def _fields_of_view_deg(camera: Camera) -> dict[str, float]:
    """Angles [deg] across the middle row and column, by RMS's names, at most those of the image circle."""
    (width, height), (cx, cy) = camera.size_px, camera.centre_px
    ends = np.array([[-0.5, cy], [width - 0.5, cy], [cx, -0.5], [cx, height - 0.5]])
    left, right, top, bottom = np.minimum(np.degrees(camera.angle_rad(ends)), np.degrees(camera.max_angle_rad)).tolist()
    return {"fov_h": left + right, "fov_v": top + bottom}


def _pointing(camera: Camera, R_cam_icrs: Array, time: datetime, site: Site) -> dict[str, float]:
    """Values by RMS's names: the axis among the stars and above the horizon, and the time [deg, days].

    RMS takes RA_d and dec_d as those of the date, and turns them to J2000 by its own precession and nutation.
    """
    days = seconds_since_2000(time) / DAY_S
    R_j2000_date, R_precession = _rms_precession(days)
    axis = R_cam_icrs[2]
    of_date = axis @ R_j2000_date
    north_cam = R_cam_icrs @ _tangents(axis)[1]
    position_angle = np.arctan2(north_cam[1], north_cam[0]) + 0.5 * np.pi
    turned = np.cross(of_date, axis)  # RMS carries this direction along, and compares its angles to the parallels
    change = _angle_to_parallel(R_precession @ turned, axis) - _angle_to_parallel(turned, of_date)
    centuries = days / CENTURY_DAYS
    sidereal_deg = SIDEREAL_DEG[0] + SIDEREAL_DEG[1] * days + 0.000387933 * centuries**2 - centuries**3 / 38710000.0
    R_cam_enu = R_cam_icrs @ R_enu_icrs(site, time).T
    azimuth, elevation = azel_from_rays(R_cam_enu[2])
    right = azel_from_rays(camera.unproject(np.add(camera.centre_px, (RIGHT_PX, 0.0))) @ R_cam_enu)
    turn = np.arctan2(right[1] - elevation, (right[0] - azimuth + np.pi) % (2 * np.pi) - np.pi)
    ra, dec = np.arctan2(of_date[1], of_date[0]), np.arctan2(of_date[2], np.hypot(of_date[0], of_date[1]))
    angles = {
        "RA_d": ra % (2 * np.pi), "dec_d": dec, "pos_angle_ref": (position_angle - change) % (2 * np.pi),
        "az_centre": azimuth % (2 * np.pi), "alt_centre": elevation, "rotation_from_horiz": turn,
    }  # fmt: skip
    degrees = {name: float(np.degrees(angle)) for name, angle in angles.items()}
    return {"JD": J2000_DAYS + days, "Ho": sidereal_deg % 360.0, **degrees}


def _tangents(ray: Array) -> tuple[Array, Array]:
    """Directions (3,), (3,) of the parallel (to the east) and the meridian (to the north) at a `ray` (3,)."""
    ra = np.arctan2(ray[1], ray[0])  # 0 at a pole, as in RMS
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    return east, np.cross(ray, east)


def _angle_to_parallel(direction: Array, ray: Array) -> float:
    """Angle [rad] about a `ray` (3,) from a `direction` (3,) to the parallel there."""
    east, _ = _tangents(ray)
    return float(np.arctan2(np.cross(direction, east) @ ray, direction @ east))


def _rms_precession(days: float) -> tuple[Array, Array]:
    """Rotation (3, 3) of RMS to J2000 from the date that is `days` after it, and its part (3, 3) by precession.

    IAU 1976 precession, and the low-precision nutation of Meeus, Astronomical Algorithms, ch. 22, which RMS applies as
    rotations about x and z: up to 20 arcsec from the true equinox, so that our own rotation would not do.
    """
    import erfa

    zeta, z, tilt = erfa.prec76(J2000_DAYS, days, J2000_DAYS, 0.0)
    R_precession = erfa.rz(-z, erfa.ry(tilt, erfa.rz(-zeta, np.eye(3))))
    t = days / CENTURY_DAYS
    node, sun, moon = np.radians([
        125.04452 - 1934.136261 * t, 280.4665 + 36000.7698 * t, 218.3165 + 481267.8813 * t,
    ])  # fmt: skip
    longitude = -17.2 * np.sin(node) - 1.32 * np.sin(2 * sun) - 0.23 * np.sin(2 * moon) + 0.21 * np.sin(2 * node)
    obliquity = 9.2 * np.cos(node) + 0.57 * np.cos(2 * sun) + 0.1 * np.cos(2 * moon) - 0.09 * np.cos(2 * node)
    about_x = erfa.rx(np.radians(obliquity / 3600), np.eye(3))
    about_z = erfa.rz(-np.radians(longitude / 3600), np.eye(3))
    return about_z @ about_x @ R_precession, R_precession


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
    lens, largest_px, rms_px = _fit_to_plate(
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
    """Function from places (n, 2) [px] about the middle to equidistant positions (n, 2) [px], by radial distortion."""
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
    """Function from places (n, 2) [px] about the middle to equidistant positions (n, 2) [px], by polynomials."""
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


def _fit_to_plate(
    start: Camera, px: Array, place: Array, order: tuple[str, ...], *, free_axis: bool
) -> tuple[Camera, float, float]:
    """Camera whose pixels are nearest to `px` (n, 2) for equidistant positions `place` (n, 2) [rad]; its errors [px].

    The errors are the largest and the RMS one. Gauss-Newton steps from the camera `start` in the parameters of `order`
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
