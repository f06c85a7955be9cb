"""Functions of the compiled library for arrays of numpy, which are checked before the library sees them.

The library for this machine's processor is loaded with this module; nothing is compiled. The environment variable
STARTRACK_KERNELS names another one: baseline, v3, sanitized. Calls release the GIL.
"""

from __future__ import annotations

import ctypes
import operator
import os
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from startrack.kernels import LibraryMissing
from startrack.kernels.build import COMPILED, how_to_build, this_target

VARIABLE = "STARTRACK_KERNELS"
SCALARS: dict[str, tuple[Any, Callable[..., Any]]] = {
    "float64": (ctypes.c_double, float), "float32": (ctypes.c_float, float), "int64": (ctypes.c_int64, operator.index),
    "bool": (ctypes.c_bool, bool),
}  # fmt: skip
BUFFER: Any = (ctypes.c_char * 0).from_buffer  # a pointer to an array that is not read-only, in a fifth of the time
FORM = re.compile(r"\w+: (out )?(\w+)(?:\[(.+)\])?")
DIMENSION = re.compile(r"(\w+)(?: ?>= ?(\d+))?(?: ?\+ ?(\d+))?")
DECLARED: dict[str, tuple[list[Argument], str | None]] = {}  # by the name in the library: arguments and result


class Argument(NamedTuple):
    """An argument of a kernel. A dimension is a name or a number, and what is added to it."""

    text: str
    is_written: bool
    dtype: str
    shape: tuple[tuple[str, int], ...] | None  # None: a number
    least: dict[str, int]  # of the sizes that it names

    @classmethod
    def of(cls, text: str) -> Argument:
        """Argument by `name: dtype`, `name: dtype[n, m + 1, k >= 2, 3]`, or, if written to, `name: out dtype[n]`."""
        out, dtype, shape = FORM.fullmatch(text).groups()  # type: ignore[union-attr]
        parts = DIMENSION.findall(shape or "")
        dims = tuple((dim, int(more or 0)) for dim, _, more in parts)
        return cls(text, bool(out), dtype, dims if shape else None, {dim: int(low) for dim, low, _ in parts if low})


def _open(level: str) -> ctypes.CDLL:
    """The library of a level. Raises LibraryMissing with the command that makes it."""
    path = COMPILED / this_target().library_name(level)
    try:
        return ctypes.CDLL(str(path))
    except OSError as cause:
        why = f"is not for this system ({cause})" if path.is_file() else "does not exist for these C sources"
        raise LibraryMissing(f"{path} {why}: {how_to_build(level)}") from None


def _load() -> tuple[str, ctypes.CDLL]:
    """The level that is loaded, and its library."""
    level = os.environ.get(VARIABLE) or None
    if level not in (None, "baseline", "v3", "sanitized"):
        raise LibraryMissing(f"{VARIABLE} is {level!r}; it may be baseline, v3 or sanitized")
    if level == "sanitized":
        return level, _open(level)
    baseline = _open("baseline")
    baseline.has_x86_64_v3.restype = ctypes.c_bool
    has_v3 = "v3" in this_target().levels and baseline.has_x86_64_v3()
    if level == "v3" and not has_v3:
        raise LibraryMissing(f"{VARIABLE} is v3, which this processor is not")
    return ("v3", _open("v3")) if has_v3 and level != "baseline" else ("baseline", baseline)


LEVEL, LIBRARY = _load()


def text_of(name: str) -> str:
    """Text of the library about itself: `compiler_name` with its version, or `compiler_flags`."""
    return str(ctypes.cast(getattr(LIBRARY, name), ctypes.CFUNCTYPE(ctypes.c_char_p))().decode())


def kernel(name: str, *declarations: str, result: str | None = None) -> Callable[..., Any]:
    """The function `name` of the library, called with arrays and numbers in the order of `declarations`.

    See `Argument.of` for these. The C function takes the named sizes first, in their order, then the arguments. Arrays
    must be C-contiguous. Its `result` is of a type of SCALARS; None: it has none. The function raises TypeError where
    an argument is not as declared.
    """
    arguments = [Argument.of(text) for text in declarations]
    DECLARED[name] = arguments, result
    names, types, check = border(name, arguments)
    function = getattr(LIBRARY, name)
    function.argtypes = [ctypes.c_int64] * len(names) + types
    function.restype = SCALARS[result][0] if result else None
    return lambda *values: function(*check(values))


def border(name: str, arguments: list[Argument]) -> tuple[list[str], list[Any], Callable[[Any], list[Any]]]:
    """Names of the sizes, ctypes of the arguments, and a function that gives both for values, which it checks."""
    names = list(dict.fromkeys(dim for one in arguments for dim, _ in one.shape or () if not dim.isdigit()))
    types = [SCALARS[one.dtype][0] if one.shape is None else ctypes.c_void_p for one in arguments]
    known = [int(dim) for one in arguments for dim, _ in one.shape or () if dim.isdigit()]
    slots = [*names, *map(str, known)]  # of sizes: those of names are not known yet (-1)
    least = [max([one.least.get(slot, 0) for one in arguments], default=0) for slot in slots]
    kinds: list[Any] = [np.dtype(one.dtype) if one.shape else SCALARS[one.dtype][1] for one in arguments]
    shapes = [one.shape and [(slots.index(dim), more) for dim, more in one.shape] for one in arguments]
    plan: list[Any] = [(*one[:2], kind, shape) for one, kind, shape in zip(arguments, kinds, shapes, strict=True)]

    def check(values: tuple[Any, ...]) -> list[Any]:
        sizes, words = [-1] * len(names) + known, []
        if len(values) != len(plan):
            raise TypeError(f"{name} takes {len(plan)} arguments, not {len(values)}")
        for value, (text, is_written, kind, shape) in zip(values, plan, strict=True):
            if shape is None:
                words.append(kind(value))
                if kind is operator.index and words[-1].bit_length() > 63:  # ctypes would take the lowest bits
                    raise TypeError(f"{name}: `{text}` is asked for, not {value}")
                continue
            is_kind = isinstance(value, np.ndarray) and (value.dtype is kind or value.dtype == kind)  # `is`: fast
            if not is_kind or value.ndim != len(shape):
                found = f"{getattr(value, 'dtype', type(value))} {getattr(value, 'shape', '')}"
                raise TypeError(f"{name}: `{text}` is asked for, not {found}")
            flags = value.flags
            if not (flags.carray if is_written else flags.c_contiguous and flags.aligned):
                raise TypeError(f"{name}: `{text}` must be C-contiguous and aligned, and writable where written")
            for (slot, more), size in zip(shape, value.shape, strict=True):
                if sizes[slot] < 0:
                    sizes[slot] = size - more
                if size != sizes[slot] + more or sizes[slot] < least[slot]:
                    raise TypeError(f"{name}: `{text}` is asked for, not {value.shape}; sizes: {sizes}")
            words.append(BUFFER(value) if flags.writeable else value.__array_interface__["data"][0])
        return [*sizes[: len(names)], *words]

    return names, types, check
