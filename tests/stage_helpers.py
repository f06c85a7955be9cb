"""Values of earlier stages, made from those of later ones."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, TypeVar

T = TypeVar("T")


def as_stage(value: Any, to: type[T], **changes: Any) -> T:
    """The fields of `value` that a value of the stage `to` has, with `changes`."""
    known = {f.name: getattr(value, f.name) for f in fields(to) if hasattr(value, f.name)}
    return to(**known | changes)
