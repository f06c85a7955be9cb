"""Columns of a table as lines of text and joined to rows, compiled: in a quarter of the time of Python's formats."""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
from collections.abc import Sequence
from typing import Any

import numpy as np

from startrack.core.errors import one_line
from startrack.core.kernels import njit

LINE_CHARACTERS = 32  # characters of a number and its line break
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
            return bytes(_number_lines(np.ascontiguousarray(values, dtype=np.float64), int(digits), is_general))
    listed = values.tolist() if isinstance(values, np.ndarray) else values
    return "".join(["\n" if one is None or one != one else f"{one_line(form % one)}\n" for one in listed]).encode()


def join_columns(columns: Sequence[bytes]) -> bytes:
    """Lines of comma-separated fields from the lines of each of the `columns`, which must have as many."""
    ends = np.cumsum([len(column) for column in columns])
    return bytes(_join(np.frombuffer(b"".join(columns), np.uint8), np.append(0, ends[:-1])))


@njit(cache=True)
def _join(lines, at):
    """The rows (bytes,) of columns whose `lines` (bytes,) begin `at` (columns,) each."""
    rows, to = np.empty_like(lines), 0
    while to < len(rows):
        for c in range(len(at)):
            while lines[at[c]] != 10:
                rows[to] = lines[at[c]]
                to += 1
                at[c] += 1
            rows[to] = 10 if c == len(at) - 1 else 44  # a comma
            to += 1
            at[c] += 1
    return rows


@njit(cache=True)
def _number_lines(values, digits, is_general):
    """The characters (bytes,) of the values, a line break after each: %.<digits>g where `is_general`, else f."""
    out, at = np.empty(LINE_CHARACTERS * len(values), np.uint8), 0
    for value in values:
        if value == value:
            if np.signbit(value):
                out[at] = 45  # -
                at += 1
            if is_general:
                at = _write_general(out, at, abs(value), digits)
            else:
                at = _write_fixed(out, at, _scaled(abs(value), digits), digits)
        out[at] = 10
        at += 1
    return out[:at]


@njit(inner=True)
def _scaled(value, power):
    """value * 10**power, rounded to an integer: half to even, as of the exact product."""
    scale = 10.0 ** abs(power)
    product = value * scale if power >= 0 else value / scale
    low = np.floor(product)
    rest = product - low
    if rest == 0.5:  # rounded to it, perhaps: the sign of what the rounding took away
        error = _product_error(value, scale, product) if power >= 0 else value - product * scale
        up = error > 0 or (error == 0 and low % 2 == 1)
    else:
        up = rest > 0.5
    return np.int64(low) + (1 if up else 0)


@njit(inner=True)
def _product_error(a, b, product):
    """a b - product, exactly (Dekker 1971)."""
    high_a, high_b = _high_half(a), _high_half(b)
    low_a, low_b = a - high_a, b - high_b
    return ((high_a * high_b - product) + high_a * low_b + low_a * high_b) + low_a * low_b


@njit(inner=True)
def _high_half(x):
    """The upper 26 bits of a number (Veltkamp)."""
    large = 134217729.0 * x
    return large - (large - x)


@njit(inner=True)
def _write_general(out, at, value, digits):
    """Write as %.<digits>g; the end."""
    if value == 0:
        out[at] = 48
        return at + 1
    exponent = int(np.floor(np.log10(value)))
    whole = _scaled(value, digits - 1 - exponent)
    if whole < 10 ** (digits - 1):  # the logarithm was rounded up
        exponent -= 1
        whole = _scaled(value, digits - 1 - exponent)
    if whole >= 10**digits:
        exponent += 1
        whole = _scaled(value, digits - 1 - exponent)
    is_plain = -4 <= exponent < digits
    decimals = digits - 1 - exponent if is_plain else digits - 1
    while decimals > 0 and whole % 10 == 0:
        whole //= 10
        decimals -= 1
    at = _write_fixed(out, at, whole, decimals)
    if not is_plain:
        out[at], out[at + 1] = 101, 43 if exponent > 0 else 45  # e+, e-
        out[at + 2], out[at + 3] = 48 + abs(exponent) // 10, 48 + abs(exponent) % 10
        at += 4
    return at


@njit(inner=True)
def _write_fixed(out, at, whole, decimals):
    """Write whole / 10**decimals with that many decimals; the end."""
    rest, end, power = np.uint64(whole), at + decimals + 1, np.uint64(10**decimals)
    while rest // np.uint64(10) >= power:
        power *= np.uint64(10)
        end += 1
    end += 1 if decimals > 0 else 0
    point = end - 1 - decimals if decimals > 0 else -1
    for k in range(end - 1, at - 1, -1):
        if k == point:
            out[k] = 46
        else:
            tens = rest // np.uint64(10)
            out[k] = 48 + (rest - tens * np.uint64(10))
            rest = tens
    return end
