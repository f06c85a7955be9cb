"""Functions that compute the output quantities from the values of the pipeline, and texts of some of them."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from startrack.camera import Camera, lens_jacobian
from startrack.catalog import catalog_rays
from startrack.chain import Detected, Identified, Located, Measured, Oriented, Positioned
from startrack.core.files import is_path
from startrack.core.statistics import error_ellipse
from startrack.core.types import MIDDLES_RAD, Array, Fix, Sectors
from startrack.estimation.lens_correction import smooth_shifts
from startrack.frames import R_from_rotvec, heading_pitch_roll_from_R_body_enu, latlon_from_enu
from startrack.terrain import Terrain

ARCSEC_PER_RAD = 648_000 / np.pi
SMALLEST_CHANCE = 1e-100  # smaller probabilities are beyond the models that they come from
WIDE_TAIL = 5.0  # the ratio of the circles of 99.9 and 95 %; a normal distribution has 1.5
DOMINANT = 3.0  # times the circle that a stated fact gives: the line of the terminal names it
ROTATION_STEP_RAD = 1e-5  # of the numerical derivative of heading, pitch and roll
HALF_STEP_PX = 0.5  # of the numerical derivative of the sky by pixels
_predicted_visible: WeakKeyDictionary[Located, int] = WeakKeyDictionary()
At = Callable[[str], Any]  # from the path of a quantity to its value, None where it is not known


class Angle(float):
    """An angle [deg] whose formatted text never reads 360."""

    def __format__(self, spec: str) -> str:
        text = format(float(self), spec)
        return format(0.0, spec) if text == format(360.0, spec) else text


def has_position(value: Any) -> bool:
    """Whether a `value` of the pipeline states a position: the only one that fits."""
    return isinstance(value, Positioned) and not value.fix.ambiguous


def horizon_at_fix(value: Positioned, azimuth_rad: Array) -> Array:
    """Elevation (n,) of the horizon at azimuths (n,) [rad], at the position of a `value`, or the likeliest of several.

    That is where the skyline is compared with the evidence.
    """
    at_m = value.fix.compared_at_m
    if value.fix.ambiguous:
        at_m = np.array([value.fix.modes[0].east_m, value.fix.modes[0].north_m])
    return value.terrain.horizon_rad(at_m[None], azimuth_rad)


def boresight_rad(R_cam_icrs: Array) -> tuple[float, float, float]:
    """Right ascension in [0, 2 pi), declination, and roll in [0, 2 pi) [rad] of the camera with `R_cam_icrs` (3, 3).

    Roll is the position angle of the image's top (-y of cam) at the boresight, from north through east. Near a
    celestial pole right ascension and roll are poorly determined; the quaternion is not.
    """
    ra, dec, (east, north) = sky_axes(R_cam_icrs[2])
    return ra, dec, turn_rad(-R_cam_icrs[1] @ east, -R_cam_icrs[1] @ north)


def sky_axes(ray_icrs: Array) -> tuple[float, float, Array]:
    """Right ascension in [0, 2 pi) and declination [rad] of a direction (3,), unit vectors (2, 3) east and north."""
    ra, dec = turn_rad(ray_icrs[1], ray_icrs[0]), float(np.arctan2(ray_icrs[2], np.hypot(ray_icrs[0], ray_icrs[1])))
    return ra, dec, np.array([
        [-np.sin(ra), np.cos(ra), 0.0], [-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)],
    ])  # fmt: skip


def turn_rad(y: float, x: float) -> float:
    """The angle of the point (x, y) in [0, 2 pi) [rad]."""
    angle = float(np.arctan2(y, x) % (2 * np.pi))
    return angle if angle < 2 * np.pi else 0.0  # a tiny negative angle leaves the modulo as 2 pi itself


def carrying_azimuths(value: Positioned) -> list[list[float]] | None:
    """First and last azimuth [deg] of the groups of directions that carry the fix of a `value`, the strongest first."""
    if value.fix.integrity is None:
        return None
    first, width = np.degrees(value.fix.integrity.first_azimuth_rad), 360.0 / len(value.fix.integrity.part)
    return [[float(first[g]), float(first[g] + width)] for g in value.fix.integrity.carriers()]


def R_body_enu(value: Measured) -> Array:
    """Rotation (3, 3) from enu to the rover's body, of a measured `value`."""
    return np.asarray(value.camera.R_body_cam @ value.R_cam_enu)


