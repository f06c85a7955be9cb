"""Curves of a prediction: the 95 % radius along a path, and of cameras and exposures at the same places."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.core.errors import length_text
from startrack.core.types import Array
from startrack.output.picture.canvas import (
    BLUISH_GREEN,
    DIM_INK,
    FAINT_INK,
    GRID,
    INK,
    MAP,
    ORANGE,
    REDDISH_PURPLE,
    SKY_BLUE,
    VERMILLION,
    Box,
    Canvas,
)
from startrack.output.picture.maps import nice_step

WIDTH_PX, HEIGHT_PX = 1100, 620
BOX: Box = (90.0, 84.0, 1070.0, 540.0)
TITLE_PX, TEXT_PX, CAPTION_PX = 22.0, 17.0, 16.0
CURVES = (SKY_BLUE, ORANGE, BLUISH_GREEN, REDDISH_PURPLE)
EACH_IMAGE = "each image alone"
LOCATED = 0.9  # share of the draws below which a point is marked
NICE = tuple(step * 10.0**power for power in range(-3, 6) for step in (1.0, 2.0, 5.0))


def path_picture(
    distance_m: Array, radius_m: Array, p_ok: Array, title: str, lines: Sequence[str],
    more: Mapping[str, Array] | None = None,
) -> NDArray[np.uint8]:  # fmt: skip
    """The 95 % radius (k,) against the distance (k,) along a path; points with fewer positions are marked.

    A radius is infinite where half of the draws or more have no position. `more` has radii (k,) with odometry, by the
    names of their curves.
    """
    canvas = Canvas(WIDTH_PX, HEIGHT_PX)
    known = np.isfinite(radius_m)
    top_m = 1.15 * float(radius_m[known].max()) if known.any() else 1.0
    scale = _Linear(BOX, float(distance_m[-1]), top_m)
    _draw_frame(canvas, title, lines, "distance along the path [m]", "95 % radius [m]")
    _draw_linear_grid(canvas, scale)
    for run in _runs(known):
        canvas.line(scale(distance_m[run], radius_m[run]), SKY_BLUE, 3)
    _draw_curves(canvas, scale, distance_m, more or {})
    for distance, radius, share in zip(distance_m, radius_m, p_ok, strict=True):
        if not np.isfinite(radius):
            canvas.cross(scale(distance, 0.97 * top_m), 6.0, VERMILLION, 2)
        elif share < LOCATED:
            canvas.circle(scale(distance, radius), 5.0, VERMILLION, 2)
        else:
            canvas.circle(scale(distance, radius), 4.0, SKY_BLUE, -1)
    if (p_ok < LOCATED).any():
        words = "red circle: fewer than 9 of 10 images give a position; red cross: half of them or fewer"
        canvas.text((BOX[2], BOX[3] + 62.0), words, CAPTION_PX, DIM_INK, "rm")
    return canvas.rendered_pixels()


def _draw_curves(canvas: Canvas, scale: _Linear, distance_m: Array, curves: Mapping[str, Array]) -> None:
    """Further curves, with the names of all."""
    for colour, radius_m in zip(CURVES[1:], curves.values(), strict=False):
        for run in _runs(np.isfinite(radius_m)):
            canvas.line(scale(distance_m[run], radius_m[run]), colour, 3)
    names = [EACH_IMAGE, *curves] if curves else []
    for k, (name, colour) in enumerate(zip(names, CURVES, strict=False)):
        canvas.text((BOX[2] - 12.0, BOX[1] + 12.0 + 24.0 * k), name, TEXT_PX, colour, "rt", halo=True)


def comparison_picture(variants: Sequence[dict[str, Any]], title: str) -> NDArray[np.uint8]:
    """The median 95 % radius of the places against the exposure, one curve a camera, both scales logarithmic."""
    canvas = Canvas(WIDTH_PX, HEIGHT_PX)
    _draw_frame(canvas, title, ["median over the places"], "exposure [s]", "95 % radius [m]")
    rows = [(one["camera"], one["exposure_s"], one["summary"]["median_radius95_m"]) for one in variants]
    drawn = [row for row in rows if row[2] is not None]
    if not drawn:
        middle = (BOX[0] + BOX[2]) / 2, (BOX[1] + BOX[3]) / 2
        canvas.text(middle, "no position at half of the places", TEXT_PX, INK, "mm")
        return canvas.rendered_pixels()
    scale = _Logarithmic(BOX, [row[1] for row in drawn], [row[2] for row in drawn])
    _draw_log_grid(canvas, scale)
    cameras = list(dict.fromkeys(row[0] for row in rows))
    for k, camera in enumerate(cameras):
        own = sorted((exposure, radius) for name, exposure, radius in drawn if name == camera)
        colour = CURVES[k % len(CURVES)]
        points = np.array([scale(exposure, radius) for exposure, radius in own]).reshape(-1, 2)
        if len(points) > 1:
            canvas.line(points, colour, 3)
        for point, (exposure, radius) in zip(points, own, strict=True):
            canvas.circle(point, 6.0, colour, -1)
            canvas.label(point, f"{exposure:.3g} s: {length_text(radius, 3)}", CAPTION_PX, INK, 14.0, BOX)
        canvas.text((BOX[2] - 12.0, BOX[1] + 12.0 + 24.0 * k), camera, TEXT_PX, colour, "rt", halo=True)
    return canvas.rendered_pixels()


class _Linear:
    """Both axes from 0."""

    def __init__(self, box: Box, right: float, top: float) -> None:
        self.box, self.right, self.top = box, right, top

    def __call__(self, x: Any, y: Any) -> Array:
        left, top, right, bottom = self.box
        across = left + (right - left) * np.asarray(x) / self.right
        down = bottom - (bottom - top) * np.asarray(y) / self.top
        return np.stack(np.broadcast_arrays(across, down), axis=-1)


class _Logarithmic:
    """Both axes logarithmic, from and to nice numbers beyond the values."""

    def __init__(self, box: Box, x: Sequence[float], y: Sequence[float]) -> None:
        self.box, self.ranges = box, [_nice_range(min(values), max(values)) for values in (x, y)]

    def __call__(self, x: float, y: float) -> Array:
        left, top, right, bottom = self.box
        across, up = (np.log(v / low) / np.log(high / low) for v, (low, high) in zip((x, y), self.ranges, strict=True))
        return np.array([left + across * (right - left), bottom - up * (bottom - top)])


def _nice_range(low: float, high: float) -> tuple[float, float]:
    return max(one for one in NICE if one < low * 0.95), min(one for one in NICE if one > high * 1.05)


def _draw_frame(canvas: Canvas, title: str, lines: Sequence[str], across: str, up: str) -> None:
    canvas.rectangle(BOX, MAP)
    canvas.rectangle(BOX, FAINT_INK, 1)
    canvas.text((BOX[0], 14.0), title, TITLE_PX, INK, "lt")
    for k, line in enumerate(lines):
        canvas.text((BOX[0], 44.0 + 18.0 * k), line, CAPTION_PX, DIM_INK, "lt")
    canvas.text(((BOX[0] + BOX[2]) / 2, BOX[3] + 34.0), across, TEXT_PX, DIM_INK, "mt")
    canvas.text((BOX[2], BOX[1] - 8.0), up, TEXT_PX, DIM_INK, "rs")


def _draw_linear_grid(canvas: Canvas, scale: _Linear) -> None:
    for value in np.arange(0.0, scale.right * (1 + 1e-9), nice_step(scale.right / 5)):
        _tick(canvas, scale(value, 0.0), scale(value, scale.top), f"{value:g}", below=True)
    for value in np.arange(0.0, scale.top, nice_step(scale.top / 4)):
        _tick(canvas, scale(0.0, value), scale(scale.right, value), f"{value:g}", below=False)


def _draw_log_grid(canvas: Canvas, scale: _Logarithmic) -> None:
    (left, right), (bottom, top) = scale.ranges
    for value in (one for one in NICE if left <= one <= right):
        _tick(canvas, scale(value, bottom), scale(value, top), f"{value:g}", below=True)
    for value in (one for one in NICE if bottom <= one <= top):
        _tick(canvas, scale(left, value), scale(right, value), f"{value:g}", below=False)


def _tick(canvas: Canvas, start: Array, end: Array, text: str, *, below: bool) -> None:
    canvas.line(np.array([start, end]), GRID)
    if below:
        canvas.text(start + np.array([0.0, 8.0]), text, TEXT_PX, DIM_INK, "mt")
    else:
        canvas.text(start - np.array([8.0, 0.0]), text, TEXT_PX, DIM_INK, "rm")


def _runs(known: NDArray[np.bool_]) -> list[slice]:
    """The stretches of at least two points that are known."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], known.astype(np.int8), [0]])))
    return [slice(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a > 1]
