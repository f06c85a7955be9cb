"""Views of the output quantities: as a record, as rows of text, as columns, and as JSON schemas of record sections."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from startrack.chain import Inputs, Located
from startrack.output.quantities import BY_PATH, FIRST_COLUMNS, QUANTITIES
from startrack.output.quantity import ABSENT, Column, Quantity
from startrack.output.schema_parts import TURN, Schema, or_null, record
from startrack.output.values import Angle, At

Rows = list[tuple[str, str]]


def at_stage(value: Inputs) -> At:
    """From the path of a quantity to its value in a `value` of the pipeline; None where it is not determined there."""
    known: dict[str, Any] = {}

    def value_at(path: str) -> Any:
        if path not in known:
            one = BY_PATH[path]
            if one.derived:
                known[path] = one.value(value_at) if isinstance(value, one.since) else None
            else:
                known[path] = one.value(value) if _is_determined(one, value) else None
        return known[path]

    return value_at


def at_record(result: Mapping[str, Any]) -> At:
    """From the path of a quantity to its value in a `result` record; None where that lacks it or has another type."""

    def value_at(path: str) -> Any:
        one = BY_PATH[path]
        if one.derived:
            return one.value(value_at)
        part = result.get(one.section) if one.section else result
        value = part.get(one.key) if isinstance(part, Mapping) else None
        return value if _has_type(value, one.schema) else None

    return value_at


def rows(place: str, at: At, sections: Collection[str] | None = None) -> Rows:
    """The rows of a `place` (summary, text, panel, notebook or page): each a name and a text.

    `at` gives the values, `sections` restricts the quantities to these parts of the record.
    """
    found: dict[str, str] = {}
    for one in QUANTITIES:
        if sections is not None and one.section not in sections:
            continue
        for show in one.shown:
            if show.place != place or (show.unless and at(show.unless) is not None):
                continue
            value = at(one.path)
            if value is None:
                continue
            value = Angle(value) if one.schema is TURN else value
            text = show.form(value) if callable(show.form) else show.form.format(value)
            found[show.row] = found[show.row] + text if show.row in found else text.lstrip(" ,;")
    return [(row, text) for row, text in found.items() if text]


def record_sections(value: Inputs) -> dict[str, Any]:
    """The sections of the record of a `value` of the pipeline, in the order of the table."""
    found: dict[str, Any] = {}
    for one in QUANTITIES:
        if one.derived or not one.recorded:
            continue
        if _is_determined(one, value):
            entry = one.value(value)
        else:
            entry = one.before(value) if callable(one.before) else one.before
        if entry is not ABSENT:
            part = found.setdefault(one.section, {}) if one.section else found
            part[one.key] = entry
    return found


def columns() -> list[tuple[Quantity, Column]]:
    """The columns of the batch's table, in their order."""
    order = {name: k for k, name in enumerate(FIRST_COLUMNS)}
    found = [(one, column) for one in QUANTITIES for column in one.columns]
    return sorted(found, key=lambda pair: order.get(pair[1].name, len(order)))


def section_schema(section: str, description: str = "") -> Schema:
    """The JSON schema of a `section` of the record, with a `description`."""
    required: Schema = {}
    optional: Schema = {}
    for one in QUANTITIES:
        if one.section == section and not one.derived and one.recorded:
            schema = {**one.schema, "description": one.description}
            if one.nullable:  # a list of types, so that a validator names what is wrong with an array
                schema["type"] = [one.schema["type"], "null"]
            elif one.before is None or callable(one.before):
                schema = or_null(one.schema, one.description)
            (optional if one.optional else required)[one.key] = schema
    return record(required, description, optional)


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


def _is_determined(one: Quantity, value: Inputs) -> bool:
    """Whether the value has come as far; a position is stated only where it is the only one that fits."""
    if one.section == "position" and isinstance(value, Located) and value.fix.ambiguous:
        return False
    return isinstance(value, one.since)
