"""What the schemas are made of."""

from __future__ import annotations

from typing import Any

Schema = dict[str, Any]
DRAFT = "https://json-schema.org/draft/2020-12/schema"
NUMBER: Schema = {"type": "number"}
ABOVE_0: Schema = {"type": "number", "exclusiveMinimum": 0}
TEXT: Schema = {"type": "string"}


def numbers(count: int, each: Schema = NUMBER) -> Schema:
    """An array of so many numbers."""
    return {"type": "array", "items": each, "minItems": count, "maxItems": count}


QUATERNION: Schema = {**numbers(4, {"type": "number", "minimum": -1, "maximum": 1}), "description": "x, y, z, w"}


def record(required: Schema, description: str = "", optional: Schema | None = None) -> Schema:
    """An object with these keys. Keys beyond them are no error: a later version may add some."""
    d: Schema = {"type": "object", "properties": {**required, **(optional or {})}, "required": list(required)}
    return {**d, "description": description} if description else d


def schema(title: str, body: Schema) -> Schema:
    """A schema that stands on its own."""
    return {"$schema": DRAFT, "title": title, **body}
