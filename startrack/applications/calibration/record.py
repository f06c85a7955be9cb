"""Calibrations as the dictionary of the JSON file, its schemas, and as one line; a camera file as text."""

from __future__ import annotations

from typing import Any

import numpy as np

from startrack.applications.calibration.acceptance import CheckedCamera, star_coverage
from startrack.applications.calibration.board import BoardCalibration
from startrack.applications.calibration.run import Calibration
from startrack.applications.calibration.sensor import photometry_dict
from startrack.applications.calibration.verify import VERIFICATION_FORMAT
from startrack.camera import REFRACTION_REMOVED, Camera, camera_keys, camera_to_dict
from startrack.core import __version__
from startrack.core.errors import Reason
from startrack.core.types import Array
from startrack.estimation.lens_fit import LensFit
from startrack.frames import format_utc, quat_xyzw_from_R
from startrack.output import Kind, file_schema, list_schema, object_schema, or_null

CALIBRATION_FORMAT = "startrack.calibration/1"
MAP_ANGLES = 10
ABOUT: dict[str, Kind] = {
    "status": {"enum": ["ok", "refused"]}, "reason": {"enum": [None, *(one.value for one in Reason)]}, "message": "text"
}  # fmt: skip
NOT_MEASURED = "null: not measured"
MODEL = object_schema(
    {"name": "text", "parameters": "count", "held_out_chi2": "positive", "held_out_rms_px": "positive"}
)
LENS = object_schema(
    {
        "clipped": "count", "rms_px": "positive", "held_out_rms_px": "positive",
        "models": list_schema(MODEL, "every lens model tried"),
    },
    "how well the stars of the sky, or the corners of boards, fit",
    optional={
        "stars": "count", "corners": "count", "held_out_rms_arcmin": "positive", "extra_sigma_px": "positive",
        "chi2_per_dof": "positive", "birge_ratio": "positive", "map_sigma_px": "positive", "refraction": "text",
    },
)  # fmt: skip
LIGHT = object_schema({
    "zero_point_adu_per_s": "positive", "zero_point_sigma_mag": "positive",
    "vignetting": list_schema("number", "v1, v2", 2), "colour_mag": or_null("number", NOT_MEASURED),
    "extinction_mag": or_null("number", NOT_MEASURED), "scatter_mag": "positive", "stars": "count",
})  # fmt: skip
PHOTOMETRY = object_schema({
    "light": or_null(LIGHT, NOT_MEASURED),
    **{
        key: or_null("number", NOT_MEASURED)
        for key in ("gain_e_per_adu", "gain_sigma_e_per_adu", "bias_adu", "saturation_adu", "psf_sigma_px")
    },
    "psf_by_ring_px": list_schema(or_null("positive", NOT_MEASURED)),
    "hot_pixels": or_null("count", NOT_MEASURED),
    "notes": list_schema("text", "what is missing"),
})  # fmt: skip
IMAGE = object_schema(
    {"image": "text"},
    optional={
        "sha256": or_null("text", "of the file"), "time_utc": "time", "stars": "count", "matched_fraction": "chance",
        "held_out_rms_px": or_null("positive", "null: no star of it is used"), "quat_xyzw_cam_icrs": "quaternion",
        "sigma_arcsec": list_schema("positive", count=3), "quat_xyzw_cam_enu": "quaternion",
    },
)  # fmt: skip
GATE = object_schema({"name": "text", "value": "number", "limit": "text", "passed": "flag"})
REFUSED_IMAGE = object_schema({"name": "text", "reason": "text", "message": "text"})
CALIBRATION = file_schema(
    "Calibration of a lens",
    object_schema(
        {
            "format": {"const": CALIBRATION_FORMAT},
            **ABOUT,
            "camera": or_null(camera_keys().schema(), "the camera file; null when refused"),
            "refused": list_schema(REFUSED_IMAGE, "pictures that were not used"),
        },
        optional={
            "advice": "text",
            "lens": LENS,
            "gates": list_schema(GATE, "the conditions of acceptance"),
            "coverage": object_schema(
                {"ring_edges_deg": list_schema("positive"), "stars": list_schema(list_schema("count"))},
                "rings off the axis; stars by ring and sector",
            ),
            "photometry": PHOTOMETRY,
            "images": list_schema(IMAGE),
            "obstructed_fraction": "chance",
            "provenance": object_schema({"version": "text"}, optional={"false_alarm_probability": "chance"}),
        },
    ),
)
VERIFICATION = file_schema(
    "Comparison of a camera file with a picture",
    object_schema(
        {"format": {"const": VERIFICATION_FORMAT}, "image": "text", **ABOUT},
        optional={
            "advice": "text",
            "warnings": list_schema("text"),
            "camera": "text",
            "stars": "count",
            **dict.fromkeys(("rms_px", "map_change_px", "map_change_sigma_px", "map_change_largest_px"), "positive"),
            "focal_change": "number",
            "centre_change_px": list_schema("number", count=2),
        },
    )
    | {"if": {"properties": {"status": {"const": "ok"}}}, "then": {"required": ["stars", "map_change_px"]}},
)


