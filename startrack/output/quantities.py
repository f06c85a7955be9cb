"""The table of output quantities: what each is, how it is computed, and where it is shown.

Result record, JSON schema, batch columns, summary line, detailed text, panel of the picture, notebook tables, HTML page
and a table of docs/formats.md are made from `QUANTITIES`. A new quantity is one entry.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from startrack import __version__
from startrack.frames import format_utc, quat_xyzw_from_R
from startrack.output.schema_parts import (
    CHANCE,
    COUNT,
    FLAG,
    LATITUDE,
    LONGITUDE,
    NUMBER,
    POSITIVE,
    QUATERNION,
    TEXT,
    TURN,
    Schema,
    numbers,
    record,
)  # fmt: skip
from startrack.output.values import (
    ARCSEC_PER_RAD,
    R_body_enu,
    ambiguous_modes,
    arcsec_text,
    body_deg,
    body_sigmas_deg,
    boresight_deg,
    caution_text,
    chance_text,
    ellipse,
    exact_lens_text,
    finite_or_none,
    lacking_circle,
    latlon_deg,
    modes_text,
    predicted_visible,
    sigma_m,
)  # fmt: skip
from startrack.stages import Detected, Identified, Inputs, Located, Measured, Oriented

ABSENT: Any = object()  # of a quantity that has no key before its stage


@dataclass(frozen=True)
class Show:
    """One place where a quantity is shown; the quantities of one row are joined.

    `place` is summary, text, panel, notebook or page; `row` names the line of text or the row of a table; `form` makes
    the text, by str.format or as a function. Nothing is shown where the quantity at the path `unless` is known.
    """

    place: str
    row: str
    form: str | Callable[[Any], str]
    unless: str = ""


@dataclass(frozen=True)
class Column:
    """A column of the batch's table: its name, its printf format, and which element of the value it holds."""

    name: str
    form: str
    at: tuple[int, ...] = ()


@dataclass(frozen=True)
class Listed:
    """A column in the page's list of images: heading, decimals, and whether narrow screens have it too."""

    heading: str
    decimals: int
    always: bool = False


@dataclass(frozen=True)
class Quantity:
    """One quantity of the result record, or one that is only shown."""

    path: str  # KEY or SECTION.KEY of the record
    unit: str  # as docs/formats.md spells it; empty for texts and pure numbers
    since: type[Inputs]  # the first value of the pipeline that determines it
    value: Callable[[Any], Any]  # of such a value; where `derived`, of the function from paths to values
    description: str
    schema: Schema = field(default_factory=dict)
    before: Any = ABSENT  # in the record of a value that has not come as far: ABSENT, None, a number, or a function
    nullable: bool = False  # whether it may be null of a value that has come as far
    optional: bool = False  # whether records of earlier stages or versions lack it although they have its section
    columns: tuple[Column, ...] = ()
    shown: tuple[Show, ...] = ()
    listed: Listed | None = None
    derived: bool = False  # made from other quantities, and not in the record
    recorded: bool = True

    @property
    def section(self) -> str:
        """The part of the record that holds it; empty for a key of the record itself."""
        return self.path.rpartition(".")[0]

    @property
    def key(self) -> str:
        """Its key in the section."""
        return self.path.rpartition(".")[2]


def show_everywhere(label: str, form: str, line: str) -> tuple[Show, ...]:
    """A quantity shown as `label` with its `form` in text (on the `line`), panel, notebook and page."""
    where = (("text", line), ("panel", label), ("notebook", label.lower()), ("page", label))
    return tuple(Show(place, row, f"; {label.lower()} {form}" if place == "text" else form) for place, row in where)


