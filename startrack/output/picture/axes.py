"""Axes of a plot: places of values on the canvas, grid lines with their numbers, steps that are easy to read."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.core.types import Array
from startrack.output.picture.canvas import DIM_INK, GRID, TEXT_PX, Box, Canvas, Colour

STEPS = 1.0, 2.0, 5.0  # times powers of ten
GAP_PX = 8.0  # between numbers and the box


@dataclass(frozen=True)
class Axes:
    """Axes on a canvas: x to the right and y upwards, each from its first end to its last."""

    canvas: Canvas
    box: Box
    x: tuple[float, float]
    y: tuple[float, float]
    logarithmic: bool = False  # both

    def canvas_px(self, x: Any, y: Any) -> Array:
        """Places (..., 2) on the canvas."""
        left, top, right, bottom = self.box
        across, up = self._part(x, self.x), self._part(y, self.y)
        return np.stack(np.broadcast_arrays(left + across * (right - left), bottom - up * (bottom - top)), axis=-1)

    def _part(self, values: Any, ends: tuple[float, float]) -> Array:
        """Parts of the way between the ends."""
        low, high = ends
        if self.logarithmic:
            return np.asarray(np.log(np.asarray(values) / low) / np.log(high / low))
        return np.asarray((np.asarray(values, dtype=float) - low) / (high - low))

    @property
    def window(self) -> Canvas:
        """The canvas, with shapes clipped to the box."""
        return self.canvas.window(self.box)

    def draw_columns(self, values: Iterable[float], texts: Iterable[str], tick_px: float = 0.0) -> None:
        """Lines at `values` of x, or ticks of `tick_px` below the box, with `texts` below."""
        _, top, _, bottom = self.box
        for x, text in zip(self.canvas_px(list(values), self.y[0])[:, 0], texts, strict=True):
            ends = (bottom, bottom + tick_px) if tick_px else (top, bottom)
            self.canvas.line([(x, ends[0]), (x, ends[1])], DIM_INK if tick_px else GRID)
            self.canvas.text((x, bottom + (tick_px + 4.0 if tick_px else GAP_PX)), text, TEXT_PX, DIM_INK, "mt")

    def draw_rows(self, values: Iterable[float], texts: Iterable[str], zero: Colour = GRID) -> None:
        """Lines at `values` of y with `texts` to the left; that at 0 has the colour `zero`."""
        left, _, right, _ = self.box
        values = list(values)
        for value, y, text in zip(values, self.canvas_px(self.x[0], values)[:, 1], texts, strict=True):
            self.canvas.line([(left, y), (right, y)], GRID if value else zero)
            self.canvas.text((left - GAP_PX, y), text, TEXT_PX, DIM_INK, "rm")


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
