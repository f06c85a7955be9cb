"""The contract of the chain: what the stages hand to each other has types, and `locate` reads as the method."""

from __future__ import annotations

import ast
import builtins
import inspect
import textwrap
from collections.abc import Iterator
from dataclasses import is_dataclass
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
import pytest

from startrack.chain import Located, Refused, pipeline
from startrack.core.types import Evidence, Explored, Fix, MeasuredSkyline

STAGE_VALUES = (Located, Refused, Evidence, Fix, Explored, MeasuredSkyline)


def named_types(hint: Any) -> Iterator[Any]:
    """The types of which `hint` is made; an array is one."""
    yield hint
    if get_origin(hint) is not np.ndarray:
        for part in get_args(hint):
            yield from named_types(part)


def values_within(kind: type, known: set[type]) -> set[type]:
    """The classes of this project whose objects the fields of a dataclass or named tuple hold."""
    if kind not in known and (is_dataclass(kind) or hasattr(kind, "_fields")):
        known.add(kind)
        for hint in get_type_hints(kind).values():
            for part in named_types(hint):
                if isinstance(part, type) and part.__module__.startswith(("startrack.chain", "startrack.core")):
                    values_within(part, known)
    return known


def test_no_value_of_a_stage_has_a_field_without_a_type() -> None:
    values = set[type]()
    for kind in STAGE_VALUES:
        values_within(kind, values)
    assert len(values) > 20
    untyped = [
        f"{kind.__name__}.{name}"
        for kind in values
        for name, hint in get_type_hints(kind).items()
        if Any in named_types(hint)
    ]
    assert untyped == []


@pytest.mark.parametrize("function", [pipeline.locate, pipeline.identify, pipeline.identify_blind, pipeline.detect])
def test_a_static_reader_finds_every_call_of_the_way_of_an_image(function: Any) -> None:
    """Each is a call of an imported or local name, or of a method of a value; none is handed on to be called later."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    known = vars(pipeline)
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    assert len(calls) > 4
    for call in calls:
        handed = [*call.args, *(word.value for word in call.keywords)]
        assert not any(isinstance(one, ast.Lambda) for one in handed)
        assert not any(callable(known.get(one.id)) for one in handed if isinstance(one, ast.Name))
        if isinstance(call.func, ast.Name):
            assert callable(known.get(call.func.id) or getattr(builtins, call.func.id, None)), call.func.id
        else:
            assert isinstance(call.func, ast.Attribute) and not call.func.attr.startswith("__")


def test_the_way_of_an_image_is_short() -> None:
    assert len(inspect.getsource(pipeline.locate).splitlines()) < 50
