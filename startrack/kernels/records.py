"""Structs of the compiled library: arrays and numbers that belong together, checked once and not at every call."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any

from startrack.kernels.library import SCALARS, Argument, border

RECORDS: dict[str, tuple[list[Argument], Callable[[Any], ctypes.Structure]]] = {}  # by the name of the struct


class Record:
    """Arrays and numbers as a struct `name` of the library, which kernels take as `name: name`; see `declare_record`.

    They are checked once. A record keeps its arrays. Another process makes it anew.
    """

    def __init__(self, name: str, *values: Any) -> None:
        self.name, self._values, self._struct = name, values, RECORDS[name][1](values)
        self.address = ctypes.addressof(self._struct)

    def __reduce__(self) -> tuple[type[Record], tuple[Any, ...]]:
        return Record, (self.name, *self._values)


def declare_record(name: str, *declarations: str) -> None:
    """Declare a struct of the library. Its fields are the named sizes, in their order, then the `declarations`."""
    arguments = [Argument.of(text) for text in declarations]
    names, types, check = border(name, arguments)
    fields = [*((size, ctypes.c_int64) for size in names), *((f"field_{k}", one) for k, one in enumerate(types))]
    struct = type(name, (ctypes.Structure,), {"_fields_": fields})

    def make(values: tuple[Any, ...]) -> ctypes.Structure:
        words = check(values)
        return struct(*(ctypes.addressof(word) if isinstance(word, ctypes.Array) else word for word in words))

    def address(value: Any) -> int:
        if not isinstance(value, Record) or value.name != name:
            raise TypeError(f"a record {name} is asked for, not {value!r:.80}")
        return value.address

    RECORDS[name], SCALARS[name] = (arguments, make), (ctypes.c_void_p, address)