def calibration_dict(calibration: Calibration) -> dict[str, Any]:
    """The calibration's JSON object, with the camera only if all checks passed."""
    fit, cover = calibration.joint.fit, star_coverage(calibration.joint)
    return {
        **_outcome(
            calibration,
            {
                **_fit_dict("stars", fit),
                "held_out_rms_arcmin": fit.held_out_rms_px * arcmin_per_px(calibration.camera),
                "extra_sigma_px": fit.extra_sigma_px,
                "chi2_per_dof": fit.chi2_per_dof,
                "birge_ratio": calibration.joint.birge_ratio,
                "map_sigma_px": next(check.value for check in calibration.checks if check.name.startswith("map sigma")),
                "refraction": REFRACTION_REMOVED
                if calibration.is_free_of_refraction
                else "not taken out: no site on the Earth was given",
                "models": [vars(candidate) for candidate in fit.candidates],
            },
        ),
        "coverage": {
            "ring_edges_deg": np.degrees(cover.ring_edges_rad).round(3).tolist(),
            "stars": cover.stars.astype(int).tolist(),
        },
        "photometry": photometry_dict(calibration.photometry),
        "images": image_rows(calibration),
        "obstructed_fraction": 0.0 if calibration.obstructed is None else float(calibration.obstructed.mean()),
        "refused": [vars(refused) for refused in calibration.refused],
        "provenance": {"version": __version__, "false_alarm_probability": calibration.false_alarm_probability},
    }


def board_dict(found: BoardCalibration) -> dict[str, Any]:
    """The JSON object of `found`, a calibration with boards, with the camera only if all checks passed."""
    fit = found.fit
    return {
        **_outcome(found, {**_fit_dict("corners", fit), "models": [vars(one) for one in fit.candidates]}),
        "images": [{"image": image} for image in found.images],
        "refused": [vars(refused) for refused in found.refused],
        "provenance": {"version": __version__},
    }


def _fit_dict(what: str, fit: LensFit) -> dict[str, Any]:
    """The number of used observations, called `what`, and how well they fit."""
    return {
        what: int(fit.used.sum()),
        "clipped": int((~fit.used).sum()),
        "rms_px": fit.rms_px,
        "held_out_rms_px": fit.held_out_rms_px,
    }


def _outcome(found: CheckedCamera, lens: dict[str, Any]) -> dict[str, Any]:
    """Keys that all JSON objects of a calibration share, with what is known of the `lens`."""
    failed = found.failed_checks
    return {
        "format": CALIBRATION_FORMAT,
        "status": "refused" if failed else "ok",
        "reason": failed[0].reason if failed else None,
        "message": found.message,
        "camera": None if failed else camera_to_dict(found.camera),
        "lens": lens,
        "gates": [
            {"name": c.name, "value": float(np.clip(c.value, -1e6, 1e6)), "limit": c.limit, "passed": bool(c.passed)}
            for c in found.checks
        ],
    }


def refusal_dict(reason: str, text: str) -> dict[str, Any]:
    """The JSON object of a calibration without a lens.

    `reason` is a value of `Reason`; `text` explains it.
    """
    return {
        "format": CALIBRATION_FORMAT,
        "status": "refused",
        "reason": reason,
        "message": text,
        "advice": Reason(reason).advice,
        "camera": None,
        "refused": [],
    }


def summary(calibration: Calibration, name: str) -> str:
    """Summary of the `calibration` of the camera called `name` in one line."""
    fit, camera = calibration.joint.fit, calibration.camera
    arcmin = f" ({fit.held_out_rms_px * arcmin_per_px(camera):.2f}')"
    line = _line(calibration, name, fit, len(calibration.joint.frames), "images", "stars", arcmin)
    return f"{line}{'  mirrored' if camera.mirrored else ''}"


def board_line(found: BoardCalibration, name: str) -> str:
    """Summary of `found`, a calibration of the camera called `name` with boards, in one line."""
    return _line(found, name, found.fit, len(found.images), "pictures", "corners")


def _line(found: CheckedCamera, name: str, fit: LensFit, images: int, of: str, what: str, arcmin: str = "") -> str:
    """Summary in one line: verdict, used images (`of`), observations (`what`), errors, focal length, angle."""
    verdict = "ok" if found.accepted else f"refused {found.failed_checks[0].reason}"
    return (
        f"{name}  {verdict}  {images} of {images + len(found.refused)} {of}  {int(fit.used.sum())} {what}  "
        f"held-out {fit.held_out_rms_px:.2f} px{arcmin}  f {found.camera.focal_px[0]:.2f} px/rad  "
        f"calibrated to {np.degrees(found.camera.calibrated_angle_rad):.1f}°"
    )


def arcmin_per_px(camera: Camera) -> float:
    """Angular size [arcmin] of a pixel half way to the calibrated angle."""
    return float(np.degrees(camera.mean_scale_rad_per_px(np.array(0.5 * camera.calibrated_angle_rad))) * 60.0)


