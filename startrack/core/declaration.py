"""Declared keys of the files that users write: one declaration gives the check, the limits and the JSON schema.

A `Table` holds the keys of a file or of a part of it. `Table.read` returns the checked values with their defaults;
numbers as float (or int), lists as tuples, tables as dictionaries. Any other content raises BadInput with one line
that names the key.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from numbers import Real
from typing import Any

from startrack.core.errors import BadInput

Schema = dict[str, Any]
LARGEST = 1e12  # default limit of a number's size: no length, flux or count in a file of ours is larger
SHOWN_CHARS = 40  # of a wrong value in a message
SIMILAR_NAME_1 = 0.8  # ratio (difflib) from which an unknown name counts as a misspelt one


def similar_name(name: str, known: Iterable[str]) -> str:
    """Name among the `known` ones that is most similar to a misspelt `name`; empty where none is similar."""
    return next(iter(get_close_matches(name, known, n=1, cutoff=SIMILAR_NAME_1)), "")


@dataclass(frozen=True, kw_only=True)
class Key(ABC):
    """A key of a file: its meaning, whether it is required, and its default value."""

    description: str = ""
    required: bool = False
    default: Any = None  # None: the key is left out of the values; {}: a table of defaults

    @abstractmethod
    def check(self, value: Any, name: str) -> Any:
        """The value in the type that the program uses. Raises ValueError with a line that names the key `name`."""

    @abstractmethod
    def body(self) -> Schema:
        """The JSON schema without description and default."""

    def schema(self) -> Schema:
        """The JSON schema of the key."""
        schema = self.body()
        if self.default is not None and not isinstance(self.default, dict):
            schema["default"] = list(self.default) if isinstance(self.default, tuple) else self.default
        return {**schema, "description": self.description} if self.description else schema


@dataclass(frozen=True, kw_only=True)
class Number(Key):
    """A key for a finite number within limits; `above` excludes the lower one. Integers count, true and false do not.

    `integer`: a whole number, returned as int.
    """

    low: float = -LARGEST
    high: float = LARGEST
    above: bool = False
    integer: bool = False

    @property
    def limits(self) -> str:
        """The limits in words."""
        return f"{f'above {self.low:g} and at most' if self.above else f'from {self.low:g} to'} {self.high:g}"

    def check(self, value: Any, name: str) -> float | int:
        kind = "a whole number" if self.integer else "a number"
        if isinstance(value, bool) or not isinstance(value, Real):  # Real: a number of numpy too
            raise ValueError(f"{name} must be {kind}, not {value_text(value)}")
        number: Any = value
        if not self.low <= number <= self.high or (self.above and number == self.low):  # NaN fails the first
            raise ValueError(f"{name} must be {kind} {self.limits}, not {value_text(value)}")
        if self.integer and number % 1:
            raise ValueError(f"{name} must be {kind}, not {value_text(value)}")
        return int(number) if self.integer else float(number)

    def body(self) -> Schema:
        kind = "integer" if self.integer else "number"
        return {"type": kind, "exclusiveMinimum" if self.above else "minimum": self.low, "maximum": self.high}


@dataclass(frozen=True, kw_only=True)
class Text(Key):
    """A key for one line of printable text; a path may hold any characters."""

    max_chars: int = 1000
    is_path: bool = False

    def check(self, value: Any, name: str) -> str:
        if not isinstance(value, str) or not value.strip():
            raise ValueError(f"{name} must be a text, not {value_text(value)}")
        if len(value) > self.max_chars or not (self.is_path or value.isprintable()):
            raise ValueError(f"{name} must be one line of at most {self.max_chars} characters, not {value_text(value)}")
        return value

    def body(self) -> Schema:
        return {"type": "string", "minLength": 1, "maxLength": self.max_chars}


@dataclass(frozen=True, kw_only=True)
class Flag(Key):
    """A key whose value is true or false."""

    def check(self, value: Any, name: str) -> bool:
        if not isinstance(value, bool):
            raise ValueError(f"{name} must be true or false, not {value_text(value)}")
        return value

    def body(self) -> Schema:
        return {"type": "boolean"}


@dataclass(frozen=True, kw_only=True)
class Choice(Key):
    """A key whose value is one of a few `values`."""

    values: tuple[str | int, ...]

    def check(self, value: Any, name: str) -> str | int:
        if isinstance(value, bool) or not isinstance(value, str | int) or value not in self.values:
            raise ValueError(f"{name} must be {' or '.join(map(str, self.values))}, not {value_text(value)}")
        return value

    def body(self) -> Schema:
        return {"enum": list(self.values)}


@dataclass(frozen=True, kw_only=True)
class List(Key):
    """A key for a list of `count` values of one kind, or of `least` to `most`."""

    each: Key
    count: int | None = None
    least: int = 0
    most: int = 1000

    @property
    def lengths(self) -> tuple[int, int]:
        """Smallest and largest number of values."""
        return (self.least, self.most) if self.count is None else (self.count, self.count)

    def check(self, value: Any, name: str) -> tuple[Any, ...]:
        least, most = self.lengths
        if not isinstance(value, list | tuple) or not least <= len(value) <= most:
            length = f"{least}" if least == most else f"{least} to {most}"
            raise ValueError(f"{name} must be a list of {length} values, not {value_text(value)}")
        return tuple(self.each.check(one, name) for one in value)

    def body(self) -> Schema:
        least, most = self.lengths
        return {"type": "array", "items": self.each.schema(), "minItems": least, "maxItems": most}


@dataclass(frozen=True, kw_only=True)
class Either(Key):
    """A key for a value of several kinds: the first kind that it fits gives the result."""

    kinds: tuple[Key, ...]

    def check(self, value: Any, name: str) -> Any:
        causes = []
        for kind in self.kinds:
            try:
                return kind.check(value, name)
            except ValueError as cause:
                causes.append(str(cause))
        raise ValueError("; or ".join(causes))

    def body(self) -> Schema:
        return {"anyOf": [kind.schema() for kind in self.kinds]}


@dataclass(frozen=True, kw_only=True)
class Table(Key):
    """A table of keys with values of their own. Misspelt keys are refused; a `closed` table refuses unknown ones."""

    keys: Mapping[str, Key] = field(default_factory=dict)
    closed: bool = False

    def read(self, values: Any, reason: str) -> dict[str, Any]:
        """The checked values of a file, by key. Raises BadInput `reason` with a line that names the wrong key."""
        try:
            return self.check(values, "")
        except ValueError as cause:
            raise BadInput(reason, str(cause)) from cause

    def check(self, value: Any, name: str) -> dict[str, Any]:
        if not isinstance(value, dict):
            raise ValueError(f"{name or 'the file'} must be a table of keys, not {value_text(value)}")
        prefix = f"{name}." if name else ""
        for unknown in sorted(str(key) for key in set(value) - set(self.keys)):
            meant = similar_name(unknown.lower(), self.keys)
            if meant or self.closed:
                hint = f": is {meant} meant?" if meant else f"; known: {', '.join(self.keys)}"
                shown = unknown[:SHOWN_CHARS] if unknown.isprintable() else value_text(unknown)
                raise ValueError(f"{prefix}{shown} is an unknown key{hint}")
        checked = {}
        for key, declared in self.keys.items():
            if key in value:
                checked[key] = declared.check(value[key], prefix + key)
            elif declared.required:
                raise ValueError(f"{prefix}{key} is missing")
            elif declared.default is not None:
                checked[key] = declared.check(declared.default, prefix + key)
        return checked

    def body(self) -> Schema:
        schema: Schema = {"type": "object", "properties": {key: kind.schema() for key, kind in self.keys.items()}}
        schema["required"] = [key for key, kind in self.keys.items() if kind.required]
        return schema | ({"additionalProperties": False} if self.closed else {})


def value_text(value: Any) -> str:
    """The beginning of a value as one line for a message, however long or deeply nested it is."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # integers of thousands of digits, deeply nested lists
        text = f"a {type(value).__name__} too long to print"
    return text if len(text) <= SHOWN_CHARS else text[:SHOWN_CHARS] + "..."
