"""What an output quantity is, and what follows from a table of them: records, JSON schemas, columns of tables."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np

from startrack.core.ecsv import Column

Schema = dict[str, Any]
Kind = str | Schema  # a schema, or its word in KINDS
KINDS: dict[str, Schema] = {
    "number": {"type": "number"},
    "positive": {"type": "number", "minimum": 0},
    "count": {"type": "integer", "minimum": 0},
    "chance": {"type": "number", "minimum": 0, "maximum": 1},
    "turn": {"type": "number", "minimum": 0, "exclusiveMaximum": 360},
    "latitude": {"type": "number", "minimum": -90, "maximum": 90},
    "longitude": {"type": "number", "minimum": -180, "maximum": 180},
    "text": {"type": "string"},
    "time": {"type": "string", "format": "date-time"},
    "flag": {"type": "boolean"},
}


def schema_of_kind(kind: Kind, description: str = "") -> Schema:
    """The schema of a `kind`, with a `description` unless it is empty."""
    schema = KINDS[kind] if isinstance(kind, str) else kind
    return {**schema, "description": description} if description else schema


def list_schema(each: Kind, description: str = "", count: int | None = None) -> Schema:
    """An array of `count` items of the kind `each` (None: any number), with a `description` unless it is empty."""
    lengths = {} if count is None else {"minItems": count, "maxItems": count}
    return schema_of_kind({"type": "array", "items": schema_of_kind(each), **lengths}, description)


KINDS["quaternion"] = list_schema({"type": "number", "minimum": -1, "maximum": 1}, "x, y, z, w", 4)


def or_null(one: Kind, description: str) -> Schema:
    """The schema of the kind `one` or null, with a `description`."""
    return {"anyOf": [schema_of_kind(one), {"type": "null"}], "description": description}


def object_schema(
    required: Mapping[str, Kind], description: str = "", optional: Mapping[str, Kind] = MappingProxyType({})
) -> Schema:
    """An object with the keys of `required` and `optional`, and a `description` unless it is empty.

    Further keys are no error: a later version may add some.
    """
    properties = {key: schema_of_kind(kind) for key, kind in {**required, **optional}.items()}
    return schema_of_kind({"type": "object", "properties": properties, "required": list(required)}, description)


def file_schema(title: str, body: Schema) -> Schema:
    """A schema that stands on its own: `body` with its `title` and dialect."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": title, **body}


ABSENT: Any = object()  # of a quantity whose section is null before its stage
ASTROPY_UNITS = {
    "m": "m", "m^2": "m2", "deg": "deg", "arcsec": "arcsec", "px": "pix", "s": "s", "mag/arcsec^2": "mag / arcsec2",
    "arcsec/px": "arcsec / pix",
}  # fmt: skip


@dataclass(frozen=True)
class Show:
    """One place where a quantity is shown; the quantities of one row are joined.

    `place` is summary, text, panel, notebook or page, or several; `row` names the line of text or the row of a table,
    with a capital on the page; `form` makes the text, by str.format or as a function. Nothing is shown where a
    quantity of the paths `unless` is known.
    """

    place: str
    row: str
    form: str | Callable[[Any], str]
    unless: str = ""


@dataclass(frozen=True)
class Listed:
    """A column in the page's list of images: heading, decimals, and whether narrow screens have it too."""

    heading: str
    decimals: int
    always: bool = False


