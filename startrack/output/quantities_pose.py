"""Output quantities of the pose: position with its errors, the positions that fit, and attitude of camera and body."""

from __future__ import annotations

import numpy as np

from startrack.chain import Located, Measured, Oriented
from startrack.frames import quat_xyzw_from_R
from startrack.localization import RISK
from startrack.output import values
from startrack.output.middle import has_middle, in_middle, middle_px
from startrack.output.quantity import Listed, Quantity, Schema, Show, list_schema, object_schema, or_null

Q = Quantity
DEG_PER_RAD = 180.0 / np.pi
SEARCHES: Schema = {"enum": ["proven", "beam", "approximate"]}
UNSTATED = object_schema({"fact": "text", "radius999_m_if_exact": "positive"})
MODE = object_schema(
    {"east_m": "number", "north_m": "number", "weight": "chance"},
    optional={
        "radius95_m": or_null("positive", "circle about it that holds 95 % of this mode; null: not stated"),
        "radius999_m": or_null("positive", "circle about it that holds 99.9 % of this mode"),
    },
)
POSITION_QUANTITIES: tuple[Quantity, ...] = (
    Q("position.frame", "", values.has_position, lambda v: "enu", "`enu`: axes east, north, up at the terrain's origin",
      {"const": "enu"}),
    Q("position.terrain", "", values.has_position, lambda v: v.terrain.name, "the terrain's name", "text"),
    Q("position.east_m", "m", values.has_position, lambda v: float(v.fix.position_enu_m[0]),
      "east of the camera's centre from the terrain's origin, posterior mean", "number", form="%.4f",
      shown=(Show("summary", "east", "E {:.1f} m"), Show("text", "position", "E {:.2f} m"),
             Show("panel", "Position", "E {:.1f} m"), Show("notebook", "east", "{:.2f} m"),
             Show("page", "East", "{:,.2f} m")), listed=Listed("East", 1)),
    Q("position.north_m", "m", values.has_position, lambda v: float(v.fix.position_enu_m[1]),
      "north of the camera's centre from the terrain's origin, posterior mean", "number", form="%.4f",
      shown=(Show("summary", "north", "N {:.1f} m"), Show("text", "position", ", N {:.2f} m"),
             Show("panel", "Position", "   N {:.1f} m"), Show("notebook", "north", "{:.2f} m"),
             Show("page", "North", "{:,.2f} m")), listed=Listed("North", 1)),
    Q("position.up_m", "m", values.has_position, lambda v: float(v.fix.position_enu_m[2]),
      "up of the camera's centre from the terrain's origin", "number", form="%.4f",
      shown=(Show("text", "position", ", U {:.2f} m"), Show("notebook", "up", "{:.2f} m"),
             Show("page", "Up", "{:,.2f} m"))),
    Q("position.on", "", Located, lambda at: at("position.terrain"), "the terrain, after the coordinates", derived=True,
      shown=(Show("text", "position", " on {}"), Show("notebook", "on", "{}"))),
    Q("position.covariance_m2", "m^2", values.has_position, lambda v: values.finite_or_none(v.fix.covariance_m2),
      "2 x 2, (east, north); this and the circles are null of a method that states none",
      list_schema(list_schema("number", count=2), count=2), nullable=True, form="%.6g",
      columns={"cov_east_east_m2": (0, 0), "cov_east_north_m2": (0, 1), "cov_north_north_m2": (1, 1)}),
    Q("position.sigma_east_m", "m", Located, lambda at: values.sigma_m(at, 0), "standard deviation of east",
      derived=True, shown=(Show("notebook", "east", " ± {:.2f} m"),)),
    Q("position.sigma_north_m", "m", Located, lambda at: values.sigma_m(at, 1), "standard deviation of north",
      derived=True, shown=(Show("notebook", "north", " ± {:.2f} m"),)),
    Q("position.ellipse", "m, m, deg", Located, values.ellipse, "one sigma: semi-axes, azimuth of the larger",
      derived=True, shown=(Show("text", "error", "sigma {0[0]:.2f} m by {0[1]:.2f} m"),
             Show("notebook", "one sigma", "{0[0]:.2f} m by {0[1]:.2f} m, long axis at azimuth {0[2]:.1f}°"),
             Show("page", "Sigma", "{0[0]:.2f} m by {0[1]:.2f} m"))),
    Q("position.radius95_m", "m", values.has_position, lambda v: values.finite_or_none(v.fix.radius95_m),
      "circle about the position that holds 95 % of the posterior", "positive", nullable=True, form="%.4f",
      shown=(Show("summary", "radius", "±{:.1f} m (95 %)"), Show("text", "error", "; within {:.1f} m (95 %)"),
             Show("panel", "Position", "   ±{:.1f} m (95 %)"), Show("notebook", "95 % within", "{:.1f} m"),
             Show("page", "95 % within", "{:,.1f} m")), listed=Listed("± 95 %", 1, always=True)),
    Q("position.radius999_m", "m", values.has_position, lambda v: values.finite_or_none(v.fix.radius999_m),
      "circle about the position that holds 99.9 %", "positive", nullable=True, form="%.4f",
      shown=(Show("text", "error", ", {:.1f} m (99.9 %)"), Show("notebook", "99.9 % within", "{:.1f} m"),
             Show("page", "99.9 % within", "{:,.1f} m"))),
    Q("position.protection_level_m", "m", values.has_position,
      lambda v: None if v.fix.integrity is None else values.finite_or_none(v.fix.integrity.protection_level_m),
      "radius about the position beyond which the true one lies with probability `protection_risk` at most, also where "
      "the directions within 45 degrees of azimuth show something on no map; null: such a group alone holds the "
      "position in some direction, or a method without a posterior",
      "positive", nullable=True, form="%.4f",
      shown=(Show("text", "protection", "{:.1f} m"), Show("notebook", "protected", "{:.1f} m"),
             Show("page", "Protection level", "{:,.1f} m"))),
    Q("position.protection_risk", "", values.has_position, lambda v: None if v.fix.integrity is None else RISK,
      "probability of an error beyond `protection_level_m`", "chance", nullable=True, optional=True,
      shown=(Show("text", "protection", " (risk {:g})"),)),
    Q("position.carried_by", "deg", values.has_position, values.carrying_azimuths,
      "list of [first, last] azimuths: the fewest of eight groups of directions that hold half of the information",
      list_schema(list_schema("number", count=2)), nullable=True, optional=True,
      shown=(Show("text", "protection", lambda a: f"; carried by azimuths {values.ranges_text(a)}"),
             Show("page", "Carried by azimuths", values.ranges_text))),
    Q("position.unstated", "", values.has_position, lambda v: [
          {"fact": one.fact, "radius999_m_if_exact": round(one.radius999_m_if_exact, 6)} for one in v.fix.unstated],
      "list of `fact`, `radius999_m_if_exact`: facts that nobody states, each with the 99.9 % circle if it were stated "
      "and exact, the largest effect first", list_schema(UNSTATED), optional=True),
    Q("position.unstated_text", "", Located, values.dominant_fact, "the fact whose statement gains most", derived=True,
      shown=(Show("text", "error", " ({})"), Show("page", "99.9 % within, if stated", "{}"))),
    Q("position.latitude_deg", "deg", values.has_position, values.latlon_deg(0), "of the same point", "latitude",
      form="%.8f", shown=(Show("text", "position", "; latitude {:.6f}°"), Show("panel", "Lat, lon", "{:.5f}°"),
             Show("notebook page", "latitude", "{:.6f}°"))),
    Q("position.longitude_deg", "deg", values.has_position, values.latlon_deg(1), "of the same point, east positive",
      "longitude", form="%.8f",
      shown=(Show("text", "position", ", longitude {:.6f}°"), Show("panel", "Lat, lon", "   {:.5f}°"),
             Show("notebook page", "longitude", "{:.6f}°"))),
    Q("position.evidence", "", values.has_position, lambda v: v.evidence_source,
      "what the position is from: `stars`; `both`, the stars and the light of the sky that stops at the skyline; "
      "`sky`, that light alone", {"enum": ["stars", "both", "sky"]}, optional=True, form="%s",
      shown=(Show("text", "error", "; evidence {}"), Show("notebook page", "evidence", "{}"))),
    Q("position.search", "", values.has_position, lambda v: v.fix.search,
      "`proven`: the search has excluded every other position; "
      "`beam`: its budget ended before that, and the posterior near the best positions is stated; "
      "`approximate`: a method without a posterior",
      SEARCHES, optional=True, form="%s",
      shown=(Show("text", "error", "; search {}"), Show("notebook page", "search", "{}"))),
    Q("position.dropped_probability", "", values.has_position, lambda v: v.fix.dropped_probability,
      "upper bound of the probability of the positions that the search left out; null: no bound below 1 is known, as "
      "of most searches that end as `beam`, or a method without a posterior", "chance", nullable=True, optional=True),
    Q("position.lacking", "", Located, values.lacking_circle, "the circle that is not stated", derived=True,
      shown=(Show("text", "error", "; {}"), Show("notebook page", "95 % within", "{}"))),
    Q("position.caution", "", Located, values.caution_text, "of a method without a posterior", derived=True,
      shown=(Show("summary", "caution", "{}"), Show("panel", "Caution", "{}"))),
    Q("modes", "", Located, lambda v: values.modes_record(v.fix),
      "list of `east_m`, `north_m`, `weight`, `radius95_m`, `radius999_m`: the positions that fit, heaviest first; "
      "weights sum to 1. The circles about each hold 95 and 99.9 % of that mode: the true position is in them if it is "
      "in this mode; null: not stated. Ambiguous: modes outside the main mode's 99.9 % circle hold more than 1 %",
      {"type": "array", "items": MODE}, before=[]),
    Q("modes.text", "", Located, lambda at: (at("modes") or None) if at("position.east_m") is None else None,
      "the positions that fit", derived=True,
      shown=(Show("summary", "modes", lambda m: f"{len(m)} positions fit: {values.modes_text(m)}"),
             Show("text", "places", values.modes_text))),
    Q("search.outcome", "", Located, lambda v: v.fix.search, "as `position.search`; also where several positions fit: "
      "`proven` is then the proof that no further position fits", SEARCHES,
      shown=(Show("summary", "search", lambda search: "search: beam" if search == "beam" else ""),
             Show("text", "places", "; search {}", unless="position.search"),
             Show("page", "Search", "{}", unless="position.search"))),
    Q("search.dropped_probability", "", Located, lambda v: v.fix.dropped_probability,
      "as `position.dropped_probability`", "chance", nullable=True),
)  # fmt: skip
_ARCSEC = "{0[0]:.2f}, {0[1]:.2f}, {0[2]:.2f} arcsec about"
_HEADING = "attitude.heading_deg"
_SHOWN = f"{_HEADING} middle.ra_deg"  # in place of the boresight
ATTITUDE_QUANTITIES: tuple[Quantity, ...] = (
    Q("attitude.quat_xyzw_cam_icrs", "", Oriented, lambda v: quat_xyzw_from_R(v.attitude.R_cam_icrs).tolist(),
      "v_cam = R v_icrs, SciPy's order", "quaternion",
      form="%.12f", columns={f"q{axis}_cam_icrs": (i,) for i, axis in enumerate("xyzw")}),
    Q("attitude.ra_deg", "deg", Oriented, values.boresight_deg(0), "right ascension of the boresight", "turn",
      shown=(Show("summary", "ra", "RA {:.3f}°", _SHOWN), Show("text", "boresight", "RA {:.4f}°"),
             Show("panel", "Boresight", "RA {:.3f}°", _SHOWN), Show("notebook page", "right ascension", "{:.4f}°"))),
    Q("attitude.dec_deg", "deg", Oriented, values.boresight_deg(1), "declination of the boresight", "latitude",
      shown=(Show("summary", "dec", "Dec {:+.3f}°", _SHOWN), Show("text", "boresight", ", Dec {:+.4f}°"),
             Show("panel", "Boresight", "   Dec {:+.3f}°", _SHOWN), Show("notebook page", "declination", "{:.4f}°"))),
    Q("attitude.roll_deg", "deg", Oriented, values.boresight_deg(2),
      "position angle of the image's top, from north through east", "turn",
      shown=(Show("summary", "roll", "roll {:.3f}°", _SHOWN), Show("text", "boresight", ", roll {:.4f}°"),
             Show("panel", "Boresight", "   roll {:.3f}°", _SHOWN),
             Show("notebook", "roll", "{:.4f}° (image's top, from north through east)"),
             Show("page", "Image's top", "{:.4f}°"))),
    Q("attitude.sigma_arcsec", "arcsec", Oriented,
      lambda v: (np.sqrt(np.diag(v.attitude.covariance_rad2)) * values.ARCSEC_PER_RAD).tolist(),
      "of rotations about cam x, y, z: the errors of the stars, and of the lens where the camera has a `covariance`",
      list_schema("number", count=3), form="%.4f",
      columns={f"sigma_{axis}_arcsec": (i,) for i, axis in enumerate("xyz")},
      shown=(Show("text", "boresight", f"; sigma {_ARCSEC} x, y, z"),
             Show("notebook", "sigma", f"{_ARCSEC} cam x, y, z"),
             Show("page", "Sigma", f"{_ARCSEC} x, y, z"))),
    Q("attitude.lens_error_included", "", Oriented, lambda v: v.camera.covariance is not None,
      "whether the camera has one; without it the lens is taken as exact, and the true error of the attitude is larger "
      "by the rotation that a wrong centre or focal length causes", "flag", optional=True,
      shown=(Show("text", "boresight", values.exact_lens_text),
             Show("notebook page", "sigma", values.exact_lens_text))),
    Q("attitude.quat_xyzw_body_enu", "", Measured, lambda v: quat_xyzw_from_R(values.R_body_enu(v)).tolist(),
      "the rover's attitude, v_body = R v_enu; this and the following need terrain and time", "quaternion",
      before=None, optional=True),
    Q(_HEADING, "deg", Measured, values.body_deg(0), "azimuth of body x", "turn", before=None, optional=True,
      form="%.6f",
      shown=(Show("summary", "heading", "heading {:.1f}°"), Show("text", "body", "heading {:.3f}°"),
             Show("panel", "Heading", "{:.2f}°"), Show("notebook page", "heading", "{:.3f}°"))),
    Q("attitude.pitch_deg", "deg", Measured, values.body_deg(1), "nose up positive", "latitude", before=None,
      optional=True, form="%.6f",
      shown=(Show("text", "body", ", pitch {:+.3f}°"), Show("panel", "Heading", "   pitch {:+.2f}°"),
             Show("notebook page", "pitch", "{:.3f}°"))),
    Q("attitude.roll_body_deg", "deg", Measured, values.body_deg(2), "right side down positive", "longitude",
      before=None, optional=True, form="%.6f",
      shown=(Show("text", "body", ", roll {:+.3f}°"), Show("panel", "Heading", "   roll {:+.2f}°"),
             Show("notebook", "roll of the body", "{:.3f}°"), Show("page", "Roll", "{:.3f}°"))),
    Q("attitude.sigma_heading_deg", "deg", Measured, lambda v: float(values.body_sigmas_deg(v)[0]),
      "standard deviation of the heading, from the attitude's covariance", "positive", before=None,
      optional=True, form="%.6f",
      shown=(Show("text", "body", "; sigma {:.5f}°"), Show("notebook page", "heading", " ± {:.5f}°"))),
    Q("attitude.sigma_pitch_deg", "deg", Measured, lambda v: float(values.body_sigmas_deg(v)[1]),
      "standard deviation of the pitch", "positive", before=None, optional=True, form="%.6f",
      shown=(Show("text", "body", ", {:.5f}°"), Show("notebook page", "pitch", " ± {:.5f}°"))),
    Q("attitude.sigma_roll_body_deg", "deg", Measured, lambda v: float(values.body_sigmas_deg(v)[2]),
      "standard deviation of the roll", "positive", before=None, optional=True, form="%.6f",
      shown=(Show("text", "body", ", {:.5f}°"), Show("notebook", "roll of the body", " ± {:.5f}°"),
             Show("page", "Roll", " ± {:.5f}°"))),
)  # fmt: skip
MIDDLE_QUANTITIES: tuple[Quantity, ...] = (
    Q("middle.x_px", "px", has_middle, lambda v: float(middle_px(v)[0]),
      "pixel of the picture's middle, (width - 1) / 2: pixel centres are at integers; `middle` is null where "
      "it is beyond the lens", "number"),
    Q("middle.y_px", "px", has_middle, lambda v: float(middle_px(v)[1]), "likewise, (height - 1) / 2", "number"),
    Q("middle.ra_deg", "deg", has_middle, in_middle("ra_rad", DEG_PER_RAD),
      "right ascension there, ICRS as in the catalogue: without aberration and refraction", "turn", form="%.7f",
      columns={"middle_ra_deg": ()},
      shown=(Show("summary", "ra", "RA {:.4f}°", _HEADING), Show("text", "middle", "RA {:.4f}°"),
             Show("panel", "Middle", "RA {:.4f}°", _HEADING), Show("notebook page", "middle", "RA {:.4f}°"))),
    Q("middle.dec_deg", "deg", has_middle, in_middle("dec_rad", DEG_PER_RAD), "declination there", "latitude",
      form="%.7f", columns={"middle_dec_deg": ()},
      shown=(Show("summary", "dec", "Dec {:+.4f}°", _HEADING), Show("text", "middle", ", Dec {:+.4f}°"),
             Show("panel", "Middle", "   Dec {:+.4f}°", _HEADING), Show("notebook page", "middle", ", Dec {:+.4f}°"))),
    Q("middle.sigma_deg", "deg", has_middle, in_middle("sigma_rad", DEG_PER_RAD),
      "standard deviation of this direction per axis: the errors of attitude and lens together, which nearly cancel "
      "where the lens was fitted to the picture's own stars", "positive", form="%.7f",
      columns={"middle_sigma_deg": ()},
      shown=(Show("summary", "dec", " ± {:.2g}°", _HEADING), Show("text", "middle", " ± {:.2g}°"),
             Show("panel", "Middle", " ± {:.2g}°", _HEADING), Show("notebook page", "middle", " ± {:.2g}°"))),
    Q("middle.scale_arcsec_per_px", "arcsec/px", has_middle, in_middle("scale_rad_per_px", values.ARCSEC_PER_RAD),
      "size of a pixel there", "positive", form="%.5f",
      columns={"middle_scale_arcsec_per_px": ()},
      shown=(Show("summary", "scale", '{:.4g}"/px', _HEADING), Show("text", "middle", ", {:.5g} arcsec/px"),
             Show("notebook page", "scale in the middle", "{:.5g} arcsec/px"))),
    Q("middle.rotation_deg", "deg", has_middle, in_middle("rotation_rad", DEG_PER_RAD),
      "position angle of image up there, from north through east", "turn", form="%.6f",
      columns={"middle_rotation_deg": ()},
      shown=(Show("summary", "up", "up {:.2f}°", _HEADING), Show("text", "middle", ", up at {:.3f}°"),
             Show("panel", "Image up", "{:.2f}°", _HEADING),
             Show("notebook page", "up in the middle", "{:.3f}° from north through east"))),
)  # fmt: skip
