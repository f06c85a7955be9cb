"""Results as plain dictionaries, ready for JSON: fix, identification, detection. The keys are a public format."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from startrack import __version__
from startrack.chain import STAGES, Detected, Identified, Inputs, Outcome, last_value
from startrack.core.errors import Reason
from startrack.core.types import Exposure
from startrack.kernels.library import LEVEL
from startrack.output.quantities import BY_PATH, QUANTITIES
from startrack.output.quantity import Quantity, Schema, record_from, schema_of_kind
from startrack.output.values import At

FORMATS = {kind: f"startrack.{kind}/1" for kind in ("fix", "identification", "detection")}
BEFORE_OWN = ("position", "modes", "search", "attitude", "middle")
OF_A_POSITION = ("position", "modes", "search", "evidence", "sky", "clock")  # sections of a fix alone


def result_dict(result: Outcome) -> dict[str, Any]:
    """The fix of one image, of its `result`: the keys are the same whether it is solved or refused.

    A section is null where nothing of it is known: `position` unless the status is ok. Lists are then empty. Quantities
    of stages that have not run are null: those in `enu` without terrain and time.
    """
    return _record_of("fix", result)


def identification_dict(result: Outcome) -> dict[str, Any]:
    """Attitude, the camera that was used and the matches of a `result`: stars with the positions measured for them."""
    return _record_of("identification", result)


def detection_dict(result: Outcome) -> dict[str, Any]:
    """The point sources of a `result`, brightest first; fluxes are in ADU where the gain is not known."""
    return _record_of("detection", result)


def record_of(result: Outcome, kind: str) -> dict[str, Any]:
    """The record of a `result`, of the `kind` that its file is named after: fix, identification or detections."""
    return {"fix": result_dict, "identification": identification_dict, "detections": detection_dict}[kind](result)


def refused_dict(
    image: str, reason: str, message: str, kind: str = "fix", image_sha256: str | None = None
) -> dict[str, Any]:
    """The record of an `image` that could not be read, or whose camera or terrain could not: `reason` and `message`.

    `kind` is fix, identification or detection; `image_sha256` that of the file, if it is known.
    """
    record = _record(kind, Path(image).name, reason, message, None)
    known = {"version": __version__, "kernels": LEVEL, "image_sha256": image_sha256}
    record["provenance"] = {one.key: known.get(one.key) for one in QUANTITIES if one.section == "provenance"}
    return record


def image_name(exposure: Exposure) -> str:
    """The file name of an `exposure`, or its own name where it never was a file."""
    return Path(exposure.path).name or exposure.name


def _record_of(kind: str, result: Outcome) -> dict[str, Any]:
    """The record of a `result`."""
    record = _record(kind, image_name(result.exposure), result.reason, result.message, last_value(result))
    timing_ms = {stage: round(result.timing_ms.get(stage, 0.0), 3) for stage in STAGES}
    return record | {"status": result.status, "timing_ms": timing_ms, "warnings": result.warnings}


def _record(kind: str, image: str, reason: str | None, message: str, value: Inputs | None) -> dict[str, Any]:
    """The record of a refused image; its own keys stand after the attitude. The `value` is None where nothing is known.

    The keys of each kind are the same for every image.
    """
    own, without = OWN_KEYS[kind]
    sections = {key: part for key, part in record_from(QUANTITIES, value).items() if key not in without}
    first: dict[str, Any] = {key: sections.pop(key) for key in BEFORE_OWN if key in sections}
    provenance = sections.pop("provenance")
    return {
        "format": FORMATS[kind],
        "image": image,
        "status": "refused",
        "reason": None if reason is None else str(reason),
        "message": message,
        "advice": None if reason is None else Reason(reason).advice,
        **first,
        **own(value),
        **sections,
        "timing_ms": None,
        "provenance": provenance,
        "warnings": [],
    }


def _camera_and_matches(value: Inputs | None) -> dict[str, Any]:
    """The camera of a `value`, null without one, and the identified stars."""
    from startrack.camera import camera_to_dict

    matches = []
    if isinstance(value, Identified):
        named = value.names.stars
        columns = (value.stars.hip[named.star].tolist(), named.xy_px.tolist(), named.saturated.tolist())
        matches = [
            {"hip": hip or None, "x_px": x, "y_px": y, "saturated": saturated}
            for hip, (x, y), saturated in zip(*columns, strict=True)
        ]
    camera = None if value is None or value.camera is None else camera_to_dict(value.camera)
    return {"camera": camera, "matches": matches}


def _point_sources(value: Inputs | None) -> dict[str, Any]:
    """The point sources of a `value`."""
    rows = list[dict[str, float]]()
    if isinstance(value, Detected):
        found = value.detections
        columns = zip(found.xy_px.tolist(), found.flux_e.tolist(), found.snr.tolist(), strict=True)
        rows = [{"x_px": x, "y_px": y, "flux_e": flux, "snr": snr} for (x, y), flux, snr in columns]
    return {"detections": rows}


OWN_KEYS: dict[str, tuple[Callable[[Inputs | None], dict[str, Any]], tuple[str, ...]]] = {  # and the sections left out
    "fix": (lambda value: {"explain": []}, ()),
    "identification": (_camera_and_matches, OF_A_POSITION),
    "detection": (_point_sources, (*OF_A_POSITION, "attitude", "middle", "bodies")),
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