@dataclass(frozen=True)
class Quantity:
    """One quantity of a record, or one that is only shown."""

    path: str  # KEY or SECTION.KEY of the record
    unit: str  # as docs/formats.md spells it; empty for texts and pure numbers
    since: type[Any] | Callable[[Any], bool]  # the values that determine it: of a class, or those that fulfil this
    value: Callable[[Any], Any]  # of such a value, infinite where it is not stated; where `derived`, of an `At`
    description: str
    schema: Kind = field(default_factory=dict)
    before: Any = ABSENT  # in the record of a value that has not come as far: ABSENT, None, 0, [], or a function
    nullable: bool = False  # whether it may be null of a value that has come as far
    optional: bool = False  # whether records of earlier versions lack it although they have its section
    form: str = ""  # printf format of its columns in a table; empty: it has none
    columns: Mapping[str, tuple[int, ...]] = field(default_factory=dict)  # their elements by name; empty: one, the key
    shown: tuple[Show, ...] = ()
    listed: Listed | None = None
    derived: bool = False  # made from other quantities, and not in the record
    recorded: bool = True

    @property
    def in_record(self) -> bool:
        """Whether records have it."""
        return self.recorded and not self.derived

    @property
    def section(self) -> str:
        """The part of the record that holds it; empty for a key of the record itself."""
        return self.path.rpartition(".")[0]

    @property
    def key(self) -> str:
        """Its key in the section."""
        return self.path.rpartition(".")[2]

    @property
    def name(self) -> str:
        """Its key without the unit, for values that have their unit themselves."""
        return self.key.removesuffix(f"_{self.unit.replace('^', '')}")

    def is_determined(self, value: Any) -> bool:
        """Whether the `value` has come as far."""
        return isinstance(value, self.since) if isinstance(self.since, type) else self.since(value)

    def json_value(self, value: Any) -> Any:
        """What a record holds of a `value` that determines it: null where it is not finite."""
        found = self.value(value)
        if isinstance(found, float | np.ndarray):
            return np.asarray(found).tolist() if np.isfinite(found).all() else None
        return found

    @property
    def astropy_unit(self) -> str | None:
        """Its unit as astropy spells it; None of texts and pure numbers."""
        return ASTROPY_UNITS.get(self.unit)

    @property
    def table_columns(self) -> list[Column]:
        """Its columns in a table; none without a format."""
        if not self.form:
            return []
        kind, columns = {"d": "int64", "s": "string"}.get(self.form[-1], "float64"), self.columns or {self.key: ()}
        return [
            Column(name, (), kind, self.astropy_unit, self.form, self.description, (*self.path.split("."), *at))
            for name, at in columns.items()
        ]


def show_everywhere(label: str, form: str, line: str) -> tuple[Show, ...]:
    """A quantity shown as `label` with its `form` in text (on the `line`), panel, notebook and page."""
    return (
        Show("text", line, f"; {label.lower()} {form}"),
        Show("panel", label, form),
        Show("notebook page", label.lower(), form),
    )


def record_from(quantities: Iterable[Quantity], value: Any) -> dict[str, Any]:
    """The record of a `value` by a table of `quantities`, in the order of the table: the same keys for every value.

    A section is null where a quantity of it is ABSENT, and every one is where the `value` is None: nothing was read.
    """
    found: dict[str, Any] = {}
    for one in quantities:
        if not one.in_record:
            continue
        if one.is_determined(value):
            entry = one.json_value(value)
        elif one.section and value is None:
            entry = ABSENT
        else:
            entry = one.before(value) if callable(one.before) else one.before
        if not one.section:
            found[one.key] = entry
        elif entry is ABSENT:
            found[one.section] = None
        elif (part := found.setdefault(one.section, {})) is not None:
            part[one.key] = entry
    return found


def schema_of(quantities: Iterable[Quantity], section: str = "", description: str = "", units: bool = False) -> Schema:
    """The JSON schema of a `section` of the record of `quantities`, with a `description`; `units`: with their units."""
    required: Schema = {}
    optional: Schema = {}
    for one in quantities:
        if one.section == section and one.in_record:
            words = f"{one.description} [{one.unit}]" if units and one.unit else one.description
            schema = {**schema_of_kind(one.schema), "description": words}
            if one.nullable:  # a list of types, so that a validator names what is wrong with an array
                schema["type"] = [schema["type"], "null"]
            elif one.before is None or callable(one.before):
                schema = or_null(one.schema, words)
            (optional if one.optional else required)[one.key] = schema
    return object_schema(required, description, optional)


def markdown_table(quantities: Sequence[Quantity], heading: str) -> str:
    """The recorded `quantities` for documentation, with unit and meaning; `heading` of their names."""
    rows = [f"| `{one.path}` | {one.unit} | {one.description} |" for one in quantities if one.in_record]
    return "\n".join([f"| {heading} | unit | meaning |", "| --- | --- | --- |", *rows])
