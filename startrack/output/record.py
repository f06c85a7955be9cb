"""Results as plain dictionaries, ready for JSON: fix, identification, detection. The keys are a public format."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from startrack.chain import STAGES, Detected, Identified, Inputs, Outcome, last_value
from startrack.core.errors import Reason
from startrack.core.types import Exposure
from startrack.output.quantities import BY_PATH, QUANTITIES
from startrack.output.quantity import Schema, record_from, schema_of_kind
from startrack.output.values import At

FORMATS = {kind: f"startrack.{kind}/1" for kind in ("fix", "identification", "detection")}
OF_A_POSITION = ("position", "modes", "search", "evidence", "sky", "clock")  # sections of a fix alone


def result_dict(result: Outcome) -> dict[str, Any]:
    """The fix of one image: `position` where the status is ok, `modes` where there are any.

    The record of a refused `result` holds status, reason, message and the quantities of the stages that have run; other
    quantities are `null`. Fields in `enu` are absent without terrain and time.
    """
    return _record("fix", result)


def identification_dict(result: Outcome) -> dict[str, Any]:
    """Attitude, the camera that was used and the matches of a `result`: stars with the positions measured for them."""
    from startrack.camera import camera_to_dict

    value, own = last_value(result), dict[str, Any]()
    if value.camera is not None:
        own["camera"] = camera_to_dict(value.camera)
    own["matches"] = []
    if isinstance(value, Identified):
        xy_px = value.detections.xy_px[value.identification.detection].tolist()
        hips = value.stars.hip[value.identification.star].tolist()
        own["matches"] = [{"hip": hip or None, "x_px": x, "y_px": y} for hip, (x, y) in zip(hips, xy_px, strict=True)]
    return _record("identification", result, own, without=OF_A_POSITION)


def detection_dict(result: Outcome) -> dict[str, Any]:
    """The point sources of a `result`, brightest first; fluxes are in ADU where the gain is not known."""
    value, rows = last_value(result), list[dict[str, float]]()
    if isinstance(value, Detected):
        found = value.detections
        columns = zip(found.xy_px.tolist(), found.flux_e.tolist(), found.snr.tolist(), strict=True)
        rows = [{"x_px": x, "y_px": y, "flux_e": flux, "snr": snr} for (x, y), flux, snr in columns]
    return _record("detection", result, {"detections": rows}, without=(*OF_A_POSITION, "attitude"))


def record_of(result: Outcome, kind: str) -> dict[str, Any]:
    """The record of a `result`, of the `kind` that its file is named after: fix, identification or detections."""
    return {"fix": result_dict, "identification": identification_dict, "detections": detection_dict}[kind](result)


def refused_dict(image: str, reason: str, message: str, kind: str = "fix") -> dict[str, Any]:
    """The record of an `image` that could not be read, or whose camera or terrain could not: `reason` and `message`.

    `kind` is fix, identification or detection.
    """
    return {
        "format": FORMATS[kind],
        "image": Path(image).name,
        "status": "refused",
        "reason": str(reason),
        "message": message,
        "advice": Reason(reason).advice,
    }


def image_name(exposure: Exposure) -> str:
    """The file name of an `exposure`, or its own name where it never was a file."""
    return Path(exposure.path).name or exposure.name


def _record(
    kind: str, result: Outcome, own: dict[str, Any] | None = None, without: tuple[str, ...] = ()
) -> dict[str, Any]:
    """The record with its `own` keys after the attitude, and without some sections."""
    sections = {key: part for key, part in record_from(QUANTITIES, last_value(result)).items() if key not in without}
    first: dict[str, Any] = {
        key: sections.pop(key) for key in ("position", "modes", "search", "attitude") if key in sections
    }
    provenance = sections.pop("provenance")
    return {
        "format": FORMATS[kind],
        "image": image_name(result.exposure),
        "status": result.status,
        "reason": None if result.reason is None else str(result.reason),
        "message": result.message,
        **({} if result.reason is None else {"advice": Reason(result.reason).advice}),
        **first,
        **(own or {}),
        **sections,
        "timing_ms": {stage: round(result.timing_ms.get(stage, 0.0), 3) for stage in STAGES},
        "provenance": provenance,
        "warnings": result.warnings,
    }


def stage_values(value: Inputs) -> At:
    """From the path of a quantity to its value in a `value` of the pipeline; None where it is not determined there."""
    known: dict[str, Any] = {}

    def value_at(path: str) -> Any:
        if path not in known:
            one = BY_PATH[path]
            known[path] = one.value(value_at if one.derived else value) if one.is_determined(value) else None
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
