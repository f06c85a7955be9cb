"""Results in words: one line for a terminal, and a few lines for those who ask for more."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from startrack.frames import format_utc, heading_pitch_roll_from_R_body_enu, latlon_from_enu
from startrack.output.record import (
    ARCSEC_PER_RAD,
    STAGES,
    R_body_enu,
    boresight_rad,
    image_name,
    lens_errors_known,
    predicted_visible,
)
from startrack.stages import Detected, Identified, Inputs, Located, Measured, Oriented, Outcome, Refused, reached

if TYPE_CHECKING:
    from startrack.camera import Camera
    from startrack.types import Fix

LEAST_CHANCE = 1e-100


def summary_line(result: Outcome, seconds: float | None = None) -> str:
    """One line: what became of the image. `seconds` is what it took in all; without it the stages' times are added."""
    if isinstance(result, Refused):
        return refusal_line(image_name(result.exposure), result.reason, result.message)
    parts = [image_name(result.exposure), result.status]
    if isinstance(result, Located) and result.fix.ambiguous:
        parts += [f"{len(result.fix.modes)} places fit: {_modes(result.fix)}"]
    elif isinstance(result, Located):
        east, north, _ = result.fix.position_enu_m
        parts += [f"E {east:.1f} m", f"N {north:.1f} m", f"±{result.fix.radius95_m:.1f} m (95 %)"]
    if isinstance(result, Measured):
        parts += [f"heading {_degrees(heading_pitch_roll_from_R_body_enu(R_body_enu(result))[0], 1)}°"]
    elif isinstance(result, Oriented):
        ra, dec, roll = boresight_rad(result.attitude.R_cam_icrs)
        parts += [f"RA {_degrees(ra, 3)}°", f"Dec {np.degrees(dec):+.3f}°", f"roll {_degrees(roll, 3)}°"]
    if isinstance(result, Identified):
        parts += [f"{len(result.identification)} stars"]
    elif isinstance(result, Detected):
        parts += [f"{len(result.detections)} point sources"]
    took_s = seconds if seconds is not None else sum(result.timing_ms.values()) / 1e3
    return "  ".join([*parts, f"{took_s:.1f} s"])


def lens_text(camera: Camera) -> str:
    """The lens that a blind identification found: model, focal length, centre, handedness."""
    x, y = camera.centre_px
    return (
        f"lens found: {camera.lens.model}, focal length {camera.focal_px[0]:.1f} px, centre ({x:.1f}, {y:.1f}) px, "
        f"{'mirrored' if camera.mirrored else 'not mirrored'}, known to {np.degrees(camera.calibrated_angle_rad):.0f} "
        "degrees off the axis"
    )


def refusal_line(image: str, reason: str, message: str) -> str:
    """One line for an image that was refused, at whatever stage."""
    return f"{Path(image).name}  refused  {reason}: {' '.join(message.split())}"


def verbose_text(result: Outcome) -> str:
    """Some indented lines: place, attitude, stars and times, as far as they are known."""
    value = reached(result)
    lines = [*_place(value), *_attitude(value), *_stars(value)]
    when = result.exposure.time_utc
    lines += [f"time       {format_utc(when) if when is not None else 'not known'} (middle of the exposure)"]
    spent = [f"{stage} {result.timing_ms[stage]:.0f}" for stage in STAGES if stage in result.timing_ms]
    lines += [f"ms         {', '.join(spent)}"] if spent else []
    lines += [f"warning    {warning}" for warning in result.warnings]
    return "\n".join(f"  {line}" for line in lines)


def chance_text(probability: float) -> str:
    """A probability; how small a tiny one is, the models behind it do not say."""
    return f"{probability:.0e}" if probability >= LEAST_CHANCE else f"below {LEAST_CHANCE:.0e}"


def _place(result: Inputs) -> list[str]:
    if not isinstance(result, Located):
        return []
    if result.fix.ambiguous:
        return [f"places     {_modes(result.fix)}"]
    fix, site = result.fix, result.site
    latitude, longitude = np.degrees(latlon_from_enu(site, *fix.position_enu_m))
    sigma = np.sqrt(np.linalg.eigvalsh(fix.covariance_m2))
    return [
        f"position   E {fix.position_enu_m[0]:.2f} m, N {fix.position_enu_m[1]:.2f} m, U {fix.position_enu_m[2]:.2f} m "
        f"on {result.terrain.name}; latitude {latitude:.6f}°, longitude {longitude:.6f}°",
        f"error      sigma {sigma[1]:.2f} m by {sigma[0]:.2f} m; within {fix.radius95_m:.1f} m (95 %), "
        f"{fix.radius999_m:.1f} m (99.9 %)",
    ]


def _attitude(result: Inputs) -> list[str]:
    if not isinstance(result, Oriented):
        return []
    ra, dec, roll = boresight_rad(result.attitude.R_cam_icrs)
    sigma = np.sqrt(np.diag(result.attitude.covariance_rad2)) * ARCSEC_PER_RAD
    lines = [
        f"boresight  RA {_degrees(ra, 4)}°, Dec {np.degrees(dec):+.4f}°, roll {_degrees(roll, 4)}°; "
        f"sigma {sigma[0]:.2f}, {sigma[1]:.2f}, {sigma[2]:.2f} arcsec about x, y, z"
        f"{'' if lens_errors_known(result) else ', the lens taken as exact'}"
    ]
    if isinstance(result, Measured):
        heading, pitch, roll_body = heading_pitch_roll_from_R_body_enu(R_body_enu(result))
        lines += [
            f"body       heading {_degrees(heading, 3)}°, pitch {np.degrees(pitch):+.3f}°, "
            f"roll {np.degrees(roll_body):+.3f}°"
        ]
    return lines


def _stars(result: Inputs) -> list[str]:
    if not isinstance(result, Detected):
        return []
    text = f"{len(result.detections)} point sources"
    found = result.identification if isinstance(result, Identified) else None
    if found is not None:
        text += f", {len(found)} identified, {found.unexplained} significant ones unexplained"
    if found is not None and isinstance(result, Oriented):
        text += f"; rms {result.attitude_fit.rms_px:.3f} px; false alarm {chance_text(found.false_alarm_probability)}"
    lines = [f"stars      {text}"]
    if isinstance(result, Measured):
        lines += [f"evidence   {int(result.light.usable.sum())} catalogue stars measured"]
        lines[-1] += (
            f", {predicted_visible(result)} above the skyline of the fix" if isinstance(result, Located) else ""
        )
    return lines


def _modes(fix: Fix) -> str:
    return "; ".join(f"E {m.east_m:.0f} m N {m.north_m:.0f} m ({100 * m.weight:.0f} %)" for m in fix.modes)


def _degrees(angle_rad: float, decimals: int) -> str:
    """An angle of a full turn, rounded without ever reading 360."""
    return f"{round(float(np.degrees(angle_rad)), decimals) % 360:.{decimals}f}"
