"""Results as plain dictionaries, ready for JSON: fix, identification, detections; and JSON schemas of all files.

The keys are a public format. Schemas are of draft 2020-12.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from startrack.camera import camera_keys
from startrack.chain import STAGES, Inputs, Outcome, last_value
from startrack.core import __version__
from startrack.core.errors import Reason
from startrack.core.types import Exposure
from startrack.exposure import SIDECAR as SIDECAR_KEYS
from startrack.kernels.library import LEVEL
from startrack.output.quantities import BY_PATH, QUANTITIES
from startrack.output.quantity import (
    Quantity,
    Schema,
    file_schema,
    list_schema,
    object_schema,
    or_null,
    record_from,
    schema_of,
    schema_of_kind,
)
from startrack.output.values import At
from startrack.terrain import GROUNDS, TERRAIN_KEYS

KINDS = {  # of the files NAME.KIND.json: what their records have of a result, in this order
    "fix": ("position", "modes", "search", "attitude", "middle", "explain", "stars", "bodies", "evidence", "sky",
            "clock"),
    "identification": ("attitude", "middle", "camera", "matches", "stars", "bodies"),
    "detections": ("detections", "stars"),
}  # fmt: skip
FORMATS = {kind: f"startrack.{kind.removesuffix('s')}/1" for kind in KINDS}


def result_dict(result: Outcome, kind: str = "fix") -> dict[str, Any]:
    """The record of one image, of its `result`: the keys of a `kind` are the same whether it is solved or refused.

    A section is null where nothing of it is known: `position` unless the status is ok. Lists are then empty. Quantities
    of stages that have not run are null: those in `enu` without terrain and time.
    """
    record = _record(kind, image_name(result.exposure), result.reason, result.message, last_value(result))
    timing_ms = {stage: round(result.timing_ms.get(stage, 0.0), 3) for stage in STAGES}
    return record | {"status": result.status, "timing_ms": timing_ms, "warnings": result.warnings}


def refused_dict(
    image: str, reason: str, message: str, kind: str = "fix", image_sha256: str | None = None
) -> dict[str, Any]:
    """The record of an `image` that could not be read, or whose camera or terrain could not: `reason` and `message`.

    `kind` is one of KINDS; `image_sha256` that of the file, if it is known.
    """
    record = _record(kind, Path(image).name, reason, message, None)
    known = {"version": __version__, "kernels": LEVEL, "image_sha256": image_sha256}
    record["provenance"] = {one.key: known.get(one.key) for one in QUANTITIES if one.section == "provenance"}
    return record


def image_name(exposure: Exposure) -> str:
    """The file name of an `exposure`, or its own name where it never was a file."""
    return Path(exposure.path).name or exposure.name


def _record(kind: str, image: str, reason: str | None, message: str, value: Inputs | None) -> dict[str, Any]:
    """The record of a refused image. The `value` is None where nothing is known."""
    wanted = {*KINDS[kind], "provenance"}
    found = record_from((one for one in BY_PATH.values() if (one.section or one.key) in wanted), value)
    return {
        "format": FORMATS[kind],
        "image": image,
        "status": "refused",
        "reason": None if reason is None else str(reason),
        "message": message,
        "advice": None if reason is None else Reason(reason).advice,
        **{key: found[key] for key in KINDS[kind]},
        "timing_ms": None,
        "provenance": found["provenance"],
        "warnings": [],
    }


def section_values(value: Inputs, section: str) -> list[tuple[Quantity, Any]]:
    """The quantities of a `section` of the record, with what a `value` of the pipeline determines of each, else None.

    Empty where none is determined. A quantity that is not stated is infinite.
    """
    known = [one for one in QUANTITIES if one.section == section and one.in_record]
    found = [(one, one.value(value) if one.is_determined(value) else None) for one in known]
    return found if any(one.is_determined(value) for one in known) else []


def stage_values(value: Inputs) -> At:
    """From the path of a quantity to its value in a `value` of the pipeline; None where it is not determined there."""
    known: dict[str, Any] = {}

    def value_at(path: str) -> Any:
        if path not in known:
            one = BY_PATH[path]
            given = value_at if one.derived else value
            known[path] = one.json_value(given) if one.is_determined(value) else None
        return known[path]

    return value_at


def record_values(result: Mapping[str, Any]) -> At:
    """From the path of a quantity to its value in a `result` record; None where that lacks it or has another type."""

    def value_at(path: str) -> Any:
        one = BY_PATH[path]
        if one.derived:
            return one.value(value_at)
        part = result.get(one.section) if one.section else result
        value = part.get(one.key) if isinstance(part, Mapping) else None
        return value if _has_type(value, schema_of_kind(one.schema)) else None

    return value_at


def _has_type(value: Any, schema: Schema) -> bool:
    """Whether a value of a file has the type that the schema states; its limits are not checked."""
    kind = schema.get("type")
    if kind == "array":
        items, least = schema.get("items", {}), schema.get("minItems", 0)
        return isinstance(value, list) and len(value) >= least and all(_has_type(one, items) for one in value)
    if kind == "object":
        parts = schema["properties"]
        return isinstance(value, dict) and all(_has_type(value.get(key), parts[key]) for key in schema["required"])
    kinds: dict[str, Any] = {"number": (int, float), "integer": int, "string": str, "boolean": bool}
    if kind is None:
        return value is not None
    return isinstance(value, kinds[kind]) and isinstance(value, bool) == (kind == "boolean")


TERRAIN_FILE: Schema = TERRAIN_KEYS.schema() | {"oneOf": [{"required": [ground]} for ground in GROUNDS]}
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
