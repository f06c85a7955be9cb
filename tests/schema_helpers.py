"""Records against the schemas that `startrack schema` prints; the keys of valid files with one changed."""

from __future__ import annotations

import copy
import io
import json
from contextlib import redirect_stdout
from typing import Any

from jsonschema import Draft202012Validator

from startrack.cli.main import main


def check_printed_schema(kind, record):
    """The record fits what `startrack schema KIND` prints, and has no key that this does not name."""
    with redirect_stdout(io.StringIO()) as printed:
        assert main(["schema", kind]) == 0
    schema = json.loads(printed.getvalue())
    Draft202012Validator.check_schema(schema)
    Draft202012Validator(schema, format_checker=Draft202012Validator.FORMAT_CHECKER).validate(record)
    assert unknown_keys(record, schema) == []


def unknown_keys(value, schema, path="$"):
    """Keys of a value that the schema does not name, at any depth."""
    found = []
    for one in [schema, *schema.get("anyOf", [])]:
        if isinstance(value, dict) and "properties" in one:
            known = one["properties"]
            found += [f"{path}.{key}" for key in value if key not in known]
            found += [k for key in value if key in known for k in unknown_keys(value[key], known[key], f"{path}.{key}")]
        if isinstance(value, list) and isinstance(one.get("items"), dict):
            found += [key for item in value for key in unknown_keys(item, one["items"], f"{path}[]")]
    return found


def change_key(keys: dict[str, Any], path: str, value: Any) -> dict[str, Any]:
    """The `keys` of a file with one set, or removed if the value is None."""
    d = copy.deepcopy(keys)
    *tables, key = path.split(".")
    table = d
    for name in tables:
        table = table[name]
    if value is None:
        del table[key]
    else:
        table[key] = value
    return d
