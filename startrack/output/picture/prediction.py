"""Pictures of a prediction: the 95 % radius on the relief, along a path, and of cameras and exposures."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from startrack.core.types import Array, Bools
from startrack.frames import Site, latlon_from_enu
from startrack.output.picture.canvas import DIM_INK, INK, MAP, PAPER, VERMILLION, Canvas, Colour, box_around
from startrack.output.picture.maps import CAPTION_SIZE, MapView, draw_distances, map_view, ring
from startrack.output.picture.relief import edge_cover, extrapolate, ground_of_view, hill_shading

if TYPE_CHECKING:
    from startrack.terrain import Raster, Terrain

from collections.abc import Mapping, Sequence

from startrack.core.errors import length_text
from startrack.output.picture.canvas import (
    BLUISH_GREEN,
    FAINT_INK,
    GRID,
    ORANGE,
    REDDISH_PURPLE,
    SKY_BLUE,
    Box,
)
from startrack.output.picture.maps import nice_step

SIZE_PX, LEFT_PX, HEAD_PX, BELOW_PX, LEGEND_PX = 820, 56.0, 84.0, 52.0, 250
TEXT_PX, TITLE_PX = 17.0, 22.0
NICE_M = tuple(step * 10.0**power for power in range(-2, 5) for step in (1.0, 2.0, 5.0))
MAX_CLASSES, MIN_BOUNDS = 5, 2
LEAST_SPREAD = 0.05  # of the radii, relative: less is one class
# Light to dark, of even steps in lightness (viridis, van der Walt and Smith 2015): the smaller the radius, the lighter.
COLOURS: tuple[Colour, ...] = ((253, 231, 37), (94, 201, 98), (33, 145, 140), (59, 82, 139), (88, 40, 110))
NO_POSITION: Colour = VERMILLION
SHADE = 0.55  # of a colour in the darkest shadow of the relief
LABEL_TRIES = 40


def prediction_picture(
    terrain: Terrain, site: Site, radius95_m: Raster, title: str, lines: list[str]
) -> NDArray[np.uint8]:
    """The search area in colours of the 95 % radius, with contours, a legend and `lines` of text below the title.

    `site` is the terrain's. `radius95_m` is NaN outside of the search area and infinite where half of the draws or more
    have no position.
    """
    canvas = Canvas(round(LEFT_PX) + SIZE_PX + LEGEND_PX, round(HEAD_PX + BELOW_PX) + SIZE_PX)
    box = (LEFT_PX, HEAD_PX, LEFT_PX + SIZE_PX - 9.0, HEAD_PX + SIZE_PX - 9.0)
    view = map_view(box, (0.0, 0.0), 1.07 * max(terrain.search_radius_m, terrain.rim_radius_m or 0.0))
    bounds_m = class_bounds_m(radius95_m.heights_m)
    window = canvas.window(box)
    radius = _radius_of_pixels(view, site, radius95_m, window.size)
    inside = _draw_classes(window, view, terrain, radius, bounds_m)
    window.line(view.canvas_px(ring((0.0, 0.0), terrain.search_radius_m)), DIM_INK, 2)
    _draw_contours(canvas, window, view, radius, inside, bounds_m)
    draw_distances(canvas, view)
    canvas.text((LEFT_PX, 14.0), title, TITLE_PX, INK, "lt")
    for k, line in enumerate(lines):
        canvas.text((LEFT_PX, 44.0 + 18.0 * k), line, CAPTION_SIZE, DIM_INK, "lt")
    _draw_legend(canvas, box, bounds_m, bool(np.isinf(radius95_m.heights_m).any()))
    return canvas.rendered_pixels()


def class_bounds_m(radius_m: NDArray[np.floating[Any]]) -> list[float]:
    """Bounds of the classes between the 2nd and the 98th percentile: 1, 2, 5 times powers of ten, or even steps.

    Even steps where there would be fewer than three classes.
    """
    known = radius_m[np.isfinite(radius_m)]
    if not known.size:
        return []
    low, high = (float(bound) for bound in np.percentile(known, [2, 98]))
    bounds = [bound for bound in NICE_M if low < bound < high]
    if len(bounds) < MIN_BOUNDS and high > low * (1.0 + LEAST_SPREAD):
        step = next(one for one in NICE_M if one >= (high - low) / MAX_CLASSES)
        bounds = [float(bound) for bound in step * np.arange(np.floor(low / step) + 1, np.ceil(high / step))]
    return bounds[: MAX_CLASSES - 1] or [next(bound for bound in NICE_M if bound >= high)]


def _radius_of_pixels(view: MapView, site: Site, radius95_m: Raster, size: tuple[int, int]) -> Array:
    """Radius (H, W) [m] at the window's pixels, infinite without a position; carried beyond the last cells."""
    x, y = (np.linspace(-half, half, n) for half, n in zip(view.half_m, size, strict=True))
    east, north = np.meshgrid(x, y[::-1])
    known = np.isfinite(radius95_m.heights_m)
    at = radius95_m.row_column(*latlon_from_enu(site, east, north, 0.0)).astype(np.float32)
    filled = extrapolate(np.where(known, radius95_m.heights_m, 0.0).astype(np.float32), known)
    nowhere = _sample(np.isinf(radius95_m.heights_m).astype(np.float32), at, cv2.INTER_NEAREST) > 0
    return np.where(nowhere, np.inf, _sample(filled, at, cv2.INTER_LINEAR))


