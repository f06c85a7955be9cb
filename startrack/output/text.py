"""Results as text: rows of names and texts, one line for a terminal, and some more lines for -v."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from startrack.chain import STAGES, Outcome, Refused, last_value
from startrack.core.files import printable
from startrack.output.quantities import QUANTITIES
from startrack.output.quantity import TURN
from startrack.output.record import at_stage, image_name
from startrack.output.values import Angle, At

if TYPE_CHECKING:
    from startrack.camera import Camera

NAME_LETTERS = 11  # width of the names in the detailed text
Rows = list[tuple[str, str]]


def rows(place: str, at: At, sections: Collection[str] | None = None) -> Rows:
    """The rows of a `place` (summary, text, panel, notebook or page): each a name and a text.

    `at` gives the values, `sections` restricts the quantities to these parts of the record.
    """
    found: dict[str, str] = {}
    for one in QUANTITIES:
        if sections is not None and one.section not in sections:
            continue
        for show in one.shown:
            if show.place != place or (show.unless and at(show.unless) is not None):
                continue
            value = at(one.path)
            if value is None:
                continue
            value = Angle(value) if one.schema is TURN else value
            text = show.form(value) if callable(show.form) else show.form.format(value)
            found[show.row] = found[show.row] + text if show.row in found else text.lstrip(" ,;")
    return [(row, text) for row, text in found.items() if text]


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
