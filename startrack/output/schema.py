"""JSON schemas (draft 2020-12) of the files that startrack reads and writes."""

from __future__ import annotations

from startrack.camera import camera_keys
from startrack.chain import STAGES
from startrack.core.errors import Reason
from startrack.exposure import SIDECAR as SIDECAR_KEYS
from startrack.output.quantities import BY_PATH, QUANTITIES
from startrack.output.quantity import (
    Schema,
    file_schema,
    list_schema,
    object_schema,
    or_null,
    schema_of,
    schema_of_kind,
)
from startrack.output.record import FORMATS, KINDS
from startrack.terrain import MAKERS, TERRAIN_KEYS

TERRAIN_FILE: Schema = TERRAIN_KEYS.schema() | {"oneOf": [{"required": [ground]} for ground in MAKERS]}
REFUSALS = [one.value for one in Reason if one is not Reason.AMBIGUOUS]
SECTIONS = {
    name: schema_of(QUANTITIES, name, description)
    for name, description in {
        "position": "The camera's centre. covariance_m2 is of (east, north).",
        "search": "How far other positions are excluded.",
        "attitude": "Of the camera among the stars and, with terrain and time, of the rover's body.",
        "middle": "The sky at the middle of the picture.",
        "evidence": "What is left out of the evidence, and why.",
        "sky": "Diffuse light of the sky.",
        "clock": "Error of the stated time.",
        "stars": "",
        "provenance": "",
    }.items()
}
COMMON: Schema = {
    "image": "text",
    "status": {"enum": ["ok", "ambiguous", "refused"]},
    "reason": {"enum": [None, *(one.value for one in Reason)]},
    "message": "text",
}
NULL: Schema = {"const": None}
ADVICE = "what to do next, by the reason"


def _section_or_null(schema: Schema) -> Schema:
    """The `schema` of an object or null. A list of types, so that a validator names what is wrong with the object."""
    return {**schema, "type": ["object", "null"]}


def _has(*keys: str, **others: Schema) -> Schema:
    """A record has the sections `keys`, and the `others` fit their schemas where they are there."""
    return {"properties": {key: {"type": "object"} for key in keys} | others, "required": [*keys]}


def _if_status(status: str, then: Schema) -> Schema:
    return {"if": {"properties": {"status": {"const": status}}}, "then": then}


def _schema_of_key(key: str) -> Schema:
    """The schema of a `key` of a record, a section or a quantity."""
    if key in SECTIONS:
        return _section_or_null(SECTIONS[key])
    one = BY_PATH[key]
    schema = schema_of_kind(one.schema, one.description)
    return _section_or_null(schema) if one.nullable else schema


def _result(kind: str, title: str, rules: list[Schema]) -> Schema:
    """The schema of the records of a `kind`; keys beyond the common ones are absent from refusals of old versions."""
    keys = {"format": {"const": FORMATS[kind]}, **COMMON}
    more = {
        "advice": or_null("text", f"{ADVICE}; null: solved"),
        **{key: _schema_of_key(key) for key in KINDS[kind]},
        "timing_ms": _section_or_null(object_schema(dict.fromkeys(STAGES, "positive"))),
        "provenance": _schema_of_key("provenance"),
        "warnings": list_schema("text", "what was found in the image's file and not used"),
    }
    of_stages = ("stars", "timing_ms", "provenance")
    by_status = [
        _if_status("ok", _has(*of_stages, reason=NULL, advice=NULL)),
        _if_status("ambiguous", _has(*of_stages, reason={"const": "ambiguous"})),
        _if_status("refused", {"properties": {"reason": {"enum": REFUSALS}}}),
    ]
    return file_schema(title, object_schema(keys, optional=more) | {"allOf": [*by_status, *rules]})


HORIZON = object_schema(
    {
        "format": {"const": "startrack.horizon/1"},
        "status": {"enum": ["ok", "refused"]},
        "reason": COMMON["reason"],
        "message": "text",
    },
    optional={
        "advice": schema_of_kind("text", ADVICE),
        "output": "text",
        "files": list_schema("text"),
        "images": list_schema("text"),
        "left_out": list_schema(object_schema({"image": "text", "reason": {"enum": REFUSALS}, "message": "text"})),
        "azimuths": object_schema(dict.fromkeys(("known", "stars", "sky_light", "both", "varies"), "count")),
        "median_sigma_deg": or_null("positive", "of the known azimuths"),
        "lowest_deg": or_null("number", "apparent elevation"),
        "highest_deg": or_null("number", "apparent elevation"),
    },
)
_HORIZON_RULES = [
    _if_status(
        "ok", {"properties": {"reason": {"const": None}}, "required": ["output", "files", "images", "azimuths"]}
    ),
    _if_status("refused", {"properties": {"reason": {"enum": REFUSALS}}}),
]

SCHEMAS: dict[str, Schema] = {
    "fix": _result(
        "fix",
        "Position and attitude of one image",
        [
            _if_status("ok", _has("position", "attitude")),
            _if_status("ambiguous", _has("attitude", position=NULL, modes={"minItems": 1})),
            _if_status("ambiguous", {"required": ["modes"]}),
            _if_status("refused", {"properties": {"position": NULL}}),
        ],
    ),
    "identification": _result(
        "identification",
        "Stars and attitude of one image",
        [_if_status("ok", _has("attitude", "camera")), _if_status("ok", {"required": ["matches"]})],
    ),
    "detection": _result("detections", "Point sources of one image", [_if_status("ok", {"required": ["detections"]})]),
    "horizon": file_schema("Summary of a measured skyline", HORIZON | {"allOf": _HORIZON_RULES}),
    "truth": file_schema(
        "What is true of a rendered image, for tests and scorers",
        object_schema({"position_enu_m": list_schema("number", count=3), "quat_xyzw_cam_icrs": "quaternion"})
        | {"additionalProperties": True},
    ),
    "sidecar": file_schema("Facts beside an image", SIDECAR_KEYS.schema()),
    "camera": file_schema("Camera file", camera_keys().schema()),
    "terrain": file_schema("Terrain file", TERRAIN_FILE),
}
