"""Columns of a table as lines of text and joined to rows, compiled: in a quarter of the time of Python's formats."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from startrack.core.errors import one_line
from startrack.kernels.library import kernel

LINE_CHARACTERS = 32  # of a number and its line break, at most; NUMBER_ROOM in kernels/core.c
LARGEST_NUMBER, SMALLEST_NUMBER = 1e15, 1e-12  # that the kernel writes: below 2**53, exact powers of ten


def column_lines(form: str, values: Any) -> bytes:
    """The `values` (n,) in the %-format `form`, one a line, UTF-8; an empty line for None and nan.

    Control characters of texts are escaped.
    """
    digits, is_general = form[2:-1], form.endswith("g")
    if isinstance(values, np.ndarray) and form in (f"%.{digits}f", f"%.{digits}g") and digits in "123456789":
        size = np.abs(values[values == values])
        largest = LARGEST_NUMBER if is_general else LARGEST_NUMBER / 10 ** int(digits)
        if size.max(initial=0.0) < largest and not (is_general and ((size > 0) & (size < SMALLEST_NUMBER)).any()):
            out = np.empty(LINE_CHARACTERS * len(values), np.uint8)
            end = _write_numbers(np.ascontiguousarray(values, dtype=np.float64), int(digits), is_general, out)
            return out[:end].tobytes()
    listed = values.tolist() if isinstance(values, np.ndarray) else values
    return "".join(["\n" if one is None or one != one else f"{one_line(form % one)}\n" for one in listed]).encode()


def join_columns(columns: Sequence[bytes]) -> bytes:
    """Lines of comma-separated fields from the lines of each of the `columns`, which must have as many."""
    ends = np.cumsum([len(column) for column in columns])
    lines = np.frombuffer(b"".join(columns), np.uint8)
    rows = np.empty_like(lines)
    if _join(lines, np.append(0, ends[:-1]), rows) != len(rows):
        raise ValueError("the columns of a table have different numbers of lines")
    return rows.tobytes()


_join = kernel("join_columns", "lines: uint8[n]", "at: out int64[columns]", "rows: out uint8[n]", result="int64")
_write_numbers = kernel(
    "write_numbers", "values: float64[n]", "digits: int64", "is_general: bool", "out: out uint8[room]", result="int64"
)
