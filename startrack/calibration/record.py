"""What a calibration found, as the dictionary of its JSON file and as one line."""

from __future__ import annotations

from typing import Any

import numpy as np

from startrack import __version__
from startrack.calibration.acceptance import coverage
from startrack.calibration.photometry import photometry_dict
from startrack.calibration.run import Calibration, Refused
from startrack.camera import Camera, camera_to_dict
from startrack.frames import format_utc, quat_xyzw_from_R

FORMAT = "startrack.calibration/1"


def calibration_dict(calibration: Calibration) -> dict[str, Any]:
    """The calibration's JSON object: the camera only where every gate was passed."""
    fit, failed = calibration.joint.fit, calibration.failed
    cover = coverage(calibration.joint)
    return {
        "format": FORMAT,
        "status": "refused" if failed else "ok",
        "reason": failed[0].reason if failed else None,
        "message": message(calibration),
        "camera": None if failed else camera_to_dict(calibration.camera),
        "lens": {
            "stars": int(fit.used.sum()),
            "clipped": int((~fit.used).sum()),
            "rms_px": fit.rms_px,
            "held_out_rms_px": fit.held_out_rms_px,
            "held_out_rms_arcmin": fit.held_out_rms_px * arcmin_per_px(calibration.camera),
            "extra_sigma_px": fit.extra_sigma_px,
            "chi2_per_dof": fit.chi2_per_dof,
            "map_sigma_px": next(gate.value for gate in calibration.gates if gate.name.startswith("map sigma")),
            "refraction": "taken out" if _refracted(calibration) else "not taken out: no site on the Earth was given",
            "models": [vars(candidate) for candidate in fit.candidates],
        },
        "gates": [
            {"name": gate.name, "value": _finite(gate.value), "limit": gate.limit, "passed": bool(gate.passed)}
            for gate in calibration.gates
        ],
        "coverage": {
            "ring_edges_deg": np.degrees(cover.ring_edges_rad).round(3).tolist(),
            "stars": cover.stars.astype(int).tolist(),
        },
        "photometry": None if calibration.photometry is None else photometry_dict(calibration.photometry),
        "images": _images(calibration),
        "refused": [vars(refused) for refused in calibration.refused],
        "provenance": {"version": __version__, "false_alarm_probability": calibration.false_alarm_probability},
    }


def refusal_dict(reason: str, text: str, refused: tuple[Refused, ...] = ()) -> dict[str, Any]:
    """The JSON object where there is no lens at all."""
    return {
        "format": FORMAT,
        "status": "refused",
        "reason": reason,
        "message": text,
        "camera": None,
        "refused": [vars(one) for one in refused],
    }


def message(calibration: Calibration) -> str:
    """Why it is refused and what pictures to take; empty where it is not."""
    return "; ".join(
        f"{gate.name} is {gate.value:.3g}, wanted {gate.limit}: {gate.advice}" for gate in calibration.failed
    )


def summary(calibration: Calibration, name: str) -> str:
    """One line for people."""
    camera, fit = calibration.camera, calibration.joint.fit
    images = len(calibration.joint.frames)
    head = f"{name}  {'ok' if calibration.accepted else 'refused ' + calibration.failed[0].reason}"
    return (
        f"{head}  {images} of {images + len(calibration.refused)} images  {int(fit.used.sum())} stars  "
        f"held-out {fit.held_out_rms_px:.2f} px ({fit.held_out_rms_px * arcmin_per_px(camera):.2f}')  "
        f"f {camera.focal_px[0]:.2f} px/rad  calibrated to {np.degrees(camera.calibrated_angle_rad):.1f}°"
        f"{'  mirrored' if camera.mirrored else ''}"
    )


def arcmin_per_px(camera: Camera) -> float:
    """Typical angular size [arcmin] of a pixel: half way to the calibrated angle."""
    return float(np.degrees(camera.mean_scale_rad_per_px(np.array(0.5 * camera.calibrated_angle_rad))) * 60.0)


def _refracted(calibration: Calibration) -> bool:
    return all(frame.sky.refracted for frame in calibration.joint.frames)


def _finite(value: float) -> float:
    return float(np.clip(value, -1e6, 1e6))


def _images(calibration: Calibration) -> list[dict[str, Any]]:
    fit, joint = calibration.joint.fit, calibration.joint
    rows = []
    for i, (frame, matched) in enumerate(zip(joint.frames, joint.matches, strict=True)):
        own = (joint.points.image == i) & fit.used
        held = fit.held_out_px[own]
        row: dict[str, Any] = {
            "image": frame.name,
            "sha256": frame.exposure.sha256,
            "time_utc": format_utc(frame.time_utc),
            "stars": int(own.sum()),
            "matched_fraction": matched.fraction,
            "held_out_rms_px": float(np.sqrt(np.mean(np.sum(held**2, axis=1)))) if len(held) else None,
            "quat_xyzw_cam_icrs": quat_xyzw_from_R(fit.R_cam_icrs[i]).tolist(),
            "sigma_arcsec": (np.degrees(np.sqrt(np.diag(fit.turn_covariance_rad2[i]))) * 3600.0).tolist(),
        }
        if frame.sky.R_enu_icrs is not None:
            row["quat_xyzw_cam_enu"] = quat_xyzw_from_R(fit.R_cam_icrs[i] @ frame.sky.R_enu_icrs.T).tolist()
        rows.append(row)
    return rows