def _sample(values: NDArray[np.float32], row_column: NDArray[np.float32], method: int) -> Array:
    rows, columns = (np.ascontiguousarray(row_column[..., k]) for k in (0, 1))
    return np.asarray(cv2.remap(values, columns, rows, method, borderMode=cv2.BORDER_REPLICATE), dtype=np.float64)


def _draw_classes(window: Canvas, view: MapView, terrain: Terrain, radius: Array, bounds_m: list[float]) -> Bools:
    """The colours of the classes on the relief; where they are drawn (H, W)."""
    ground_m, known = ground_of_view(view, terrain, (window.size[1], window.size[0]))
    x, y = (np.linspace(-half, half, n) for half, n in zip(view.half_m, known.shape[::-1], strict=True))
    known &= np.hypot(x, y[::-1, None]) <= terrain.search_radius_m
    light = cv2.resize(hill_shading(ground_m, known, view.half_m), window.size, interpolation=cv2.INTER_CUBIC)
    palette = np.array([*_class_colours(len(bounds_m) + 1), NO_POSITION], dtype=float)
    number = np.where(np.isinf(radius), len(palette) - 1, np.searchsorted(bounds_m, radius, side="right"))
    shade = SHADE + (1.0 - SHADE) * np.clip(light, 0.0, 1.0)[:, :, None]
    cover = edge_cover(known, window.size)
    colours = np.array(MAP) + cover[:, :, None] * (palette[number] * shade - MAP)
    window.pixels[:] = colours.clip(0, 255).astype(np.uint8)
    return np.asarray(cover > 0.5)


def _draw_contours(
    canvas: Canvas, window: Canvas, view: MapView, radius: Array, inside: Bools, bounds_m: list[float]
) -> None:
    """Contours at the bounds of the classes, with their radius."""
    from skimage.measure import find_contours

    inner = cv2.erode((inside & np.isfinite(radius)).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    left_top = np.array(view.box[:2])
    for bound in bounds_m:
        for line in find_contours(np.where(np.isfinite(radius), radius, 0.0), bound, mask=inner):
            points = line[:, ::-1] + left_top
            window.line(points, PAPER, 2)
            free = [p for p in points[:: max(1, len(points) // LABEL_TRIES)] if canvas.is_free(box_around(p, 30.0))]
            if len(points) > 60 and free:
                canvas.text(free[len(free) // 2], f"{bound:g} m", CAPTION_SIZE, INK, "mm", halo=True)


def _class_colours(count: int) -> list[Colour]:
    at = np.rint(np.linspace(0, len(COLOURS) - 1, count)).astype(int) if count > 1 else [0]
    return [COLOURS[k] for k in at]


def _draw_legend(canvas: Canvas, box: tuple[float, float, float, float], bounds_m: list[float], refused: bool) -> None:
    """The classes in words, to the right of the map."""
    left, top = box[2] + 26.0, box[1] + 14.0
    for k, words in enumerate(("95 of 100 positions", "lie within")):
        canvas.text((left, top + 22.0 * k), words, TEXT_PX, INK, "lt")
    texts = [f"{low:g} to {high:g} m" for low, high in pairwise(bounds_m)]
    texts = [f"less than {bounds_m[0]:g} m", *texts, f"more than {bounds_m[-1]:g} m"] if bounds_m else []
    rows = list(zip(_class_colours(len(texts)), texts, strict=True)) if texts else []
    if refused:
        rows.append((NO_POSITION, "mostly no position"))
    for k, (colour, words) in enumerate(rows):
        y = top + 58.0 + 34.0 * k
        canvas.rectangle((left, y, left + 30.0, y + 22.0), colour)
        canvas.text((left + 42.0, y + 11.0), words, TEXT_PX, INK, "lm")


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
