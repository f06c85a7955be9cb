"""JSON schemas (draft 2020-12) of the files that startrack reads and writes."""

from __future__ import annotations

from typing import Any

from startrack.output.record import FORMATS, STAGES
from startrack.output.schema_inputs import CAMERA, SIDECAR, TERRAIN
from startrack.output.schema_parts import NUMBER, QUATERNION, TEXT, numbers, record, schema

Schema = dict[str, Any]
POSITIVE: Schema = {"type": "number", "minimum": 0}
COUNT: Schema = {"type": "integer", "minimum": 0}
CHANCE: Schema = {"type": "number", "minimum": 0, "maximum": 1}
REASONS = (
    "bad_image",
    "size_mismatch",
    "no_time",
    "no_calibration",
    "bad_calibration",
    "bad_terrain",
    "no_stars",
    "not_identified",
    "mirrored",
    "insufficient_geometry",
    "outside_search_area",
    "inconsistent_evidence",
)


def _or_null(one: Schema, why: str) -> Schema:
    return {"anyOf": [one, {"type": "null"}], "description": why}


def _part_of(whole: Schema) -> Schema:
    """A schema as a part of another: only the whole names its dialect."""
    return {key: value for key, value in whole.items() if key != "$schema"}


POSITION = record(
    {
        "frame": {"const": "enu"},
        "terrain": TEXT,
        "east_m": NUMBER,
        "north_m": NUMBER,
        "up_m": NUMBER,
        "covariance_m2": {"type": "array", "items": numbers(2), "minItems": 2, "maxItems": 2},
        "radius95_m": POSITIVE,
        "radius999_m": POSITIVE,
        "latitude_deg": {"type": "number", "minimum": -90, "maximum": 90},
        "longitude_deg": {"type": "number", "minimum": -180, "maximum": 180},
    },
    "The camera's centre. covariance_m2 is of (east, north); the circles hold 95 and 99.9 % of the posterior.",
)
MODES: Schema = {
    "type": "array",
    "items": record({"east_m": NUMBER, "north_m": NUMBER, "weight": CHANCE}),
    "minItems": 1,
    "description": "Places that fit, heaviest first; weights sum to 1.",
}
ATTITUDE = record(
    {
        "quat_xyzw_cam_icrs": QUATERNION,
        "ra_deg": {"type": "number", "minimum": 0, "exclusiveMaximum": 360},
        "dec_deg": {"type": "number", "minimum": -90, "maximum": 90},
        "roll_deg": {"type": "number", "minimum": 0, "exclusiveMaximum": 360},
        "sigma_arcsec": {**numbers(3), "description": "rotations about cam x, y, z"},
    },
    "v_cam = R v_icrs; ra, dec: boresight; roll: position angle of the image's top, from north through east. "
    "heading: azimuth of body x; pitch: nose up; roll_body: right side down. Fields in enu need terrain and time.",
    optional={
        "lens_error_included": {
            "type": "boolean",
            "description": "whether sigma_arcsec holds the lens's errors: the camera has a covariance",
        },
        "quat_xyzw_body_enu": QUATERNION,
        "heading_deg": {"type": "number", "minimum": 0, "exclusiveMaximum": 360},
        "pitch_deg": {"type": "number", "minimum": -90, "maximum": 90},
        "roll_body_deg": {"type": "number", "minimum": -180, "maximum": 180},
    },
)
STARS = record({
    "detected": COUNT,
    "identified": COUNT,
    "unexplained": _or_null(COUNT, "significant detections that no star explains; null: not identified"),
    "predicted_visible": _or_null(
        COUNT, "measured stars above the skyline of the fix; 0 without a fix; null: none was asked for"
    ),
    "rms_px": _or_null(POSITIVE, "per axis, of the stars that the attitude rests on; null: not identified"),
    "false_alarm_probability": _or_null(CHANCE, "that chance would match as well; null: not identified"),
})  # fmt: skip
PROVENANCE = record({
    "version": TEXT,
    "image_sha256": TEXT,
    "camera": _or_null(TEXT, "camera file or name"),
    "terrain": _or_null(TEXT, "terrain file or name"),
    "catalog": _or_null(TEXT, "star catalogue"),
    "time_utc": _or_null({"type": "string", "format": "date-time"}, "middle of the exposure; null: not known"),
    "exposure_s": _or_null(NUMBER, "seconds; null: not known"),
})  # fmt: skip
COMMON: Schema = {
    "image": TEXT,
    "status": {"enum": ["ok", "ambiguous", "refused"]},
    "reason": {"enum": [None, "ambiguous", *REASONS]},
    "message": TEXT,
}
# An image that could not even be read has no more than the common keys.
MEASURED: Schema = {"stars": STARS, "timing_ms": record(dict.fromkeys(STAGES, POSITIVE)), "provenance": PROVENANCE}

WARNINGS: Schema = {"type": "array", "items": TEXT, "description": "what was found in the image's file and not used"}


def _result(kind: str, title: str, own: Schema, rules: list[Schema]) -> Schema:
    keys = {"format": {"const": FORMATS[kind]}, **COMMON}
    return schema(
        title, record(keys, optional={**own, **MEASURED, "warnings": WARNINGS}) | {"allOf": [*_STATUS_RULES, *rules]}
    )


def _when(status: str, then: Schema) -> Schema:
    return {"if": {"properties": {"status": {"const": status}}}, "then": then}


_STATUS_RULES = [
    _when("ok", {"properties": {"reason": {"const": None}}, "required": [*MEASURED]}),
    _when("ambiguous", {"properties": {"reason": {"const": "ambiguous"}}, "required": [*MEASURED]}),
    _when("refused", {"properties": {"reason": {"enum": [*REASONS]}}}),
]
_FIX_RULES = [
    _when("ok", {"required": ["position", "attitude"]}),
    _when("ambiguous", {"required": ["modes", "attitude"], "properties": {"position": False}}),
    _when("refused", {"properties": {"position": False}}),
]
MATCH = record({
    "hip": _or_null({"type": "integer", "minimum": 1}, "Hipparcos number; null: the star has none"),
    "x_px": NUMBER,
    "y_px": NUMBER,
})  # fmt: skip
DETECTION = record({"x_px": NUMBER, "y_px": NUMBER, "flux_e": NUMBER, "snr": NUMBER})

SCHEMAS: dict[str, Schema] = {
    "fix": _result(
        "fix",
        "Position and attitude of one image",
        {"position": POSITION, "modes": MODES, "attitude": ATTITUDE},
        _FIX_RULES,
    ),
    "identification": _result(
        "identification",
        "Stars and attitude of one image",
        {"attitude": ATTITUDE, "camera": _part_of(CAMERA), "matches": {"type": "array", "items": MATCH}},
        [_when("ok", {"required": ["attitude", "camera", "matches"]})],
    ),
    "detection": _result(
        "detection",
        "Point sources of one image",
        {"detections": {"type": "array", "items": DETECTION}},
        [_when("ok", {"required": ["detections"]})],
    ),
    "truth": schema(
        "What is true of a rendered image, for tests and scorers",
        record({"position_enu_m": numbers(3), "quat_xyzw_cam_icrs": QUATERNION}) | {"additionalProperties": True},
    ),
    "sidecar": SIDECAR,
    "camera": CAMERA,
    "terrain": TERRAIN,
}
