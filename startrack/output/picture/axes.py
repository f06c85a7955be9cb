"""Axes of a plot: places of values on the canvas, curves, grid lines with their numbers, steps easy to read."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.core.types import Array
from startrack.output.picture.canvas import TEXT_PX, Box, Canvas, Colour, Ink

STEPS = 1.0, 2.0, 5.0  # times powers of ten
GAP_PX = TEXT_PX / 2  # between numbers and the box
ROOM_PX = {"x": 8 * TEXT_PX, "y": 5 * TEXT_PX}  # at most between two numbers


@dataclass(frozen=True)
class Axes:
    """Axes on a canvas: x to the right and y upwards, each from its first end to its last."""

    canvas: Canvas
    box: Box
    x: tuple[float, float]
    y: tuple[float, float]
    logarithmic: str = ""  # those of "xy" whose scale is logarithmic

    def canvas_px(self, x: Any, y: Any) -> Array:
        """Places (..., 2) on the canvas."""
        left, top, right, bottom = self.box
        across, up = self._part("x", x), self._part("y", y)
        return np.stack(np.broadcast_arrays(left + across * (right - left), bottom - up * (bottom - top)), axis=-1)

    def _part(self, axis: str, values: Any) -> Array:
        """Parts of the way between the ends of an axis; those of values below any logarithm are far below the box."""
        low, high = self.x if axis == "x" else self.y
        values = np.asarray(values, dtype=float)
        if axis in self.logarithmic:
            return np.asarray(np.log(np.maximum(values, 1e-9 * low) / low) / np.log(high / low))
        return np.asarray((values - low) / (high - low))

    def ticks(self, axis: str) -> Array:
        """Numbers that are easy to read, between the ends of an axis."""
        left, top, right, bottom = self.box
        (low, high), length = (self.x, right - left) if axis == "x" else (self.y, bottom - top)
        most = length / ROOM_PX[axis]
        if axis not in self.logarithmic:
            return multiples(low, high, nice_step((high - low) / most))
        powers = int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1
        every = np.array([number for number in nice_numbers(*powers) if low <= number <= high])
        return every if len(every) <= 2 * most else every[np.isclose(np.log10(every) % 1.0, 0.0)]

    @property
    def window(self) -> Canvas:
        """The canvas, with shapes clipped to the box."""
        return self.canvas.window(self.box)

    def draw_scales(
        self, caption: str, across: str, names: Iterable[tuple[str, Colour]] = (), columns: Array | None = None
    ) -> None:
        """The frame with a `caption` and coloured `names` above, grid lines with numbers, and the words `across` below.

        `columns`: values of x that have a line, in place of the `ticks`.
        """
        left, top, right, bottom = self.box
        at = self.canvas.text((left, top - GAP_PX), caption)[2]
        for name, colour in names:
            at = self.canvas.text((at + TEXT_PX, top - GAP_PX), name, colour)[2]
        self.canvas.text(((left + right) / 2, bottom + 2 * TEXT_PX), across, anchor="mt")
        columns, rows = self.ticks("x") if columns is None else columns, self.ticks("y")
        self.draw_columns(columns, [f"{value:g}" for value in columns])
        self.draw_rows(rows, [f"{value:g}" for value in rows])
        self.canvas.rectangle(self.box, Ink.FAINT, 1)

    def draw_columns(self, values: Sequence[float] | Array, texts: Iterable[str]) -> None:
        """Lines at `values` of x with `texts` below."""
        for (x, y), text in zip(self.canvas_px(values, self.y[0]), texts, strict=True):
            self.canvas.line([(x, y), (x, self.box[1])], Ink.GRID)
            self.canvas.text((x, y + GAP_PX), text, anchor="mt")

    def draw_rows(self, values: Sequence[float] | Array, texts: Iterable[str]) -> None:
        """Lines at `values` of y with `texts` to the left."""
        for (x, y), text in zip(self.canvas_px(self.x[0], values), texts, strict=True):
            self.canvas.line([(x, y), (self.box[2], y)], Ink.GRID)
            self.canvas.text((x - GAP_PX, y), text, anchor="rm")

    def draw_curve(self, x: Array, y: Array, colour: Colour, dot_px: float = 0.0) -> None:
        """A curve of a `colour` through points (n,), broken where y is not finite; dots of radius `dot_px` on it."""
        window, places, known = self.window, self.canvas_px(x, y), np.isfinite(y)
        for run in known_runs(known):
            window.curve(places[run], colour, 2.5)
        for place in places[known]:
            window.mark(place, "disc", dot_px, colour)


def known_runs(known: NDArray[np.bool_]) -> list[slice]:
    """Stretches of at least two known points."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(np.int8)))
    return [slice(first, last) for first, last in edges.reshape(-1, 2) if last - first > 1]


def nice_numbers(first_power: int, last_power: int) -> tuple[float, ...]:
    """1, 2 and 5 times the powers of ten from the first to before the last."""
    return tuple(step * 10.0**power for power in range(first_power, last_power) for step in STEPS)


def nice_step(length: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is no longer than the length."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(m for m in STEPS if m * power <= length * (1 + 1e-9)) * power)


NICE = nice_numbers(-3, 6)


def multiples(low: float, high: float, step: float) -> Array:
    """The multiples of a `step` from `low` to `high`, both included."""
    return np.asarray(np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1) * step + 0.0)