def body_sigmas_deg(value: Measured) -> Array:
    """Standard deviations (3,) of heading, pitch and roll [deg] of a measured `value`.

    From the covariance C of rotations about the camera's axes, J C J^T with the numerical derivative J of the three
    angles. C is the attitude's among the stars, and the turn of the stars by the error of the clock. Not meaningful
    where the nose points to the zenith: heading and roll are then one angle.
    """
    angles = [
        np.array(heading_pitch_roll_from_R_body_enu(value.camera.R_body_cam @ R_from_rotvec(step) @ value.R_cam_enu))
        for axis in np.eye(3) * ROTATION_STEP_RAD
        for step in (axis, -axis)
    ]
    change = (np.stack(angles[::2]) - np.stack(angles[1::2]) + np.pi) % (2 * np.pi) - np.pi
    jacobian = change.T / (2 * ROTATION_STEP_RAD)
    clock = value.fix.clock if isinstance(value, Located) else None
    by_clock = value.R_cam_enu @ value.clock.turn_rad_s * (value.clock.sigma_s if clock is None else clock.sigma_s)
    covariance = value.attitude.covariance_rad2 + np.outer(by_clock, by_clock)
    return np.degrees(np.sqrt(np.diag(jacobian @ covariance @ jacobian.T)))


def predicted_visible(value: Located) -> int:
    """Number of stars of a located `value` that were measured and are above the skyline of the fix."""
    if value not in _predicted_visible:  # horizons of a height map take time, and several outputs need this number
        light = value.photometry
        is_above = light.elevation_rad > horizon_at_fix(value, light.azimuth_rad)
        _predicted_visible[value] = int((light.usable & is_above).sum())
    return _predicted_visible[value]


def file_or_name(reference: str | None, used: Camera | Terrain | None) -> str | None:
    """A camera's or terrain's `reference`, a file as an absolute path, or the name of the one that was `used`."""
    if not reference:
        return None if used is None else used.name
    folder, name = os.path.split(reference)
    return os.path.join(os.path.realpath(folder), name) if is_path(reference) else reference


def chance_text(probability: float) -> str:
    """A `probability` as text; below 1e-100 the models behind it do not hold."""
    return f"{probability:.0e}" if probability >= SMALLEST_CHANCE else f"below {SMALLEST_CHANCE:.0e}"


def boresight_deg(axis: int) -> Callable[[Oriented], float]:
    """Right ascension, declination or roll (`axis` 0 to 2) of the camera [deg]."""
    return lambda v: float(np.degrees(boresight_rad(v.attitude.R_cam_icrs)[axis]))


def body_deg(axis: int) -> Callable[[Measured], float]:
    """Heading, pitch or roll (`axis` 0 to 2) of the rover [deg]."""
    return lambda v: float(np.degrees(heading_pitch_roll_from_R_body_enu(R_body_enu(v))[axis]))


def latlon_deg(axis: int) -> Callable[[Positioned], float]:
    """Latitude or longitude (`axis` 0, 1) of the position [deg]."""
    return lambda v: float(np.degrees(latlon_from_enu(v.site, *v.fix.position_enu_m)[axis]))


def ellipse(at: At) -> tuple[float, float, float] | None:
    """Semi-axes [m] of one sigma, the larger first, and the azimuth of the larger one in [0, 180) [deg]."""
    covariance = at("position.covariance_m2")
    if covariance is None:
        return None
    major_m, minor_m, azimuth_rad = error_ellipse(np.asarray(covariance, dtype=float))
    return float(major_m), float(minor_m), float(np.degrees(azimuth_rad))


def wide_tail_m(at: At) -> float | None:
    """The radius of the 99.9 % circle, where it is more than WIDE_TAIL times that of 95 %; else None."""
    radius95_m, radius999_m = at("position.radius95_m"), at("position.radius999_m")
    is_wide = radius95_m is not None and radius999_m is not None and radius999_m > WIDE_TAIL * radius95_m
    return float(radius999_m) if is_wide else None


