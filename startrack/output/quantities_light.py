"""Output quantities of what the image shows: stars, blocked and damaged parts, the light of the sky."""

from __future__ import annotations

from startrack.chain import Detected, Identified, Inputs, Located, Measured, Oriented
from startrack.output.quantity import Column, Listed, Quantity, Show, show_everywhere
from startrack.output.schema_parts import CHANCE, COUNT, NUMBER, POSITIVE, TEXT, numbers
from startrack.output.values import blocked_deg, blocked_text, chance_text, predicted_visible, ranges_text

Q = Quantity
LIGHT: tuple[Quantity, ...] = (
    Q("stars.detected", "", Detected, lambda v: len(v.detections), "point sources", COUNT, before=0,
      columns=(Column("detected", "%d"),),
      shown=(Show("summary", "sources", "{} point sources", "stars.identified"),
             Show("text", "stars", "{} point sources"), Show("panel", "Stars", "{:,} point sources"),
             Show("page", "Point sources", "{:,}"))),
    Q("stars.identified", "", Identified, lambda v: len(v.identification), "point sources with a name", COUNT, before=0,
      columns=(Column("identified", "%d"),),
      shown=(Show("summary", "stars", "{} stars"), Show("text", "stars", ", {} identified"),
             Show("panel", "Stars", ", {:,} identified"), Show("page", "Named", "{:,}")), listed=Listed("Stars", 0)),
    Q("stars.unexplained", "", Identified, lambda v: v.identification.unexplained,
      "significant point sources that no catalogue star explains; null: not identified", COUNT, before=None,
      shown=(Show("text", "stars", ", {} significant ones unexplained"), Show("page", "Unexplained", "{:,}"))),
    Q("stars.measured", "", Measured, lambda v: int(v.light.usable.sum()), "catalogue stars whose light was measured",
      recorded=False,
      shown=(Show("text", "evidence", "{} catalogue stars measured"), Show("panel", "Evidence", "{:,} stars"))),
    Q("stars.predicted_visible", "", Located, predicted_visible,
      "stars whose light was measured and which stand above the skyline of the fix; 0 without a fix, null of "
      "`identify` and `detect`", COUNT, before=lambda v: None if v.terrain is None else 0,
      shown=(Show("text", "evidence", ", {} above the skyline of the fix"),
             Show("panel", "Evidence", ", {:,} above the skyline"),
             Show("page", "Above the skyline", "{:,}"))),
    Q("stars.rms_px", "px", Oriented, lambda v: v.attitude_fit.rms_px,
      "of the identified stars, per axis; null: not identified", POSITIVE, before=None,
      columns=(Column("rms_px", "%.5f"),),
      shown=(Show("text", "stars", "; rms {:.3f} px"), Show("panel", "Residual", "{:.2f} px"),
             Show("page", "Residual", "{:.3f} px"))),
    Q("stars.false_alarm_probability", "", Identified, lambda v: v.identification.false_alarm_probability,
      "that chance would match as many; numbers below 1e-100 (none is below 1e-300) mean only that, and are "
      "printed so; null: not identified", CHANCE, before=None,
      shown=(Show("text", "stars", lambda p: f"; false alarm {chance_text(p)}"),
             Show("panel", "Residual", lambda p: f"   false alarm {chance_text(p)}"),
             Show("page", "Chance match", chance_text))),
    Q("evidence.blocked", "deg", Located, blocked_deg,
      "list of [from, to]: azimuths in which something on no map more likely hides the map's skyline than not; across "
      "north `to` is the smaller", {"type": "array", "items": numbers(2)}, optional=True,
      shown=(Show("text", "evidence", blocked_text), Show("page", "Blocked azimuths", ranges_text))),
    Q("evidence.damage", "", Inputs, lambda v: None if v.damage is None else v.damage.cause,
      "what processing did to the pixels, where the evidence is measured on the frame itself; null: nothing shows",
      TEXT, nullable=True, optional=True),
    Q("sky.brightness_mag_arcsec2", "mag/arcsec^2", Located, lambda v: v.sky_brightness_mag_arcsec2,
      "V of the sky beyond that of the ground at the skyline, by the camera's zero point and the exposure's duration; "
      "null where the image shows no step of light there, or one of the two is not known",
      NUMBER, nullable=True, columns=(Column("sky_mag_arcsec2", "%.4f"),),
      shown=show_everywhere("Sky", "{:.2f} mag/arcsec2", "evidence")),
    Q("sky.unused", "", Located, lambda v: v.sky_unused or None,
      "why the light of the sky is not evidence of the position; null: it is, or was not asked for", TEXT,
      nullable=True, optional=True,
      shown=(Show("text", "evidence", "; sky not used: {}"), Show("page", "Sky not used", "{}"))),
)  # fmt: skip
