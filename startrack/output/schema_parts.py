"""Parts of the schemas."""

from __future__ import annotations

from typing import Any

Schema = dict[str, Any]
DRAFT = "https://json-schema.org/draft/2020-12/schema"
NUMBER: Schema = {"type": "number"}
ABOVE_0: Schema = {"type": "number", "exclusiveMinimum": 0}
POSITIVE: Schema = {"type": "number", "minimum": 0}
COUNT: Schema = {"type": "integer", "minimum": 0}
CHANCE: Schema = {"type": "number", "minimum": 0, "maximum": 1}
TURN: Schema = {"type": "number", "minimum": 0, "exclusiveMaximum": 360}
LATITUDE: Schema = {"type": "number", "minimum": -90, "maximum": 90}
LONGITUDE: Schema = {"type": "number", "minimum": -180, "maximum": 180}
TEXT: Schema = {"type": "string"}
FLAG: Schema = {"type": "boolean"}


def numbers(count: int, each: Schema = NUMBER) -> Schema:
    """An array of `count` items that fit the schema `each`."""
    return {"type": "array", "items": each, "minItems": count, "maxItems": count}


QUATERNION: Schema = {**numbers(4, {"type": "number", "minimum": -1, "maximum": 1}), "description": "x, y, z, w"}


def or_null(one: Schema, description: str) -> Schema:
    """The schema `one`, or null."""
    return {"anyOf": [one, {"type": "null"}], "description": description}


def record(required: Schema, description: str = "", optional: Schema | None = None) -> Schema:
    """An object with the keys of `required` and `optional`. Further keys are no error: a later version may add some."""
    d: Schema = {"type": "object", "properties": {**required, **(optional or {})}, "required": list(required)}
    return {**d, "description": description} if description else d


def schema(title: str, body: Schema) -> Schema:
    """A schema that stands on its own: `body` with its `title` and dialect."""
    return {"$schema": DRAFT, "title": title, **body}