def lacking_circle(at: At) -> str | None:
    """A text where a position has no circle."""
    return "no circle" if at("position.east_m") is not None and at("position.radius95_m") is None else None


def caution_text(at: At) -> str | None:
    """What a reader must know of a position of a method without a posterior; None of other positions."""
    parts = ("approximate" if at("position.search") == "approximate" else None, at("position.lacking"))
    return ", ".join(part for part in parts if part) or None


def sigma_m(at: At, axis: int) -> float | None:
    """Standard deviation of east or north (`axis` 0, 1) [m]."""
    covariance = at("position.covariance_m2")
    return None if covariance is None else float(np.sqrt(covariance[axis][axis]))


def modes_record(fix: Fix) -> list[dict[str, Any]]:
    """The modes of a `fix` as JSON values; a circle is null where none is stated."""
    keys = ("east_m", "north_m", "weight", "radius95_m", "radius999_m")
    return [{key: at if np.isfinite(at := getattr(mode, key)) else None for key in keys} for mode in fix.modes]


def mode_text(mode: dict[str, Any]) -> str:
    """Position of a `mode` of a record, with its circle."""
    radius_m = mode.get("radius95_m")
    circle = "" if radius_m is None else f" ±{radius_m:.1f} m (95 %)"
    return f"E {mode['east_m']:.1f} m N {mode['north_m']:.1f} m{circle}"


def modes_text(modes: list[dict[str, Any]]) -> str:
    """Every mode of a record with its probability."""
    return "; ".join(f"{mode_text(mode)}, probability {100 * mode['weight']:.0f} %" for mode in modes)


def exact_lens_text(included: bool) -> str:
    """Text for a sigma of the attitude that lacks the lens, because the camera has no covariance."""
    return "" if included else ", the lens taken as exact"


def off_map(value: Positioned) -> Sectors:
    """The azimuths in which ground off the maps could stand above their skyline at the position of `value`."""
    return sectors_off_map(value.terrain, value.fix.compared_at_m)


def sectors_off_map(terrain: Terrain, position_m: Array) -> Sectors:
    """The azimuths in which ground off the maps could stand above the horizon of a `terrain` at `position_m` (2,)."""
    horizon_rad = np.ravel(terrain.horizon_rad(np.asarray(position_m)[None], MIDDLES_RAD))
    return Sectors(np.where(terrain.unknown_below_rad(MIDDLES_RAD) > horizon_rad, 1.0, 0.0))


def ranges_deg(sectors: Sectors | None) -> list[list[float]]:
    """Ranges [from, to] of azimuth [deg] of the `sectors`; none of None."""
    ranges = [] if sectors is None else sectors.ranges_rad
    return [[round(float(edge), 6) for edge in np.degrees(one)] for one in ranges]


def dominant_fact(at: At) -> str | None:
    """The fact that widens the 99.9 % circle by more than three times, and the circle without it."""
    unstated, radius_m = at("position.unstated"), at("position.radius999_m")
    if not unstated or radius_m is None or not radius_m > DOMINANT * unstated[0]["radius999_m_if_exact"]:
        return None
    return f"{unstated[0]['radius999_m_if_exact']:.1f} m if {unstated[0]['fact']} were stated and exact"


def ranges_text(ranges: list[list[float]]) -> str:
    """The `ranges` of azimuth [deg] in words; empty where there are none."""
    return ", ".join(f"{start:.0f}° to {end:.0f}°" for start, end in ranges)


def bodies_record(value: Oriented) -> list[dict[str, Any]]:
    """Name, magnitude and predicted pixel of the planets, Sun, Moon and Earth of a `value` that lie in the frame."""
    rays_icrs = np.array([body.ray_icrs for body in value.bodies]).reshape(-1, 3)
    xy_px, inside = value.camera.project(rays_icrs @ value.attitude.R_cam_icrs.T)
    return [
        {"name": body.name, "v_mag": body.v_mag, "x_px": x, "y_px": y}
        for body, (x, y), is_inside in zip(value.bodies, xy_px.tolist(), inside, strict=True)
        if is_inside
    ]


