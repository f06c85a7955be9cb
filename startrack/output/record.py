"""Results as plain dictionaries, ready for JSON: fix, identification, detection. The keys are a public format."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from startrack import __version__
from startrack.frames import format_utc, heading_pitch_roll_from_R_body_enu, latlon_from_enu, quat_xyzw_from_R
from startrack.types import Array, Exposure, Fix

if TYPE_CHECKING:
    from startrack.result import Result
    from startrack.terrain import Terrain

FORMATS = {
    "fix": "startrack.fix/1",
    "identification": "startrack.identification/1",
    "detection": "startrack.detection/1",
}
STAGES = ("read", "detect", "identify", "attitude", "evidence", "locate")
ARCSEC_PER_RAD = 648_000 / np.pi


def result_dict(result: Result) -> dict[str, Any]:
    """The fix of one image: `position` where the status is ok, `modes` where there are any.

    A refused result holds its status, reason and message and whatever was known by then; `null` stands for what was
    not. Fields in `enu` are absent where terrain or time were not known.
    """
    d = _head("fix", result)
    if result.fix is not None and result.terrain is not None:
        if result.status == "ok":
            d["position"] = _position(result.fix, result.terrain)
        d["modes"] = [{"east_m": m.east_m, "north_m": m.north_m, "weight": m.weight} for m in result.fix.modes]
    return d | _attitude(result) | _tail(result)


def identification_dict(result: Result) -> dict[str, Any]:
    """Attitude, the camera that was used and the matches: stars with the positions measured for them."""
    from startrack.camera.io import camera_to_dict

    d = _head("identification", result) | _attitude(result)
    if result.camera is not None:
        d["camera"] = camera_to_dict(result.camera)
    d["matches"] = []
    if result.identification is not None and result.detections is not None and result.stars is not None:
        xy_px = result.detections.xy_px[result.identification.detection].tolist()
        hips = result.stars.hip[result.identification.star].tolist()
        d["matches"] = [{"hip": hip or None, "x_px": x, "y_px": y} for hip, (x, y) in zip(hips, xy_px, strict=True)]
    return d | _tail(result)


def detection_dict(result: Result) -> dict[str, Any]:
    """The point sources, brightest first; fluxes are in ADU where the gain is not known."""
    d = _head("detection", result)
    d["detections"] = []
    found = result.detections
    if found is not None:
        rows = zip(found.xy_px.tolist(), found.flux_e.tolist(), found.snr.tolist(), strict=True)
        d["detections"] = [{"x_px": x, "y_px": y, "flux_e": flux, "snr": snr} for (x, y), flux, snr in rows]
    return d | _tail(result)


def record_of(result: Result, kind: str) -> dict[str, Any]:
    """The record of a kind, as its file is named (NAME.KIND.json): fix, identification or detections."""
    return {"fix": result_dict, "identification": identification_dict, "detections": detection_dict}[kind](result)


def refused_dict(image: str, reason: str, message: str, kind: str = "fix") -> dict[str, Any]:
    """The result of an image that could not even be read, or whose camera or terrain could not."""
    return {
        "format": FORMATS[kind],
        "image": Path(image).name,
        "status": "refused",
        "reason": reason,
        "message": message,
    }


def R_body_enu(result: Result) -> Array | None:
    """Rotation (3, 3) from enu to the rover's body, or None where attitude, terrain or time are not known."""
    if result.attitude is None or result.camera is None or result.R_enu_icrs is None:
        return None
    return np.asarray(result.camera.R_body_cam @ result.attitude.R_cam_icrs @ result.R_enu_icrs.T)


def boresight_rad(R_cam_icrs: Array) -> tuple[float, float, float]:
    """Right ascension in [0, 2 pi), declination, and roll in [0, 2 pi) [rad].

    Roll is the position angle of the image's top (-y of cam) at the boresight, from north through east. Near a
    celestial pole right ascension and roll are weak, as all such angles are; the quaternion is not.
    """
    up, ahead = -R_cam_icrs[1], R_cam_icrs[2]
    ra = np.arctan2(ahead[1], ahead[0])
    dec = np.arctan2(ahead[2], np.hypot(ahead[0], ahead[1]))
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    north = np.array([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)])
    roll = np.arctan2(up @ east, up @ north)
    return _within_a_turn(float(ra)), float(dec), _within_a_turn(float(roll))