def image_rows(calibration: Calibration) -> list[dict[str, Any]]:
    """Rows of the JSON object, one for each image that was used."""
    fit, joint = calibration.joint.fit, calibration.joint
    rows = []
    for i, (frame, matched) in enumerate(zip(joint.frames, joint.matches, strict=True)):
        own = (joint.points.image == i) & fit.used
        held = fit.held_out_px[own]
        row: dict[str, Any] = {
            "image": frame.exposure.name,
            "sha256": frame.exposure.sha256,
            "time_utc": format_utc(frame.time_utc),
            "stars": int(own.sum()),
            "matched_fraction": matched.fraction,
            "held_out_rms_px": float(np.sqrt(np.mean(np.sum(held**2, axis=1)))) if len(held) else None,
            "quat_xyzw_cam_icrs": quat_xyzw_from_R(fit.R_cam_icrs[i]).tolist(),
            "sigma_arcsec": (np.degrees(np.sqrt(np.diag(fit.pose_covariance_rad2[i]))) * 3600.0).tolist(),
        }
        if frame.sky.R_enu_icrs is not None:
            row["quat_xyzw_cam_enu"] = quat_xyzw_from_R(fit.R_cam_icrs[i] @ frame.sky.R_enu_icrs.T).tolist()
        rows.append(row)
    return rows


def camera_properties(camera: Camera) -> dict[str, Any]:
    """The camera file's keys, and the projection by angle: radius, scale, and sigma where there is a covariance."""
    angle = np.linspace(0.0, camera.calibrated_angle_rad, MAP_ANGLES)
    radius, scale, sigma = (column.tolist() for column in projection_by_angle(camera, angle))
    sigma = sigma if camera.covariance is not None else MAP_ANGLES * [None]
    keys = ("angle_deg", "radius_px", "arcmin_per_px", "map_sigma_px")
    rows = zip(np.degrees(angle).tolist(), radius, scale, sigma, strict=True)
    return {
        "camera": camera_to_dict(camera),
        "notes": list(camera.notes),
        "map": [dict(zip(keys, row, strict=True)) for row in rows],
    }


def projection_by_angle(camera: Camera, angle_rad: Array) -> tuple[Array, Array, Array]:
    """Radius [px], scale [arcmin/px] and projection sigma per axis [px], each (n,), at the angles (n,) off the axis.

    Sigma is the RMS over eight directions.
    """
    rays = cone_rays(angle_rad[:, None], np.linspace(0.0, 2 * np.pi, 8, endpoint=False))
    sigma = np.sqrt(np.mean(np.square(camera.projection_sigma_px(rays)), axis=1))
    radius = np.sqrt(np.prod(camera.focal_px)) * camera.lens.rho(angle_rad)
    return radius, np.degrees(camera.mean_scale_rad_per_px(np.maximum(angle_rad, 1e-6))) * 60.0, sigma


def cone_rays(angle_rad: Array, around_rad: Array) -> Array:
    """Rays (..., 3) at angles off the axis and directions around it, clockwise from image right."""
    x, y, z = np.sin(angle_rad) * np.cos(around_rad), np.sin(angle_rad) * np.sin(around_rad), np.cos(angle_rad)
    return np.stack(np.broadcast_arrays(x, y, z), axis=-1)


def camera_summary(camera: Camera) -> str:
    """The camera file's content in several lines."""
    (fx, fy), (cx, cy) = camera.focal_px, camera.centre_px
    lines = [
        f"{camera.name}: {camera.lens.model}, {camera.size_px[0]} x {camera.size_px[1]} px"
        + (", mirrored" if camera.mirrored else ""),
        f"  focal length {fx:.3f}, {fy:.3f} px/rad; centre {cx:.3f}, {cy:.3f} px"
        + "".join(f"; {name} {value:.6g}" for name, value in camera.lens.parameters.items())
        + (f"; decentring {camera.decentring.p1:.3g}, {camera.decentring.p2:.3g}" if camera.decentring else ""),
        f"  image circle to {np.degrees(camera.max_angle_rad):.2f}°, calibrated to "
        f"{np.degrees(camera.calibrated_angle_rad):.2f}°; "
        + ("no covariance" if camera.covariance is None else "with covariance"),
        *(f"  {note}" for note in camera.notes),
        "  angle °   radius px   arcmin/px   map sigma px",
    ]
    for row in camera_properties(camera)["map"]:
        sigma = "-" if row["map_sigma_px"] is None else f"{row['map_sigma_px']:.3f}"
        lines.append(f"  {row['angle_deg']:7.2f} {row['radius_px']:11.2f} {row['arcmin_per_px']:11.3f} {sigma:>14}")
    if camera.sensor is not None:
        lines += ["  sensor:", *(f"    {key} = {value}" for key, value in vars(camera.sensor).items())]
    else:
        lines.append("  sensor: not known")
    return "\n".join(lines)