def matches_record(value: Identified) -> list[dict[str, Any]]:
    """The identified stars of a `value`, each with the position measured for it."""
    named = value.names.stars
    columns = (value.stars.hip[named.star].tolist(), named.xy_px.tolist(), named.saturated.tolist())
    return [
        {"hip": hip or None, "x_px": x, "y_px": y, "saturated": saturated}
        for hip, (x, y), saturated in zip(*columns, strict=True)
    ]


def sources_record(value: Detected) -> list[dict[str, float]]:
    """The point sources of a `value`, brightest first; fluxes are in ADU where the gain is not known."""
    found = value.detections
    columns = zip(found.xy_px.tolist(), found.flux_e.tolist(), found.snr.tolist(), strict=True)
    return [{"x_px": x, "y_px": y, "flux_e": flux, "snr": snr} for (x, y), flux, snr in columns]


@dataclass(frozen=True)
class Middle:
    """Direction (ICRS, as in the catalogue: without aberration and refraction) at a picture's middle pixel."""

    ra_rad: float  # in [0, 2 pi)
    dec_rad: float
    sigma_rad: float  # standard deviation per axis
    scale_rad_per_px: float  # geometric mean of the two axes
    rotation_rad: float  # position angle of image up, from north through east, in [0, 2 pi)


def middle_px(value: Oriented) -> Array:
    """The middle (2,) of a picture; pixel centres are at integers."""
    return 0.5 * (np.array(value.camera.size_px) - 1.0)


def has_middle(value: Any) -> bool:
    """Whether a `value` of the pipeline has an attitude and a lens that shows the picture's middle."""
    if not isinstance(value, Oriented):
        return False
    camera = value.camera
    return bool(camera.angle_rad(middle_px(value)) < min(camera.max_angle_rad, camera.lens.max_invertible_rad))


def sky_at_middle(value: Oriented) -> Middle:
    """The sky at the middle of the picture of a `value` that has one.

    The error is that of attitude and lens together, with their correlation: of a lens fitted to the picture's own stars
    they nearly cancel.
    """
    camera, middle = value.camera, middle_px(value)
    step = HALF_STEP_PX * np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    rays_cam = camera.unproject(middle + step)
    here, right, left, below, above = catalog_rays(
        rays_cam @ value.attitude.R_cam_icrs, value.exposure.time_utc, value.site
    )
    ra, dec, axes = sky_axes(here)
    by_px = axes @ np.stack([right - left, below - above], axis=1) / (2.0 * HALF_STEP_PX)
    up = -by_px[:, 1]
    covariance = by_px @ covariance_px2(value, rays_cam[0]) @ by_px.T
    return Middle(
        ra_rad=ra,
        dec_rad=dec,
        sigma_rad=float(np.sqrt(0.5 * np.trace(covariance))),
        scale_rad_per_px=float(np.sqrt(abs(np.linalg.det(by_px)))),
        rotation_rad=turn_rad(up[0], up[1]),
    )


def covariance_px2(value: Oriented, ray_cam: Array) -> Array:
    """Covariance (2, 2) [px^2] of the pixel at which a `value`'s camera and attitude place a direction.

    `ray_cam` (3,) is that direction.
    """
    camera, fit = value.camera, value.attitude_fit
    by_turn = camera.jacobian_px_per_rad(ray_cam)
    covariance = by_turn @ value.attitude.covariance_rad2 @ by_turn.T
    if camera.covariance is not None:
        by_lens = lens_jacobian(camera, ray_cam, camera.covariance_order)
        mixed = by_turn @ fit.covariance_with_lens @ by_lens.T
        covariance = covariance + by_lens @ camera.covariance @ by_lens.T + mixed + mixed.T
        if fit.misfit is not None:  # what attitude and lens do not follow
            here = smooth_shifts(camera, camera.project_unlimited(ray_cam[None]))[0] @ fit.misfit.displacement_px
            follows = by_turn @ fit.misfit.turn_rad + by_lens @ fit.misfit.lens
            covariance = covariance + here @ here.T - here @ follows.T - follows @ here.T
    return np.asarray(covariance)


def in_middle(part: str, per_unit: float) -> Callable[[Oriented], float]:
    """The `part` of the sky at the middle, times `per_unit`, of a value that has one."""
    return lambda value: float(getattr(sky_at_middle(value), part) * per_unit)
