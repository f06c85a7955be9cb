"""Pictures of a prediction: the 95 % radius on the relief, along a path, and of cameras and exposures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from startrack.core.errors import length_text
from startrack.core.types import Array, Bools
from startrack.frames import Site, latlon_from_enu
from startrack.output.picture.axes import GAP_PX, Axes, known_runs, nice_numbers, nice_step
from startrack.output.picture.canvas import (
    BLUISH_GREEN,
    CAPTION_SIZE,
    DIM_INK,
    FAINT_INK,
    INK,
    MAP,
    ORANGE,
    PAPER,
    REDDISH_PURPLE,
    SKY_BLUE,
    TEXT_PX,
    TITLE_PX,
    VERMILLION,
    Box,
    Canvas,
    Colour,
    box_around,
)
from startrack.output.picture.maps import BELOW_PX, LEFT_PX, SEARCH_MARGIN, MapView, draw_distances, map_view, ring
from startrack.output.picture.relief import LABEL_TRIES, edge_cover, extrapolate, ground_of_view, hill_shading

if TYPE_CHECKING:
    from startrack.terrain import Raster, Terrain

HEAD_PX, SIDE_PX, PREDICTION_LEGEND_PX = 84.0, 820, 250  # above a picture, for its title; of the map, and beside it
CURVES_PX = 1100, 620
BOX: Box = (90.0, HEAD_PX, CURVES_PX[0] - 30.0, CURVES_PX[1] - 80.0)
NICE = nice_numbers(-3, 6)
MIN_BOUNDS = 2
LEAST_SPREAD = 0.05  # of the radii, relative: less is one class
# Light to dark, of even steps in lightness (viridis, van der Walt and Smith 2015): the smaller the radius, the lighter.
COLOURS: tuple[Colour, ...] = ((253, 231, 37), (94, 201, 98), (33, 145, 140), (59, 82, 139), (88, 40, 110))
NO_POSITION: Colour = VERMILLION
SHADE = 0.55  # of a colour in the darkest shadow of the relief
CURVES = (SKY_BLUE, ORANGE, BLUISH_GREEN, REDDISH_PURPLE)
LOCATED = 0.9  # share of the draws below which a point is marked


def prediction_picture(
    terrain: Terrain, site: Site, radius95_m: Raster, title: str, lines: list[str]
) -> NDArray[np.uint8]:
    """The search area in colours of the 95 % radius, with contours, a legend and `lines` of text below the title.

    `site` is the terrain's. `radius95_m` is NaN outside of the search area and infinite where half of the draws or more
    have no position.
    """
    canvas = Canvas(round(LEFT_PX) + SIDE_PX + PREDICTION_LEGEND_PX, round(HEAD_PX + BELOW_PX) + SIDE_PX)
    box = (LEFT_PX, HEAD_PX, LEFT_PX + SIDE_PX - 9.0, HEAD_PX + SIDE_PX - 9.0)
    view = map_view(box, (0.0, 0.0), SEARCH_MARGIN * max(terrain.search_radius_m, terrain.rim_radius_m or 0.0))
    bounds_m = class_bounds_m(radius95_m.heights_m)
    window = canvas.window(box)
    radius = _radius_of_pixels(view, site, radius95_m, window.size)
    inside = _draw_classes(window, view, terrain, radius, bounds_m)
    window.line(view.canvas_px(ring((0.0, 0.0), terrain.search_radius_m)), DIM_INK, 2)
    _draw_contours(canvas, window, view, radius, inside, bounds_m)
    draw_distances(canvas, view)
    _draw_head(canvas, LEFT_PX, title, lines)
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
    bounds = [bound for bound in NICE if low < bound < high]
    if len(bounds) < MIN_BOUNDS and high > low * (1.0 + LEAST_SPREAD):
        step = next(one for one in NICE if one >= (high - low) / len(COLOURS))
        bounds = [float(bound) for bound in step * np.arange(np.floor(low / step) + 1, np.ceil(high / step))]
    return bounds[: len(COLOURS) - 1] or [next(bound for bound in NICE if bound >= high)]


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


def _draw_legend(canvas: Canvas, box: Box, bounds_m: list[float], refused: bool) -> None:
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


def path_picture(
    distance_m: Array, radius_m: Array, p_ok: Array, title: str, lines: Sequence[str],
    more: Mapping[str, Array] | None = None,
) -> NDArray[np.uint8]:  # fmt: skip
    """The 95 % radius `radius_m` (k,) against `distance_m` (k,) along a path, below the `title` and `lines`.

    A radius is infinite where half of the draws or more have no position. `p_ok` (k,) is the part of the draws that
    have one; points below LOCATED are marked. `more` has radii (k,) with odometry, by the names of their curves.
    """
    known = np.isfinite(radius_m)
    right_m, top_m = float(distance_m[-1]), 1.15 * float(radius_m[known].max()) if known.any() else 1.0
    axes = _curve_axes((0.0, right_m), (0.0, top_m), title, lines, "distance along the path [m]")
    right_ticks = np.arange(0.0, right_m * (1 + 1e-9), nice_step(right_m / 5))
    _draw_grid(axes, right_ticks, np.arange(0.0, top_m, nice_step(top_m / 4)))
    curves = {"each image alone": radius_m, **(more or {})}
    for colour, values_m in zip(CURVES, curves.values(), strict=False):
        for run in known_runs(np.isfinite(values_m)):
            axes.canvas.line(axes.canvas_px(distance_m[run], values_m[run]), colour, 3)
    for k, name in enumerate(curves if more else ()):
        _draw_name(axes, k, name)
    for distance, radius, share in zip(distance_m, radius_m, p_ok, strict=True):
        if not np.isfinite(radius):
            axes.canvas.cross(axes.canvas_px(distance, 0.97 * top_m), 6.0, VERMILLION, 2)
        elif share < LOCATED:
            axes.canvas.circle(axes.canvas_px(distance, radius), 5.0, VERMILLION, 2)
        else:
            axes.canvas.circle(axes.canvas_px(distance, radius), 4.0, SKY_BLUE, -1)
    if (p_ok < LOCATED).any():
        words = "red circle: fewer than 9 of 10 images give a position; red cross: half of them or fewer"
        axes.canvas.text((BOX[2], BOX[3] + 62.0), words, CAPTION_SIZE, DIM_INK, "rm")
    return axes.canvas.rendered_pixels()


def comparison_picture(variants: Sequence[dict[str, Any]], title: str) -> NDArray[np.uint8]:
    """The median 95 % radius of the places against the exposure, one curve a camera, both scales logarithmic.

    `variants` are records of predictions; the `title` stands above.
    """
    rows = [(one["camera"], one["exposure_s"], one["summary"]["median_radius95_m"]) for one in variants]
    drawn = [row for row in rows if row[2] is not None]
    # From and to nice numbers beyond the values.
    x, y = (
        (max(one for one in NICE if one < min(values) * 0.95), min(one for one in NICE if one > max(values) * 1.05))
        for values in ([row[k] for row in drawn] or [1.0] for k in (1, 2))
    )
    axes = _curve_axes(x, y, title, ["median over the places"], "exposure [s]", logarithmic=True)
    if not drawn:
        middle = (BOX[0] + BOX[2]) / 2, (BOX[1] + BOX[3]) / 2
        axes.canvas.text(middle, "no position at half of the places", TEXT_PX, INK, "mm")
        return axes.canvas.rendered_pixels()
    _draw_grid(axes, *([one for one in NICE if low <= one <= high] for low, high in (x, y)))
    cameras = list(dict.fromkeys(row[0] for row in rows))
    for k, camera in enumerate(cameras):
        own = sorted((exposure, radius) for name, exposure, radius in drawn if name == camera)
        colour = CURVES[k % len(CURVES)]
        points = [axes.canvas_px(exposure, radius) for exposure, radius in own]
        if len(points) > 1:
            axes.canvas.line(np.array(points), colour, 3)
        for point, (exposure, radius) in zip(points, own, strict=True):
            axes.canvas.circle(point, 6.0, colour, -1)
            axes.canvas.label(point, f"{exposure:.3g} s: {length_text(radius, 3)}", CAPTION_SIZE, INK, 14.0, BOX)
        _draw_name(axes, k, camera)
    return axes.canvas.rendered_pixels()


def _curve_axes(
    x: tuple[float, float], y: tuple[float, float], title: str, lines: Sequence[str], across: str,
    logarithmic: bool = False,
) -> Axes:  # fmt: skip
    """Empty axes of radii on a canvas of their own."""
    canvas = Canvas(*CURVES_PX)
    canvas.rectangle(BOX, MAP)
    canvas.rectangle(BOX, FAINT_INK, 1)
    _draw_head(canvas, BOX[0], title, lines)
    canvas.text(((BOX[0] + BOX[2]) / 2, BOX[3] + 2 * TEXT_PX), across, TEXT_PX, DIM_INK, "mt")
    canvas.text((BOX[2], BOX[1] - GAP_PX), "95 % radius [m]", TEXT_PX, DIM_INK, "rs")
    return Axes(canvas, BOX, x, y, logarithmic)


def _draw_head(canvas: Canvas, left: float, title: str, lines: Sequence[str]) -> None:
    canvas.text((left, 14.0), title, TITLE_PX, INK, "lt")
    for k, line in enumerate(lines):
        canvas.text((left, 2 * TITLE_PX + 18.0 * k), line, CAPTION_SIZE, DIM_INK, "lt")


def _draw_grid(axes: Axes, x: Iterable[float], y: Iterable[float]) -> None:
    axes.draw_columns(x, [f"{value:g}" for value in x])
    axes.draw_rows(y, [f"{value:g}" for value in y])


def _draw_name(axes: Axes, k: int, name: str) -> None:
    """The name of the k-th curve in its colour."""
    place = BOX[2] - 12.0, BOX[1] + 12.0 + 24.0 * k
    axes.canvas.text(place, name, TEXT_PX, CURVES[k % len(CURVES)], "rt", halo=True)
