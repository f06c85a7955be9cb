"""Facts worked out once per object and kept as long as the object lives."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import Any, Generic, TypeVar

Fact = TypeVar("Fact")


class KeptPerObject(Generic[Fact]):
    """`work(thing)`, kept per object (not per value: comparing catalogues would cost more than the answer)."""

    def __init__(self, work: Callable[[Any], Fact]) -> None:
        self._work = work
        self._kept: dict[int, tuple[weakref.ref[Any], Fact]] = {}

    def __call__(self, thing: Any) -> Fact:
        key = id(thing)
        kept = self._kept.get(key)
        if kept is None or kept[0]() is not thing:
            kept = (weakref.ref(thing, lambda _: self._kept.pop(key, None)), self._work(thing))
            self._kept[key] = kept
        return kept[1]
