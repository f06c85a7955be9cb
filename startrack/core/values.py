"""The base of the values that cross module borders: frozen, shape-checked, with read-only arrays."""

from __future__ import annotations

from dataclasses import field, fields
from functools import cache
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]


def array(
    *shape: int | str, dtype: Any = np.float64, default: float | None = None, may_be_nan: bool = False
) -> Any:  # fmt: skip
    """A checked array field. Letters in `shape` name lengths that must agree within the value.

    With a default the field may be left out or be one number: it is then filled with the number, as long as the fields
    before it.
    """
    metadata = {"shape": shape, "dtype": dtype, "default": default, "may_be_nan": may_be_nan}
    return field(metadata=metadata) if default is None else field(default=None, metadata=metadata)


def vector(**more: Any) -> Any:
    """A checked field (3,), the components of a vector in a frame; `more` as in `array`."""
    return array(3, **more)


def rotation() -> Any:
    """A checked field (3, 3), a rotation from one frame to another."""
    return array(3, 3)


def _is_locked(given: Any, dtype: Any) -> bool:
    """Whether an array is immutable and of this type of numbers: it then needs no copy."""
    if type(given) is not np.ndarray or given.flags.writeable or not given.flags.c_contiguous:
        return False
    base = given.base
    return (given.dtype.type is dtype or np.issubdtype(given.dtype, dtype)) and (
        base is None or (type(base) is np.ndarray and not base.flags.writeable)
    )


class Value:
    """Base of the frozen values: converts, checks and locks the fields declared with `array`."""

    def __post_init__(self) -> None:
        lengths: dict[str, int] = {}
        for name, want, dtype, default, may_be_nan in self._arrays():
            given = getattr(self, name)
            if default is not None and np.ndim(given) == 0:
                given = np.full([lengths.get(w, w) for w in want], default if given is None else given)
            a = given if _is_locked(given, dtype) else np.array(given, dtype=dtype)
            if a.ndim != len(want):
                raise ValueError(f"{type(self).__name__}.{name}: {a.ndim} dimensions, expected {want}")
            for n, w in zip(a.shape, want, strict=True):
                if n != (lengths.setdefault(w, n) if isinstance(w, str) else w):
                    raise ValueError(f"{type(self).__name__}.{name}: shape {a.shape}, expected {want} {lengths}")
            if a.dtype.kind == "f" and not may_be_nan and np.isnan(a).any():
                raise ValueError(f"{type(self).__name__}.{name} holds NaN")
            a.setflags(write=False)
            object.__setattr__(self, name, a)

    @classmethod
    @cache
    def _arrays(cls) -> list[tuple[Any, ...]]:
        """Name, shape, type, default and whether NaN is allowed of each field declared with `array`."""
        declared = [(f.name, f.metadata) for f in fields(cls) if "shape" in f.metadata]  # type: ignore[arg-type]
        return [(name, m["shape"], m["dtype"], m["default"], m["may_be_nan"]) for name, m in declared]


class Rows(Value):
    """A value whose array fields have a common length n: that of the value."""

    def __len__(self) -> int:
        return len(getattr(self, self._columns()[0]))

    def take(self, which: Any) -> Self:
        """Copy of this value with the rows that a mask, slice or index array `which` selects, not checked again."""
        taken = object.__new__(type(self))
        for f in fields(self):  # type: ignore[arg-type]
            part = whole = getattr(self, f.name)
            if f.metadata.get("shape", ())[:1] == ("n",):
                part = whole[which]
                if part.ndim != whole.ndim:
                    raise ValueError(f"{which!r} selects no rows: give a mask, a slice or an index array")
                part = np.ascontiguousarray(part)
                part.flags.writeable = False
            object.__setattr__(taken, f.name, part)
        return taken

    def with_rows(self, which: Ints, others: Self) -> Self:
        """Copy of this value with the rows of `others`, which are checked too, at the indices `which`."""
        changed = object.__new__(type(self))
        for f in fields(self):  # type: ignore[arg-type]
            value = getattr(self, f.name)
            if f.metadata.get("shape", ())[:1] == ("n",):
                value = value.copy()
                value[which] = getattr(others, f.name)
                value.flags.writeable = False
            object.__setattr__(changed, f.name, value)
        return changed

    @classmethod
    def concatenate(cls, *parts: Self, **shared: Any) -> Self:
        """Value with the rows of all `parts`; its other fields are `shared`."""
        return cls(**shared | {name: np.concatenate([getattr(one, name) for one in parts]) for name in cls._columns()})

    @classmethod
    @cache
    def _columns(cls) -> list[str]:
        """Names of the array fields of the common length."""
        return [name for name, shape, *_ in cls._arrays() if shape[:1] == ("n",)]
