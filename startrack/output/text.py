"""Results as text: one line for a terminal, and some more lines for -v."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from startrack.chain import STAGES, Outcome, Refused, last_value
from startrack.core.files import printable
from startrack.output.record import image_name
from startrack.output.views import at_stage, rows

if TYPE_CHECKING:
    from startrack.camera import Camera

NAME_LETTERS = 11  # width of the names in the detailed text


def summary_line(result: Outcome, seconds: float | None = None) -> str:
    """One line about a `result`. It ends with the sum of the times of the stages.

    `seconds`: the time that the result and the writing of its files took, which is then stated instead.
    """
    if isinstance(result, Refused):
        return refusal_line(image_name(result.exposure), result.reason, result.message)
    took = f"{sum(result.timing_ms.values()) / 1e3:.1f} s" if seconds is None else f"{seconds:.1f} s with files"
    parts = [text for _, text in rows("summary", at_stage(result))]
    return "  ".join([image_name(result.exposure), result.status, *parts, took])


def refusal_line(image: str, reason: str, message: str) -> str:
    """One line about an `image` that was refused at whatever stage: `reason` and `message`, its own name left out."""
    cause = " ".join(message.split()).removeprefix(f"{printable(image)}: ")
    return f"{Path(image).name}  refused  {reason}: {cause}"


def lens_text(camera: Camera) -> str:
    """The lens of a `camera` that an identification without a camera file found: model, focal length, centre."""
    x, y = camera.centre_px
    return (
        f"lens found: {camera.lens.model}, focal length {camera.focal_px[0]:.1f} px, centre ({x:.1f}, {y:.1f}) px, "
        f"{'mirrored' if camera.mirrored else 'not mirrored'}, known to {np.degrees(camera.calibrated_angle_rad):.0f} "
        "degrees off the axis"
    )


def verbose_text(result: Outcome) -> str:
    """Indented lines about a `result`: position, attitude, stars and times, as far as they are known."""
    at = at_stage(last_value(result))
    lines = rows("text", at)
    when = at("provenance.time_utc")
    lines += [("time", f"{when if when is not None else 'not known'} (middle of the exposure)")]
    spent = [f"{stage} {result.timing_ms[stage]:.0f}" for stage in STAGES if stage in result.timing_ms]
    lines += [("ms", f"{', '.join(spent)}; all stages {sum(result.timing_ms.values()):.0f}")] if spent else []
    lines += [("warning", warning) for warning in result.warnings]
    return "\n".join(f"  {name:<{NAME_LETTERS}}{text}" for name, text in lines)
