"""Output quantities of the position: coordinates, errors, search, and the positions that fit."""

from __future__ import annotations

from startrack.chain import Located
from startrack.localization.integrity import RISK
from startrack.output.quantity import Column, Listed, Quantity, Show
from startrack.output.schema_parts import (
    CHANCE,
    LATITUDE,
    LONGITUDE,
    NUMBER,
    POSITIVE,
    TEXT,
    Schema,
    numbers,
    or_null,
    record,
)  # fmt: skip
from startrack.output.values import (
    ambiguous_modes,
    carrying_azimuths,
    caution_text,
    dominant_fact,
    ellipse,
    finite_or_none,
    lacking_circle,
    latlon_deg,
    modes_record,
    modes_text,
    protection_level_m,
    ranges_text,
    sigma_m,
    unstated_record,
)  # fmt: skip

Q = Quantity
SEARCHES: Schema = {"enum": ["proven", "beam", "approximate"]}
UNSTATED = record({"fact": TEXT, "radius999_m_if_exact": POSITIVE})
MODE = record(
    {"east_m": NUMBER, "north_m": NUMBER, "weight": CHANCE},
    optional={
        "radius95_m": or_null(POSITIVE, "circle about it that holds 95 % of this mode; null: not stated"),
        "radius999_m": or_null(POSITIVE, "circle about it that holds 99.9 % of this mode"),
    },
)
POSITION: tuple[Quantity, ...] = (
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
    Q("position.protection_level_m", "m", Located, protection_level_m,
      "radius about the position beyond which the true one lies with probability `protection_risk` at most, also where "
      "the directions within 45 degrees of azimuth show something on no map; null: such a group alone holds the "
      "position in some direction, or a method without a posterior",
      POSITIVE, nullable=True, columns=(Column("protection_level_m", "%.4f"),),
      shown=(Show("text", "protection", "{:.1f} m"), Show("notebook", "protected", "{:.1f} m"),
             Show("page", "Protection level", "{:,.1f} m"))),
    Q("position.protection_risk", "", Located, lambda v: None if v.integrity is None else RISK,
      "probability of an error beyond `protection_level_m`", CHANCE, nullable=True, optional=True,
      shown=(Show("text", "protection", " (risk {:g})"),)),
    Q("position.carried_by", "deg", Located, carrying_azimuths,
      "list of [first, last] azimuths: the fewest of eight groups of directions that hold half of the information",
      {"type": "array", "items": numbers(2)}, nullable=True, optional=True,
      shown=(Show("text", "protection", lambda a: f"; carried by azimuths {ranges_text(a)}"),
             Show("page", "Carried by azimuths", ranges_text))),
    Q("position.unstated", "", Located, lambda v: unstated_record(v.fix),
      "list of `fact`, `radius999_m_if_exact`: facts that nobody states, each with the 99.9 % circle if it were stated "
      "and exact, the largest effect first", {"type": "array", "items": UNSTATED}, optional=True),
    Q("position.unstated_text", "", Located, dominant_fact, "the fact whose statement gains most", derived=True,
      shown=(Show("text", "error", " ({})"), Show("page", "99.9 % within, if stated", "{}"))),
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
      SEARCHES, optional=True, columns=(Column("search", "%s"),),
      shown=(Show("text", "error", "; search {}"), Show("notebook", "search", "{}"), Show("page", "Search", "{}"))),
    Q("position.dropped_probability", "", Located, lambda v: v.fix.dropped_probability,
      "upper bound of the probability of the positions that the search left out; 1: not bounded; null: a "
      "method without a posterior", CHANCE, nullable=True, optional=True),
    Q("position.lacking", "", Located, lacking_circle, "the circle that is not stated", derived=True,
      shown=(Show("text", "error", "; {}"), Show("notebook", "95 % within", "{}"), Show("page", "95 % within", "{}"))),
    Q("position.caution", "", Located, caution_text, "of a method without a posterior", derived=True,
      shown=(Show("summary", "caution", "{}"), Show("panel", "Caution", "{}"))),
    Q("modes", "", Located, lambda v: modes_record(v.fix),
      "list of `east_m`, `north_m`, `weight`, `radius95_m`, `radius999_m`: the positions that fit, heaviest first; "
      "weights sum to 1. The circles about each hold 95 and 99.9 % of that mode: the true position is in them if it is "
      "in this mode; null: not stated. Ambiguous: modes outside the main mode's 99.9 % circle hold more than 1 %",
      {"type": "array", "items": MODE, "minItems": 1}),
    Q("modes.text", "", Located, ambiguous_modes, "the positions that fit", derived=True,
      shown=(Show("summary", "modes", lambda m: f"{len(m)} positions fit: {modes_text(m)}"),
             Show("text", "places", modes_text))),
    Q("search.outcome", "", Located, lambda v: v.fix.search, "as `position.search`; also where several positions fit: "
      "`proven` is then the proof that no further position fits", SEARCHES,
      shown=(Show("text", "places", "; search {}", unless="position.search"),
             Show("page", "Search", "{}", unless="position.search"))),
    Q("search.dropped_probability", "", Located, lambda v: v.fix.dropped_probability,
      "as `position.dropped_probability`", CHANCE, nullable=True),
)  # fmt: skip
