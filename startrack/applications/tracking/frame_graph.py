"""Graphs of a length of each frame, on a linear or a logarithmic scale."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from startrack.core.types import Array, Ints
from startrack.output.picture.canvas import DIM_INK, FAINT_INK, GRID, MAP, Box, Canvas, Colour
from startrack.output.picture.maps import distance_text, nice_step

TEXT_PX = 15.0
LOGARITHMIC = 8.0  # a scale whose ends have a larger ratio
TICKS = 20  # of frames, at most
ROOM_PX = 30.0  # between ticks of lengths

Series = tuple[str, Array, Colour]  # name, and lengths (n,) [m], nan or infinite where not known


def draw_graph(
    canvas: Canvas, box: Box, caption: str, series: Sequence[Series], crossed: Ints, colour: Colour,
    logarithmic: bool = False,
) -> None:  # fmt: skip
    """Lengths [m] above the number of the frame, and a cross of the `colour` below each frame of `crossed`.

    `logarithmic`: where the lengths differ much.
    """
    count = len(series[0][1])
    known = np.concatenate([values[np.isfinite(values) & (values >= 0)] for _, values, _ in series])
    canvas.rectangle(box, MAP)
    names = [(name, of) for name, _, of in series] + [("x: frame not used", colour)] * (len(crossed) > 0)
    _draw_names(canvas, box, caption, names)
    if len(known) and known.max() > 0:
        left, top, right, bottom = box
        logarithmic = logarithmic and known.min() > 0 and known.max() > LOGARITHMIC * known.min()
        ticks_m, low, high = (_logarithms if logarithmic else _lengths)(known, (bottom - top) / ROOM_PX)
        x_of = left + (right - left) * (np.arange(count) + 0.5) / count

        def y_of(values_m: Array) -> Array:
            at = np.log10(np.maximum(values_m, 1e-9)) if logarithmic else values_m
            return np.asarray(bottom - (bottom - top) * (at - low) / (high - low))

        for value, y in zip(ticks_m, y_of(ticks_m), strict=True):
            canvas.line([(left, y), (right, y)], GRID)
            canvas.text((left - 8, y), distance_text(float(value)) if value else "0", TEXT_PX, DIM_INK, "rm")
        _draw_numbers(canvas, x_of, bottom)
        for _, values, of in series:
            _draw_series(canvas.window(box), np.stack([x_of, y_of(values)], axis=-1), of)
        for k in crossed:
            canvas.cross((x_of[k], bottom - 9), 4.5, colour, 2)
    canvas.rectangle(box, FAINT_INK, 1)


def _draw_names(canvas: Canvas, box: Box, caption: str, names: Sequence[tuple[str, Colour]]) -> None:
    """The caption, and names in their colours."""
    left, top, right, bottom = box
    x = canvas.text((left, top - 9), caption, TEXT_PX, DIM_INK)[2]
    for name, colour in names:
        if name:
            x = canvas.text((x + 18, top - 9), name, TEXT_PX, colour)[2]
    canvas.text(((left + right) / 2, bottom + 27), "frame", TEXT_PX, DIM_INK, "mt")


def _lengths(known_m: Array, most: float) -> tuple[Array, float, float]:
    """Ticks [m] from zero, at most so many, and the ends of the scale."""
    high = 1.15 * float(known_m.max())
    return np.arange(0.0, high, nice_step(2.0 * high / most)), 0.0, high


def _logarithms(known_m: Array, most: float) -> tuple[Array, float, float]:
    """Ticks [m] at 1, 2, 5 times powers of ten, or at those powers alone, and the logarithms of the scale's ends."""
    low, high = np.log10(0.8 * float(known_m.min())), np.log10(1.25 * float(known_m.max()))
    decades = 10.0 ** np.arange(np.floor(low), np.ceil(high))
    for steps in ([1.0, 2.0, 5.0], [1.0]):
        ticks = np.outer(decades, steps).ravel()
        ticks = ticks[(np.log10(ticks) >= low) & (np.log10(ticks) <= high)]
        if len(ticks) <= most:
            break
    return ticks, float(low), float(high)


def _draw_numbers(canvas: Canvas, x_of: Array, y: float) -> None:
    """Numbers of the frames below the graph: the first, and multiples of a round number."""
    count = len(x_of)
    step = max(1, round(nice_step(max(2.0 * count / TICKS, 1.0))))
    for number in sorted({1, *range(step, count + 1, step)}):
        canvas.line([(x_of[number - 1], y), (x_of[number - 1], y + 5)], FAINT_INK)
        canvas.text((x_of[number - 1], y + 8), str(number), TEXT_PX, DIM_INK, "mt")


def _draw_series(window: Canvas, places: Array, colour: Colour) -> None:
    """A line, broken where a value is not known, with dots on it."""
    known = np.isfinite(places).all(axis=1)
    for run in np.split(places, np.flatnonzero(~known)):
        run = run[np.isfinite(run).all(axis=1)]
        if len(run) > 1:
            window.curve(run, colour, 2.2)
    for place in places[known]:
        window.circle(place, 3.0 if len(places) < 150 else 1.2, colour, -1)
