"""The table of output quantities: what each is, how it is computed, and where it is shown.

Result record, JSON schema, batch columns, summary line, detailed text, panel of the picture, notebook tables, HTML page
and a table of docs/formats.md are made from `QUANTITIES`. A new quantity is one entry.
"""

from __future__ import annotations

from startrack.camera import camera_keys, camera_to_dict
from startrack.chain import Detected, Identified, Inputs, Located, Measured, Oriented, Positioned
from startrack.core import __version__
from startrack.core.ecsv import Column
from startrack.frames import format_utc
from startrack.kernels.library import LEVEL
from startrack.output.quantities_pose import ATTITUDE_QUANTITIES, MIDDLE_QUANTITIES, POSITION_QUANTITIES
from startrack.output.quantity import (
    Listed,
    Quantity,
    Show,
    list_schema,
    object_schema,
    or_null,
    schema_of_kind,
    show_everywhere,
)
from startrack.output.values import (
    bodies_record,
    chance_text,
    file_or_name,
    matches_record,
    off_map,
    predicted_visible,
    ranges_deg,
    ranges_text,
    sources_record,
)

Q = Quantity
BODY = object_schema({"name": "text", "v_mag": "number", "x_px": "number", "y_px": "number"})
LIGHT_QUANTITIES: tuple[Quantity, ...] = (
    Q("stars.detected", "", Detected, lambda v: len(v.detections), "point sources", "count", before=0, form="%d",
      shown=(Show("summary", "sources", "{} point sources", "stars.identified"),
             Show("text", "stars", "{} point sources"), Show("panel", "Stars", "{:,} point sources"),
             Show("page", "Point sources", "{:,}"))),
    Q("stars.identified", "", Identified, lambda v: len(v.names.stars), "sources with the name of a star", "count",
      before=0, form="%d",
      shown=(Show("summary", "stars", "{} stars"), Show("text", "stars", ", {} identified"),
             Show("panel", "Stars", ", {:,} identified"), Show("page", "Named", "{:,}")), listed=Listed("Stars", 0)),
    Q("stars.unexplained", "", Identified, lambda v: v.names.unexplained,
      "significant point sources that no catalogue star and no planet explains; null: not identified", "count",
      before=None,
      shown=(Show("text", "stars", ", {} significant ones unexplained"), Show("page", "Unexplained", "{:,}"))),
    Q("stars.measured", "", Measured, lambda v: int(v.photometry.usable.sum()),
      "catalogue stars whose light was measured",
      recorded=False,
      shown=(Show("text", "evidence", "{} catalogue stars measured"), Show("panel", "Evidence", "{:,} stars"))),
    Q("stars.predicted_visible", "", Located, predicted_visible,
      "stars whose light was measured and which stand above the skyline of the fix; 0 without a fix, null of "
      "`identify` and `detect`", "count", before=lambda v: None if v.terrain is None else 0,
      shown=(Show("text", "evidence", ", {} above the skyline of the fix"),
             Show("panel", "Evidence", ", {:,} above the skyline"),
             Show("page", "Above the skyline", "{:,}"))),
    Q("stars.rms_px", "px", Oriented, lambda v: v.attitude_fit.rms_px,
      "of the identified stars, per axis; null: not identified", "positive", before=None, form="%.5f",
      shown=(Show("text", "stars", "; rms {:.3f} px"), Show("panel", "Residual", "{:.2f} px"),
             Show("page", "Residual", "{:.3f} px"))),
    Q("stars.false_alarm_probability", "", Identified, lambda v: v.identification.false_alarm_probability,
      "that chance would match as many; numbers below 1e-100 (none is below 1e-300) mean only that, and are "
      "printed so; null: not identified", "chance", before=None,
      shown=(Show("text", "stars", lambda p: f"; false alarm {chance_text(p)}"),
             Show("panel", "Residual", lambda p: f"   false alarm {chance_text(p)}"),
             Show("page", "Chance match", chance_text))),
    Q("bodies", "", Oriented, bodies_record,
      "list of `name`, `v_mag`, `x_px`, `y_px`: planets, Sun, Moon and Earth in the frame, at their predicted places; "
      "without a site those that have a source there, the Moon as from the middle of the Earth (up to 1 degree off), "
      "without a time none", list_schema(BODY), before=[]),
    Q("evidence.blocked", "deg", Positioned, lambda v: ranges_deg(v.fix.blocked),
      "list of [from, to]: azimuths in which the skyline is more likely not the map's: hidden by something on no map, "
      "or below it; across north `to` is the smaller", list_schema(list_schema("number", count=2)), before=[],
      optional=True,
      shown=(Show("text", "evidence", lambda a: f"; blocked {ranges_text(a)}" if a else ""),
             Show("page", "Blocked azimuths", ranges_text))),
    Q("evidence.off_map", "deg", Positioned, lambda v: ranges_deg(off_map(v)),
      "list of [from, to]: azimuths in which the maps end, and ground beyond could stand above their skyline at the "
      "position; no evidence is taken below that", list_schema(list_schema("number", count=2)), before=[],
      optional=True,
      shown=(Show("text", "evidence", lambda a: f"; the maps end {ranges_text(a)}" if a else ""),
             Show("page", "Maps end", ranges_text))),
    Q("evidence.damage", "", Inputs, lambda v: None if v.damage is None else v.damage.cause,
      "what processing did to the pixels, where the evidence is measured on the frame itself; null: nothing shows",
      "text", nullable=True, optional=True),
    Q("sky.brightness_mag_arcsec2", "mag/arcsec^2", Located, lambda v: v.sky_brightness_mag_arcsec2,
      "V of the sky beyond that of the ground at the skyline, by the camera's zero point and the exposure's duration; "
      "null where the image shows no step of light there, or one of the two is not known",
      "number", nullable=True, form="%.4f", columns={"sky_mag_arcsec2": ()},
      shown=show_everywhere("Sky", "{:.2f} mag/arcsec2", "evidence")),
    Q("sky.unused", "", Located, lambda v: v.sky_unused or None,
      "why the light of the sky, or a part of it, is not evidence of the position; "
      "null: all of it is, or it was not asked for", "text",
      nullable=True, optional=True,
      shown=(Show("text", "evidence", "; sky not used: {}"), Show("page", "Sky not used", "{}"))),
)  # fmt: skip
RUN_QUANTITIES: tuple[Quantity, ...] = (
    Q("clock.offset_s", "s", Located, lambda v: None if v.fix.clock is None else v.fix.clock.offset_s,
      "true minus stated time: mean of the posterior; 0 in a round crater, where the image does not show it; null: a "
      "method without a posterior", "number", nullable=True, form="%.6g", columns={"clock_offset_s": ()},
      shown=(Show("text", "clock", "offset {:+.3f} s"), Show("notebook page", "clock", "{:+.3f} s"))),
    Q("clock.sigma_s", "s", Located, lambda v: None if v.fix.clock is None else v.fix.clock.sigma_s,
      "standard deviation of the offset; as stated (`provenance.time_sigma_s`) where the image does not show it; null: "
      "as above", "positive", nullable=True, form="%.6g", columns={"clock_sigma_s": ()},
      shown=(Show("text", "clock", "; sigma {:.3f} s"), Show("notebook page", "clock", " ± {:.3f} s"))),
    Q("provenance.version", "", Inputs, lambda v: __version__, "of startrack", "text"),
    Q("provenance.kernels", "", Inputs, lambda v: LEVEL,
      "level of the processor that the C library was compiled for: `baseline`, `v3`, `sanitized`", "text",
      optional=True),
    Q("provenance.image_sha256", "", Inputs, lambda v: v.exposure.sha256,
      "of the file; of an array: of its type, shape and values; null: it could not be read", "text", before=None,
      form="%s"),
    Q("provenance.camera", "", Inputs, lambda v: file_or_name(v.exposure.camera, v.camera),
      "camera file, as a path without links of folders, or name", "text", before=None, form="%s"),
    Q("provenance.terrain", "", Inputs,
      lambda v: file_or_name(v.exposure.terrain, v.terrain), "terrain file, likewise, or name",
      "text", before=None, form="%s"),
    Q("provenance.catalog", "", Inputs, lambda v: v.catalog_name or None, "star catalogue", "text", before=None),
    Q("provenance.localizer", "", Inputs, lambda v: v.localizer_name or None,
      "method of localization, by its name for `--localizer`; of one of your own the name of its class or function; "
      "null: of `identify` and `detect`", "text", before=None, optional=True),
    Q("provenance.near", "m", lambda v: isinstance(v, Measured | Positioned),
      lambda v: None if v.near is None else str(v.near),
      "`EAST,NORTH,SIGMA` of the prior of the position that the posterior contains; null: none was given", "text",
      before=None, nullable=True, optional=True),
    Q("provenance.time_utc", "", Inputs,
      lambda v: None if v.exposure.time_utc is None else format_utc(v.exposure.time_utc),
      "middle of the exposure; null: not known", "time", before=None, form="%s"),
    Q("provenance.time_sigma_s", "s", Inputs,
      lambda v: None if v.exposure.time_utc is None else v.exposure.time_sigma_s,
      "standard deviation of the clock's error, as stated, or 1; null: no time is known", "positive", before=None,
      optional=True, form="%.9g"),
    Q("provenance.exposure_s", "s", Inputs, lambda v: v.exposure.exposure_s, "null: not known", "number", before=None,
      form="%.9g"),
    Q("provenance.mask_sha256", "", Detected,
      lambda v: None if v.detections.mask is None else v.detections.mask.sha256 or None,
      "of the file of the mask, or of the array that is masked; with the camera's and the image's mask both, joined by "
      "`+`; null: every pixel counts", "text", before=None, nullable=True, optional=True),
    Q("provenance.dark_sha256", "", Inputs,
      lambda v: None if v.exposure.correction is None else v.exposure.correction.dark_sha256,
      "of the file of the dark frame; null: none was subtracted", "text", before=None, nullable=True, optional=True),
    Q("provenance.flat_sha256", "", Inputs,
      lambda v: None if v.exposure.correction is None else v.exposure.correction.flat_sha256,
      "of the file of the flat field; null: none was used", "text", before=None, nullable=True, optional=True),
)  # fmt: skip
MATCH = object_schema({
    "hip": or_null({"type": "integer", "minimum": 1}, "Hipparcos number; null: the star has none"),
    "x_px": "number",
    "y_px": "number",
    "saturated": schema_of_kind("flag", "whether its light is cut off: it may be named by place and brightness"),
})  # fmt: skip
POINT_SOURCE = object_schema({"x_px": "number", "y_px": "number", "flux_e": "number", "snr": "number"})
OWN_QUANTITIES: tuple[Quantity, ...] = (  # of one kind of record alone
    Q("explain", "", Inputs, lambda v: [], "with --explain: what a refused or wide answer would need",
      list_schema("text"), before=[]),
    Q("camera", "", Inputs, lambda v: None if v.camera is None else camera_to_dict(v.camera), "",
      {"title": "Camera file", **camera_keys().schema()}, before=None, nullable=True),
    Q("matches", "", Identified, matches_record, "", list_schema(MATCH), before=[]),
    Q("detections", "", Detected, sources_record, "", list_schema(POINT_SOURCE), before=[]),
)  # fmt: skip
QUANTITIES: tuple[Quantity, ...] = (
    POSITION_QUANTITIES + ATTITUDE_QUANTITIES + MIDDLE_QUANTITIES + LIGHT_QUANTITIES + RUN_QUANTITIES
)
BY_PATH = {one.path: one for one in (*QUANTITIES, *OWN_QUANTITIES)}
# The batch's columns came in this order before the table did; a column that is not named here is appended.
FIRST_COLUMNS = (
    "time_utc", "exposure_s", "east_m", "north_m", "up_m", "cov_east_east_m2", "cov_east_north_m2",
    "cov_north_north_m2", "radius95_m", "radius999_m", "latitude_deg", "longitude_deg", "heading_deg", "pitch_deg",
    "roll_body_deg", "qx_cam_icrs", "qy_cam_icrs", "qz_cam_icrs", "qw_cam_icrs", "sigma_x_arcsec", "sigma_y_arcsec",
    "sigma_z_arcsec", "detected", "identified", "rms_px", "image_sha256",
)  # fmt: skip


def table_columns() -> list[Column]:
    """The columns of the batch's table, in their order."""
    order = {name: k for k, name in enumerate(FIRST_COLUMNS)}
    found = [column for one in QUANTITIES for column in one.table_columns]
    return sorted(found, key=lambda column: order.get(column.name, len(order)))
