"""Results as plain dictionaries, ready for JSON: fix, identification, detection. The keys are a public format."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from startrack import __version__
from startrack.frames import format_utc, heading_pitch_roll_from_R_body_enu, latlon_from_enu, quat_xyzw_from_R
from startrack.stages import (
    STAGES,
    Detected,
    Identified,
    Inputs,
    Located,
    Measured,
    Oriented,
    Outcome,
    reached,
)  # fmt: skip
from startrack.types import Array, Exposure, Fix

FORMATS = {
    "fix": "startrack.fix/1",
    "identification": "startrack.identification/1",
    "detection": "startrack.detection/1",
}
ARCSEC_PER_RAD = 648_000 / np.pi


def result_dict(result: Outcome) -> dict[str, Any]:
    """The fix of one image: `position` where the status is ok, `modes` where there are any.

    A refused result holds its status, reason and message and whatever was known by then; `null` stands for what was
    not. Fields in `enu` are absent where terrain or time were not known.
    """
    d = _head("fix", result)
    value = reached(result)
    if isinstance(value, Located):
        if not value.fix.ambiguous:
            d["position"] = _position(value)
        d["modes"] = [{"east_m": m.east_m, "north_m": m.north_m, "weight": m.weight} for m in value.fix.modes]
    return d | _attitude(result) | _tail(result)


def identification_dict(result: Outcome) -> dict[str, Any]:
    """Attitude, the camera that was used and the matches: stars with the positions measured for them."""
    from startrack.camera.io import camera_to_dict

    value = reached(result)
    d = _head("identification", result) | _attitude(result)
    if value.camera is not None:
        d["camera"] = camera_to_dict(value.camera)
    d["matches"] = []
    if isinstance(value, Identified):
        xy_px = value.detections.xy_px[value.identification.detection].tolist()
        hips = value.stars.hip[value.identification.star].tolist()
        d["matches"] = [{"hip": hip or None, "x_px": x, "y_px": y} for hip, (x, y) in zip(hips, xy_px, strict=True)]
    return d | _tail(result)


def detection_dict(result: Outcome) -> dict[str, Any]:
    """The point sources, brightest first; fluxes are in ADU where the gain is not known."""
    d = _head("detection", result)
    d["detections"] = []
    value = reached(result)
    if isinstance(value, Detected):
        found = value.detections
        rows = zip(found.xy_px.tolist(), found.flux_e.tolist(), found.snr.tolist(), strict=True)
        d["detections"] = [{"x_px": x, "y_px": y, "flux_e": flux, "snr": snr} for (x, y), flux, snr in rows]
    return d | _tail(result)


def record_of(result: Outcome, kind: str) -> dict[str, Any]:
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


def R_body_enu(value: Measured) -> Array:
    """Rotation (3, 3) from enu to the rover's body."""
    return np.asarray(value.camera.R_body_cam @ value.R_cam_enu)


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


def lens_errors_known(value: Oriented) -> bool:
    """Whether the attitude's covariance holds the errors of the lens: the camera says what they are."""
    return value.camera.covariance is not None


def predicted_visible(value: Inputs) -> int:
    """How many stars whose light was measured stand above the fix's skyline; 0 without a fix."""
    if not isinstance(value, Located):
        return 0
    light = value.light
    horizon = value.terrain.horizon_rad(np.array([place_m(value.fix)]), light.azimuth_rad)
    return int((light.usable & (light.elevation_rad > horizon)).sum())


def image_name(exposure: Exposure) -> str:
    """The image's file name, or its stem where it never was a file."""
    return Path(exposure.path).name or exposure.name


def _head(kind: str, result: Outcome) -> dict[str, Any]:
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


def _position(value: Located) -> dict[str, Any]:
    fix = value.fix
    east, north, up = fix.position_enu_m.tolist()
    latitude, longitude = latlon_from_enu(value.site, east, north, up)
    return {
        "frame": "enu",
        "terrain": value.terrain.name,
        "east_m": east,
        "north_m": north,
        "up_m": up,
        "covariance_m2": fix.covariance_m2.tolist(),
        "radius95_m": fix.radius95_m,
        "radius999_m": fix.radius999_m,
        "latitude_deg": float(np.degrees(latitude)),
        "longitude_deg": float(np.degrees(longitude)),
    }


def _attitude(result: Outcome) -> dict[str, Any]:
    value = reached(result)
    if not isinstance(value, Oriented):
        return {}
    attitude = value.attitude
    ra, dec, roll = np.degrees(boresight_rad(attitude.R_cam_icrs)).tolist()
    d = {
        "quat_xyzw_cam_icrs": quat_xyzw_from_R(attitude.R_cam_icrs).tolist(),
        "ra_deg": ra,
        "dec_deg": dec,
        "roll_deg": roll,
        "sigma_arcsec": (np.sqrt(np.diag(attitude.covariance_rad2)) * ARCSEC_PER_RAD).tolist(),
        "lens_error_included": lens_errors_known(value),
    }
    if isinstance(value, Measured):
        body = R_body_enu(value)
        heading, pitch, roll_body = np.degrees(heading_pitch_roll_from_R_body_enu(body)).tolist()
        d["quat_xyzw_body_enu"] = quat_xyzw_from_R(body).tolist()
        d |= {"heading_deg": heading, "pitch_deg": pitch, "roll_body_deg": roll_body}
    return {"attitude": d}


def _tail(result: Outcome) -> dict[str, Any]:
    value, exposure = reached(result), result.exposure
    found = value.identification if isinstance(value, Identified) else None
    fit = value.attitude_fit if isinstance(value, Oriented) else None
    time_utc = exposure.time_utc
    return {
        "stars": {
            "detected": len(value.detections) if isinstance(value, Detected) else 0,
            "identified": 0 if found is None else len(found),
            "unexplained": None if found is None else found.unexplained,
            "predicted_visible": None if value.terrain is None else predicted_visible(value),
            "rms_px": None if fit is None else fit.rms_px,
            "false_alarm_probability": None if found is None else found.false_alarm_probability,
        },
        "timing_ms": {stage: round(result.timing_ms.get(stage, 0.0), 3) for stage in STAGES},
        "provenance": {
            "version": __version__,
            "image_sha256": exposure.sha256,
            "camera": exposure.camera or (value.camera.name if value.camera is not None else None),
            "terrain": exposure.terrain or (value.terrain.name if value.terrain is not None else None),
            "catalog": value.catalog_name or None,
            "time_utc": None if time_utc is None else format_utc(time_utc),
            "exposure_s": exposure.exposure_s,
        },
        "warnings": result.warnings,
    }