Q = Quantity
_HEADING = "attitude.heading_deg"
QUANTITIES: tuple[Quantity, ...] = (
    Q("position.frame", "", Located, lambda v: "enu", "`enu`: axes east, north, up at the terrain's origin",
      {"const": "enu"}),
    Q("position.terrain", "", Located, lambda v: v.terrain.name, "the terrain's name", TEXT),
    Q("position.east_m", "m", Located, lambda v: float(v.fix.position_enu_m[0]),
      "east of the camera's centre from the terrain's origin, posterior mean", NUMBER,
      columns=(Column("east_m", "%.4f"),),
      shown=(Show("summary", "east", "E {:.1f} m"), Show("text", "position", "E {:.2f} m"),
             Show("panel", "Position", "E {:.1f} m"), Show("notebook", "east", "{:.2f} m"),
             Show("page", "East", "{:,.2f} m")), listed=Listed("East", 1)),
    Q("position.north_m", "m", Located, lambda v: float(v.fix.position_enu_m[1]),
      "north of the camera's centre from the terrain's origin, posterior mean", NUMBER,
      columns=(Column("north_m", "%.4f"),),
      shown=(Show("summary", "north", "N {:.1f} m"), Show("text", "position", ", N {:.2f} m"),
             Show("panel", "Position", "   N {:.1f} m"), Show("notebook", "north", "{:.2f} m"),
             Show("page", "North", "{:,.2f} m")), listed=Listed("North", 1)),
    Q("position.up_m", "m", Located, lambda v: float(v.fix.position_enu_m[2]),
      "up of the camera's centre from the terrain's origin", NUMBER,
      columns=(Column("up_m", "%.4f"),),
      shown=(Show("text", "position", ", U {:.2f} m"), Show("notebook", "up", "{:.2f} m"),
             Show("page", "Up", "{:,.2f} m"))),
    Q("position.on", "", Located, lambda at: at("position.terrain"), "the terrain, after the coordinates", derived=True,
      shown=(Show("text", "position", " on {}"), Show("notebook", "on", "{}"))),
    Q("position.covariance_m2", "m^2", Located, lambda v: finite_or_none(v.fix.covariance_m2),
      "2 x 2, (east, north); this and the circles are null of a method that states none",
      {"type": "array", "items": numbers(2), "minItems": 2, "maxItems": 2}, nullable=True,
      columns=(Column("cov_east_east_m2", "%.6g", (0, 0)), Column("cov_east_north_m2", "%.6g", (0, 1)),
               Column("cov_north_north_m2", "%.6g", (1, 1)))),
    Q("position.sigma_east_m", "m", Located, sigma_m(0), "standard deviation of east", derived=True,
      shown=(Show("notebook", "east", " ± {:.2f} m"),)),
    Q("position.sigma_north_m", "m", Located, sigma_m(1), "standard deviation of north", derived=True,
      shown=(Show("notebook", "north", " ± {:.2f} m"),)),
    Q("position.ellipse", "m, m, deg", Located, ellipse, "one sigma: semi-axes, azimuth of the larger", derived=True,
      shown=(Show("text", "error", "sigma {0[0]:.2f} m by {0[1]:.2f} m"),
             Show("notebook", "one sigma", "{0[0]:.2f} m by {0[1]:.2f} m, long axis at azimuth {0[2]:.1f}°"),
             Show("page", "Sigma", "{0[0]:.2f} m by {0[1]:.2f} m"))),
    Q("position.radius95_m", "m", Located, lambda v: finite_or_none(v.fix.radius95_m),
      "circle about the position that holds 95 % of the posterior", POSITIVE, nullable=True,
      columns=(Column("radius95_m", "%.4f"),),
      shown=(Show("summary", "radius", "±{:.1f} m (95 %)"), Show("text", "error", "; within {:.1f} m (95 %)"),
             Show("panel", "Position", "   ±{:.1f} m (95 %)"), Show("notebook", "95 % within", "{:.1f} m"),
             Show("page", "95 % within", "{:,.1f} m")), listed=Listed("± 95 %", 1, always=True)),
    Q("position.radius999_m", "m", Located, lambda v: finite_or_none(v.fix.radius999_m),
      "circle about the position that holds 99.9 %", POSITIVE, nullable=True,
      columns=(Column("radius999_m", "%.4f"),),
      shown=(Show("text", "error", ", {:.1f} m (99.9 %)"), Show("notebook", "99.9 % within", "{:.1f} m"),
             Show("page", "99.9 % within", "{:,.1f} m"))),
    Q("position.latitude_deg", "deg", Located, latlon_deg(0), "of the same point", LATITUDE,
      columns=(Column("latitude_deg", "%.8f"),),
      shown=(Show("text", "position", "; latitude {:.6f}°"), Show("panel", "Lat, lon", "{:.5f}°"),
             Show("notebook", "latitude", "{:.6f}°"), Show("page", "Latitude", "{:.6f}°"))),
    Q("position.longitude_deg", "deg", Located, latlon_deg(1), "of the same point, east positive", LONGITUDE,
      columns=(Column("longitude_deg", "%.8f"),),
      shown=(Show("text", "position", ", longitude {:.6f}°"), Show("panel", "Lat, lon", "   {:.5f}°"),
             Show("notebook", "longitude", "{:.6f}°"), Show("page", "Longitude", "{:.6f}°"))),
    Q("position.evidence", "", Located, lambda v: v.evidence_source,
      "what the position is from: `stars`; `both`, the stars and the light of the sky that stops at the skyline; "
      "`sky`, that light alone", {"enum": ["stars", "both", "sky"]}, optional=True,
      columns=(Column("evidence", "%s"),),
      shown=(Show("text", "error", "; evidence {}"), Show("notebook", "evidence", "{}"),
             Show("page", "Evidence", "{}"))),
    Q("position.search", "", Located, lambda v: v.fix.search, "`proven`: the search has excluded every other position; "
      "`beam`: its budget ended before that, and the posterior near the best positions is stated; "
      "`approximate`: a method without a posterior",
      {"enum": ["proven", "beam", "approximate"]}, optional=True, columns=(Column("search", "%s"),),
      shown=(Show("text", "error", "; search {}"), Show("notebook", "search", "{}"), Show("page", "Search", "{}"))),
    Q("position.dropped_probability", "", Located, lambda v: v.fix.dropped_probability,
      "upper bound of the probability of the positions that the search left out; 1: not bounded; null: a "
      "method without a posterior", CHANCE, nullable=True, optional=True),
    Q("position.lacking", "", Located, lacking_circle, "the circle that is not stated", derived=True,
      shown=(Show("text", "error", "; {}"), Show("notebook", "95 % within", "{}"), Show("page", "95 % within", "{}"))),
    Q("position.caution", "", Located, caution_text, "of a method without a posterior", derived=True,
      shown=(Show("summary", "caution", "{}"), Show("panel", "Caution", "{}"))),
    Q("modes", "", Located, lambda v: [{"east_m": m.east_m, "north_m": m.north_m, "weight": m.weight}
                                       for m in v.fix.modes],
      "list of `east_m`, `north_m`, `weight`: the positions that fit, heaviest first; weights sum to 1. Ambiguous: "
      "modes outside the main mode's 99.9 % circle hold more than 1 %",
      {"type": "array", "items": record({"east_m": NUMBER, "north_m": NUMBER, "weight": CHANCE}), "minItems": 1}),
    Q("modes.text", "", Located, ambiguous_modes, "the positions that fit", derived=True,
      shown=(Show("summary", "modes", lambda m: f"{len(m)} positions fit: {modes_text(m)}"),
             Show("text", "places", modes_text))),
    Q("attitude.quat_xyzw_cam_icrs", "", Oriented, lambda v: quat_xyzw_from_R(v.attitude.R_cam_icrs).tolist(),
      "v_cam = R v_icrs, SciPy's order", QUATERNION,
      columns=tuple(Column(f"q{axis}_cam_icrs", "%.12f", (i,)) for i, axis in enumerate("xyzw"))),
    Q("attitude.ra_deg", "deg", Oriented, boresight_deg(0), "right ascension of the boresight", TURN,
      shown=(Show("summary", "ra", "RA {:.3f}°", _HEADING), Show("text", "boresight", "RA {:.4f}°"),
             Show("panel", "Boresight", "RA {:.3f}°", _HEADING), Show("notebook", "right ascension", "{:.4f}°"),
             Show("page", "Right ascension", "{:.4f}°"))),
    Q("attitude.dec_deg", "deg", Oriented, boresight_deg(1), "declination of the boresight", LATITUDE,
      shown=(Show("summary", "dec", "Dec {:+.3f}°", _HEADING), Show("text", "boresight", ", Dec {:+.4f}°"),
             Show("panel", "Boresight", "   Dec {:+.3f}°", _HEADING), Show("notebook", "declination", "{:.4f}°"),
             Show("page", "Declination", "{:.4f}°"))),
    Q("attitude.roll_deg", "deg", Oriented, boresight_deg(2),
      "position angle of the image's top, from north through east", TURN,
      shown=(Show("summary", "roll", "roll {:.3f}°", _HEADING), Show("text", "boresight", ", roll {:.4f}°"),
             Show("panel", "Boresight", "   roll {:.3f}°", _HEADING),
             Show("notebook", "roll", "{:.4f}° (image's top, from north through east)"),
             Show("page", "Image's top", "{:.4f}°"))),
    Q("attitude.sigma_arcsec", "arcsec", Oriented,
      lambda v: (np.sqrt(np.diag(v.attitude.covariance_rad2)) * ARCSEC_PER_RAD).tolist(),
      "of rotations about cam x, y, z: the errors of the stars, and of the lens where the camera has a `covariance`",
      numbers(3), columns=tuple(Column(f"sigma_{axis}_arcsec", "%.4f", (i,)) for i, axis in enumerate("xyz")),
      shown=(Show("text", "boresight", lambda s: f"; sigma {arcsec_text(s)} x, y, z"),
             Show("notebook", "sigma", lambda s: f"{arcsec_text(s)} cam x, y, z"),
             Show("page", "Sigma", lambda s: f"{arcsec_text(s)} x, y, z"))),
    Q("attitude.lens_error_included", "", Oriented, lambda v: v.camera.covariance is not None,
      "whether the camera has one; without it the lens is taken as exact, and the true error of the attitude is larger "
      "by the rotation that a wrong centre or focal length causes", FLAG, optional=True,
      shown=(Show("text", "boresight", exact_lens_text), Show("notebook", "sigma", exact_lens_text),
             Show("page", "Sigma", exact_lens_text))),
    Q("attitude.quat_xyzw_body_enu", "", Measured, lambda v: quat_xyzw_from_R(R_body_enu(v)).tolist(),
      "the rover's attitude, v_body = R v_enu; this and the following need terrain and time", QUATERNION,
      optional=True),
    Q(_HEADING, "deg", Measured, body_deg(0), "azimuth of body x", TURN, optional=True,
      columns=(Column("heading_deg", "%.6f"),),
      shown=(Show("summary", "heading", "heading {:.1f}°"), Show("text", "body", "heading {:.3f}°"),
             Show("panel", "Heading", "{:.2f}°"), Show("notebook", "heading", "{:.3f}°"),
             Show("page", "Heading", "{:.3f}°"))),
    Q("attitude.pitch_deg", "deg", Measured, body_deg(1), "nose up positive", LATITUDE, optional=True,
      columns=(Column("pitch_deg", "%.6f"),),
      shown=(Show("text", "body", ", pitch {:+.3f}°"), Show("panel", "Heading", "   pitch {:+.2f}°"),
             Show("notebook", "pitch", "{:.3f}°"), Show("page", "Pitch", "{:.3f}°"))),
    Q("attitude.roll_body_deg", "deg", Measured, body_deg(2), "right side down positive", LONGITUDE, optional=True,
      columns=(Column("roll_body_deg", "%.6f"),),
      shown=(Show("text", "body", ", roll {:+.3f}°"), Show("panel", "Heading", "   roll {:+.2f}°"),
             Show("notebook", "roll of the body", "{:.3f}°"), Show("page", "Roll", "{:.3f}°"))),
    Q("attitude.sigma_heading_deg", "deg", Measured, lambda v: float(body_sigmas_deg(v)[0]),
      "standard deviation of the heading, from the attitude's covariance", POSITIVE, optional=True,
      columns=(Column("sigma_heading_deg", "%.6f"),),
      shown=(Show("text", "body", "; sigma {:.5f}°"), Show("notebook", "heading", " ± {:.5f}°"),
             Show("page", "Heading", " ± {:.5f}°"))),
    Q("attitude.sigma_pitch_deg", "deg", Measured, lambda v: float(body_sigmas_deg(v)[1]),
      "standard deviation of the pitch", POSITIVE, optional=True, columns=(Column("sigma_pitch_deg", "%.6f"),),
      shown=(Show("text", "body", ", {:.5f}°"), Show("notebook", "pitch", " ± {:.5f}°"),
             Show("page", "Pitch", " ± {:.5f}°"))),
    Q("attitude.sigma_roll_body_deg", "deg", Measured, lambda v: float(body_sigmas_deg(v)[2]),
      "standard deviation of the roll", POSITIVE, optional=True, columns=(Column("sigma_roll_body_deg", "%.6f"),),
      shown=(Show("text", "body", ", {:.5f}°"), Show("notebook", "roll of the body", " ± {:.5f}°"),
             Show("page", "Roll", " ± {:.5f}°"))),
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
    Q("sky.brightness_mag_arcsec2", "mag/arcsec^2", Located, lambda v: v.sky_brightness_mag_arcsec2,
      "V of the sky beyond that of the ground at the skyline, by the camera's zero point and the exposure's duration; "
      "null where the image shows no step of light there, or one of the two is not known",
      NUMBER, nullable=True, columns=(Column("sky_mag_arcsec2", "%.4f"),),
      shown=show_everywhere("Sky", "{:.2f} mag/arcsec2", "evidence")),
    Q("sky.unused", "", Located, lambda v: v.sky_unused or None,
      "why the light of the sky is not evidence of the position; null: it is, or was not asked for", TEXT,
      nullable=True, optional=True, shown=(Show("text", "evidence", "; sky not used: {}"),)),
    Q("clock.offset_s", "s", Located, lambda v: None if v.fix.clock is None else v.fix.clock.offset_s,
      "true minus stated time, as the image shows it; null: not estimated", NUMBER, nullable=True,
      columns=(Column("clock_offset_s", "%.6g"),),
      shown=(Show("text", "clock", "offset {:+.3f} s"), Show("notebook", "clock", "{:+.3f} s"),
             Show("page", "Clock", "{:+.3f} s"))),
    Q("clock.sigma_s", "s", Located, lambda v: None if v.fix.clock is None else v.fix.clock.sigma_s,
      "standard deviation of the offset; null: not estimated", POSITIVE, nullable=True,
      columns=(Column("clock_sigma_s", "%.6g"),),
      shown=(Show("text", "clock", "; sigma {:.3f} s"), Show("notebook", "clock", " ± {:.3f} s"),
             Show("page", "Clock", " ± {:.3f} s"))),
    Q("provenance.version", "", Inputs, lambda v: __version__, "of startrack", TEXT),
    Q("provenance.image_sha256", "", Inputs, lambda v: v.exposure.sha256,
      "of the file; of an array: of its type, shape and values", TEXT, columns=(Column("image_sha256", "%s"),)),
    Q("provenance.camera", "", Inputs, lambda v: v.exposure.camera or (v.camera.name if v.camera is not None else None),
      "camera file or name", TEXT, before=None, columns=(Column("camera", "%s"),)),
    Q("provenance.terrain", "", Inputs,
      lambda v: v.exposure.terrain or (v.terrain.name if v.terrain is not None else None), "terrain file or name", TEXT,
      before=None, columns=(Column("terrain", "%s"),)),
    Q("provenance.catalog", "", Inputs, lambda v: v.catalog_name or None, "star catalogue", TEXT, before=None),
    Q("provenance.localizer", "", Inputs, lambda v: v.localizer_name or None,
      "method of localization, by its name for `--localizer`; of one of your own the name of its class or function; "
      "null: of `identify` and `detect`", TEXT, before=None, optional=True),
    Q("provenance.time_utc", "", Inputs,
      lambda v: None if v.exposure.time_utc is None else format_utc(v.exposure.time_utc),
      "middle of the exposure; null: not known", {"type": "string", "format": "date-time"}, before=None,
      columns=(Column("time_utc", "%s"),)),
    Q("provenance.time_sigma_s", "s", Inputs,
      lambda v: None if v.exposure.time_utc is None else v.exposure.time_sigma_s,
      "standard deviation of the clock's error, as stated, or 1; null: no time is known", POSITIVE, before=None,
      optional=True, columns=(Column("time_sigma_s", "%.9g"),)),
    Q("provenance.exposure_s", "s", Inputs, lambda v: v.exposure.exposure_s, "null: not known", NUMBER, before=None,
      columns=(Column("exposure_s", "%.9g"),)),
)  # fmt: skip
BY_PATH = {one.path: one for one in QUANTITIES}
# The batch's columns came in this order before the table did; a column that is not named here is appended.
FIRST_COLUMNS = (
    "time_utc", "exposure_s", "east_m", "north_m", "up_m", "cov_east_east_m2", "cov_east_north_m2",
    "cov_north_north_m2", "radius95_m", "radius999_m", "latitude_deg", "longitude_deg", "heading_deg", "pitch_deg",
    "roll_body_deg", "qx_cam_icrs", "qy_cam_icrs", "qz_cam_icrs", "qw_cam_icrs", "sigma_x_arcsec", "sigma_y_arcsec",
    "sigma_z_arcsec", "detected", "identified", "rms_px", "image_sha256",
)  # fmt: skip
