"""Declared keys: values within limits are returned, everything else is refused with a line that names the key."""

from __future__ import annotations

from typing import Any

import jsonschema
import pytest

from startrack.core.declaration import Choice, Either, Flag, Key, List, Number, Table, Text
from startrack.core.errors import BadInput

DEEP: Any = 0
for _ in range(5000):
    DEEP = [DEEP]
TABLE = Table(
    keys={
        "width": Number(low=1, high=10, integer=True, required=True),
        "depth_m": Number(low=0, high=100, above=True, default=5.0, description="below the rim"),
        "name": Text(max_chars=8),
        "mirrored": Flag(default=False),
        "model": Choice(values=("a", "b"), default="a"),
        "matrix": List(each=List(each=Number(), count=2), most=2),
        "file": Either(kinds=(Text(), List(each=Text(), least=1))),
        "part": Table(keys={"x": Number()}, closed=True),
    }
)


def test_values_come_with_their_types_and_defaults() -> None:
    read = TABLE.read({"width": 3.0, "matrix": [[1, 2]], "file": ["a"], "part": {"x": 1}, "other": DEEP}, "bad_terrain")
    assert read == {
        "width": 3, "depth_m": 5.0, "mirrored": False, "model": "a", "matrix": ((1.0, 2.0),), "file": ("a",),
        "part": {"x": 1.0},
    }  # fmt: skip
    assert isinstance(read["width"], int) and isinstance(read["part"]["x"], float)


WRONG = [
    ("width", 3.5), ("width", True), ("width", "3"), ("width", 11), ("width", 10**5000), ("width", DEEP),
    ("depth_m", 0), ("depth_m", float("nan")), ("depth_m", float("inf")), ("depth_m", 1e308), ("depth_m", -(10**400)),
    ("name", 7), ("name", ""), ("name", "two\nlines"), ("name", "x" * 9), ("mirrored", 1), ("model", "c"),
    ("model", []), ("matrix", [[1, 2], [3]]), ("matrix", [[1, 2]] * 3), ("matrix", DEEP), ("matrix", 1),
    ("file", []), ("file", {}), ("part", 1), ("part", {"x": "1"}), ("part", {"y": 1}), ("widht", 3), ("depth_M", 3),
]  # fmt: skip


@pytest.mark.parametrize(("key", "value"), WRONG, ids=[f"{key}-{n}" for n, (key, _) in enumerate(WRONG)])
def test_a_wrong_value_is_refused_in_one_line_with_its_key(key: str, value: Any) -> None:
    with pytest.raises(BadInput) as caught:
        TABLE.read({"width": 3, key: value}, "bad_terrain")
    assert caught.value.reason == "bad_terrain"
    assert key in str(caught.value)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 250


def test_a_missing_key_is_named() -> None:
    with pytest.raises(BadInput, match="width is missing"):
        TABLE.read({}, "bad_terrain")


UNLIKE_JSON = (float("nan"), "two\nlines", 10**5000)  # no JSON values, or not for the validator


def test_the_schema_agrees_with_the_check() -> None:
    schema = TABLE.schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    validator = jsonschema.Draft202012Validator(schema)
    assert validator.is_valid({"width": 3, "depth_m": 2.5, "matrix": [[1, 2]], "file": "a", "part": {"x": 1}})
    plain = [(k, v) for k, v in WRONG if v is not DEEP and k in TABLE.keys and v == v and v not in UNLIKE_JSON]
    assert [(k, v) for k, v in plain if validator.is_valid({"width": 3, k: v})] == []


def test_every_kind_of_key_has_a_schema() -> None:
    assert all("description" in kind(description="x", **options).schema() for kind, options in KINDS)


KINDS: list[tuple[type[Key], dict[str, Any]]] = [
    (Number, {}), (Text, {}), (Flag, {}), (Choice, {"values": ("a",)}), (List, {"each": Number()}),
    (Either, {"kinds": (Number(), Text())}), (Table, {}),
]  # fmt: skip
