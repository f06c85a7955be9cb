"""The picture of a prediction: on the relief, how large the 95 % radius is, and where an image gives no position."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from startrack.core.types import Array, Bools
from startrack.frames import Site, latlon_from_enu
from startrack.output.picture.canvas import DIM_INK, INK, MAP, PAPER, VERMILLION, Canvas, Colour, box_around
from startrack.output.picture.maps import CAPTION_SIZE, MapView, map_view, ring
from startrack.output.picture.relief import edge_cover, extrapolate, ground_of_view, hill_shading
from startrack.output.picture.terrain_picture import draw_distances

if TYPE_CHECKING:
    from startrack.terrain import Raster, Terrain

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
