"""The table of predicted quantities: bands of predict.tif, columns of predict.ecsv, keys of the summary."""

from __future__ import annotations

from dataclasses import dataclass

from startrack.output.schema_parts import CHANCE, COUNT, NUMBER, POSITIVE, TEXT, Schema, or_null, record, schema

FORMAT = "startrack.prediction/1"
SHARES_M = (5, 10, 20)  # radii of which the summary has the share of the area


@dataclass(frozen=True)
class CellQuantity:
    """One predicted quantity of a place: a band and a column."""

    name: str
    unit: str  # as astropy spells it; empty for pure numbers
    form: str  # printf format
    description: str


CELL_QUANTITIES = (
    CellQuantity("radius95_m", "m", "%.6g", "median over the draws of the 95 % radius; a draw without a position "
                 "counts as infinite; empty: half of the draws or more have no position"),
    CellQuantity("p_ok", "", "%.6g", "share of the draws that have one position"),
    CellQuantity("p_ambiguous", "", "%.6g", "share of the draws that several positions fit"),
    CellQuantity("p_refused", "", "%.6g", "share of the draws that are refused"),
    CellQuantity("sigma_major_m", "m", "%.6g", "standard deviation along the long axis of the error ellipse: "
                 "of the mean covariance of the draws that have one position"),
    CellQuantity("sigma_minor_m", "m", "%.6g", "standard deviation across it"),
    CellQuantity("azimuth_deg", "deg", "%.6g", "azimuth of the long axis, from 0 to 180"),
)  # fmt: skip

FILTERED, SMOOTHED = "radius95_filtered_m", "radius95_smoothed_m"
PATH_QUANTITIES = (  # beside the others, along a path with odometry
    CellQuantity(FILTERED, "m", "%.6g", "95 % radius of the position by the images so far and the odometry between "
                 "them; empty before the first image with a position"),
    CellQuantity(SMOOTHED, "m", "%.6g", "the same by all images of the path"),
)  # fmt: skip

ERROR_RATIO = "error_ratio"
SHARE_KEYS = {f"share_below_{bound}_m": bound for bound in SHARES_M}
SUMMARY: Schema = record(
    {
        "median_radius95_m": or_null(POSITIVE, "over the places; null: half of the places or more have no radius"),
        **{
            key: {**CHANCE, "description": f"of the places: those with radius95_m below {bound} m"}
            for key, bound in SHARE_KEYS.items()
        },
        **{name: {**CHANCE, "description": "mean over the places"} for name in ("p_ok", "p_ambiguous", "p_refused")},
        ERROR_RATIO: or_null(
            POSITIVE,
            "errors of the draws over the stated ones, root mean square over the places: near 1 where the stated ones "
            "are right; null: no draw has a position",
        ),
    }
)
VARIANT: Schema = record(
    {
        "camera": TEXT,
        "exposure_s": POSITIVE,
        "limiting_v_mag": {**NUMBER, "description": "of a star on the axis at 5 sigma"},
        "summary": SUMMARY,
    }
)
DEPTH: Schema = record(
    {
        "target_radius95_m": POSITIVE,
        "share": {**CHANCE, "description": "of the places that must reach the target"},
        "exposure_s": or_null(POSITIVE, "shortest that reaches the target; null: none within the limits"),
        "limiting_v_mag": or_null(NUMBER, "of this exposure: a star on the axis at 5 sigma"),
        "tried": {"type": "array", "items": record({"exposure_s": POSITIVE, "share": CHANCE})},
    }
)
ALONG_PATH: Schema = record(
    {
        "sigma": {**NUMBER, "description": "error of a move on each axis, as a part of its length"},
        "floor_m": {**NUMBER, "description": "beside that, in quadrature"},
        f"median_{FILTERED}": or_null(POSITIVE, "over the places; null: half of the places or more have no radius"),
        f"median_{SMOOTHED}": or_null(POSITIVE, "the same, by all images"),
    }
)
INPUTS: Schema = {
    "type": "object",
    "additionalProperties": TEXT,
    "description": "SHA-256 of the camera's, terrain's and map files by name; shipped ones belong to the version",
}
PREDICTION = schema(
    "Summary of expected accuracy",
    record(
        {
            "format": {"const": FORMAT},
            "kind": {"enum": ["area", "path"]},
            "terrain": TEXT,
            "camera": TEXT,
            "first_time_utc": {"type": "string", "format": "date-time"},
            "last_time_utc": {"type": "string", "format": "date-time"},
            "exposure_s": POSITIVE,
            "limiting_v_mag": VARIANT["properties"]["limiting_v_mag"],
            "sky_mag_arcsec2": NUMBER,
            "spacing_m": POSITIVE,
            "places": COUNT,
            "draws": COUNT,
            "seed": COUNT,
            "localizer": TEXT,
            "summary": SUMMARY,
            "provenance": record({"version": TEXT, "inputs": INPUTS}),
        },
        optional={"variants": {"type": "array", "items": VARIANT}, "depth": DEPTH, "odometry": ALONG_PATH},
    ),
)  # fmt: skip