def place_m(fix: Fix) -> tuple[float, float]:
    """East and north of the position, or of the likeliest place where several fit [m]."""
    if fix.ambiguous:
        return fix.modes[0].east_m, fix.modes[0].north_m
    return float(fix.position_enu_m[0]), float(fix.position_enu_m[1])


def lens_errors_known(result: Result) -> bool:
    """Whether the attitude's covariance holds the errors of the lens: the camera says what they are."""
    return result.camera is not None and result.camera.covariance is not None


def predicted_visible(result: Result) -> int:
    """How many stars whose light was measured stand above the fix's skyline; 0 without a fix."""
    if result.fix is None or result.light is None or result.terrain is None:
        return 0
    light = result.light
    horizon = result.terrain.horizon_rad(np.array([place_m(result.fix)]), light.azimuth_rad)
    return int((light.usable & (light.elevation_rad > horizon)).sum())


def image_name(exposure: Exposure) -> str:
    """The image's file name, or its stem where it never was a file."""
    return Path(exposure.path).name or exposure.name


def _head(kind: str, result: Result) -> dict[str, Any]:
    return {
        "format": FORMATS[kind],
        "image": image_name(result.exposure),
        "status": result.status,
        "reason": result.reason,
        "message": result.message,
    }


def _within_a_turn(angle_rad: float) -> float:
    turned = angle_rad % (2 * np.pi)
    # A tiny negative angle leaves the modulo as 2 pi itself.
    return turned if turned < 2 * np.pi else 0.0


def _position(fix: Fix, terrain: Terrain) -> dict[str, Any]:
    east, north, up = fix.position_enu_m.tolist()
    latitude, longitude = latlon_from_enu(terrain.site, east, north, up)
    return {
        "frame": "enu",
        "terrain": terrain.name,
        "east_m": east,
        "north_m": north,
        "up_m": up,
        "covariance_m2": fix.covariance_m2.tolist(),
        "radius95_m": fix.radius95_m,
        "radius999_m": fix.radius999_m,
        "latitude_deg": float(np.degrees(latitude)),
        "longitude_deg": float(np.degrees(longitude)),
    }


def _attitude(result: Result) -> dict[str, Any]:
    attitude = result.attitude
    if attitude is None:
        return {}
    ra, dec, roll = np.degrees(boresight_rad(attitude.R_cam_icrs)).tolist()
    d = {
        "quat_xyzw_cam_icrs": quat_xyzw_from_R(attitude.R_cam_icrs).tolist(),
        "ra_deg": ra,
        "dec_deg": dec,
        "roll_deg": roll,
        "sigma_arcsec": (np.sqrt(np.diag(attitude.covariance_rad2)) * ARCSEC_PER_RAD).tolist(),
        "lens_error_included": lens_errors_known(result),
    }
    body = R_body_enu(result)
    if body is not None:
        heading, pitch, roll_body = np.degrees(heading_pitch_roll_from_R_body_enu(body)).tolist()
        d["quat_xyzw_body_enu"] = quat_xyzw_from_R(body).tolist()
        d |= {"heading_deg": heading, "pitch_deg": pitch, "roll_body_deg": roll_body}
    return {"attitude": d}


def _tail(result: Result) -> dict[str, Any]:
    found, fit, exposure = result.identification, result.attitude_fit, result.exposure
    time_utc = exposure.time_utc
    return {
        "stars": {
            "detected": 0 if result.detections is None else len(result.detections),
            "identified": 0 if found is None else len(found),
            "unexplained": None if found is None else found.unexplained,
            "predicted_visible": None if result.terrain is None else predicted_visible(result),
            "rms_px": None if fit is None else fit.rms_px,
            "false_alarm_probability": None if found is None else found.false_alarm_probability,
        },
        "timing_ms": {stage: round(result.timing_ms.get(stage, 0.0), 3) for stage in STAGES},
        "provenance": {
            "version": __version__,
            "image_sha256": exposure.sha256,
            "camera": exposure.camera or (result.camera.name if result.camera is not None else None),
            "terrain": exposure.terrain or (result.terrain.name if result.terrain is not None else None),
            "catalog": result.catalog_name or None,
            "time_utc": None if time_utc is None else format_utc(time_utc),
            "exposure_s": exposure.exposure_s,
        },
        "warnings": result.warnings,
    }
