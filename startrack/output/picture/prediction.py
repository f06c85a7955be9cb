"""Pictures of a prediction: the 95 % radius on the relief, along a path, and of cameras and exposures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from startrack.core.errors import length_text
from startrack.core.types import Array, Bools
from startrack.frames import Site, latlon_from_enu
from startrack.output.picture.canvas import LINE_PX, NICE, TEXT_PX, TITLE_PX, Axes, Canvas, Colour, Ink, rgb_colours
from startrack.output.picture.maps import (
    BELOW_PX,
    MARGIN_PX,
    SEARCH_MARGIN,
    SIDE_PX,
    Map,
    cell_points,
    edge_cover,
    extrapolate_values,
    hill_shading,
    ring,
)

if TYPE_CHECKING:
    from startrack.terrain import Raster, Terrain

HEAD_PX, KEY_PX = 6 * TEXT_PX, 16 * TEXT_PX  # above a picture, for its title; beside a map, for its legend
LEAST_SPREAD = 0.05  # of the radii, relative: less is one class
# Light to dark, of even steps in lightness (viridis, van der Walt and Smith 2015): the smaller the radius, the lighter.
COLOURS = rgb_colours("fde725 5ec962 21918c 3b528b 58286e")
SHADE = 0.55  # of a colour in the darkest shadow of the relief
CURVES = (Ink.BLUE, Ink.ORANGE, Ink.GREEN, Ink.PURPLE)
MOST_CONTOURS, SCALE_PX = 3, 220
RADIUS = "95 % radius [m]"
LOCATED = 0.9  # share of the draws below which a point is marked


def prediction_picture(
    terrain: Terrain, site: Site, radius95_m: Raster, title: str, lines: list[str]
) -> NDArray[np.uint8]:
    """The search area in colours of the 95 % radius, with contours, their scale and `lines` of text below the title.

    `site` is the terrain's. `radius95_m` is NaN outside of the search area and infinite where half of the draws or more
    have no position.
    """
    box = (MARGIN_PX, HEAD_PX, MARGIN_PX + SIDE_PX, HEAD_PX + SIDE_PX)
    canvas = _headed_canvas(round(box[2] + KEY_PX), round(box[3] + BELOW_PX), title, lines)
    half_m = SEARCH_MARGIN * max(terrain.search_radius_m, terrain.rim.radius_m if terrain.rim else 0.0)
    drawn, bounds_m = Map.of_extent(canvas, box, (0.0, 0.0), half_m), class_bounds_m(radius95_m.heights_m)
    radius, ends_m = _radius_of_pixels(drawn, site, radius95_m), _scale_ends_m(radius95_m.heights_m)
    inside = _draw_colours(drawn, terrain, _colours_of(radius, ends_m))
    drawn.window.line(drawn.canvas_px(ring((0.0, 0.0), terrain.search_radius_m)), Ink.DIM, 2)
    known = np.isfinite(radius)
    inside = cv2.erode((inside & known).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    few = np.linspace(0, len(bounds_m) - 1, min(MOST_CONTOURS, len(bounds_m))).astype(int)
    bounds_m = [bounds_m[k] for k in few]
    levels = {bound: f"{bound:g} m" for bound in bounds_m}
    drawn.draw_contours(np.where(known, radius, 0.0), levels, inside, Ink.PAPER, 2)
    drawn.draw_distances()
    left, top = box[2] + 1.5 * TEXT_PX, box[1] + TEXT_PX
    top = canvas.paragraph(left, top, "95 of 100 positions lie within", KEY_PX - 3 * TEXT_PX, Ink.PLAIN)
    top = _draw_scale(canvas, left, top, ends_m, bounds_m)
    if np.isinf(radius95_m.heights_m).any():
        canvas.legend(left, top + LINE_PX, KEY_PX - TEXT_PX, [("box", Ink.VERMILLION, "mostly no position")])
    _draw_north(canvas, (box[2] - 2 * TEXT_PX, box[1] + 3 * TEXT_PX))
    return canvas.rendered_pixels()


def _scale_ends_m(radius_m: NDArray[np.floating[Any]]) -> tuple[float, float]:
    """Radii of the first and the last colour: the 2nd and the 98th percentile of those that are finite."""
    known = radius_m[np.isfinite(radius_m)]
    low, high = np.percentile(known, [2, 98]).tolist() if known.size else (1.0, 1.0)
    return low, max(high, low * (1.0 + LEAST_SPREAD))


def _colours_of(radius_m: Array, ends_m: tuple[float, float]) -> Array:
    """Colours (..., 3) of radii (...), by their logarithm between the ends; of infinite ones Ink.VERMILLION."""
    low, high = np.log(np.maximum(ends_m, 1e-9))
    with np.errstate(divide="ignore"):
        part = (np.log(np.maximum(radius_m, 1e-9)) - low) / (high - low)
    at, known = np.linspace(0.0, 1.0, len(COLOURS)), np.isfinite(radius_m)
    ramp = np.array(COLOURS, dtype=float)
    mixed = np.stack([np.interp(np.where(known, part, 0.0), at, ramp[:, k]) for k in range(3)], axis=-1)
    return np.where(known[..., None], mixed, np.array(Ink.VERMILLION, dtype=float))


def _draw_scale(
    canvas: Canvas, left: float, top: float, ends_m: tuple[float, float], bounds_m: list[float]
) -> float:  # fmt: skip
    """The scale of the colours, with the contours' radii and its ends beside it; the place below it [px]."""
    heights = np.arange(SCALE_PX)
    radii_m = np.exp(np.interp(heights, [0, SCALE_PX - 1], np.log(ends_m)))
    for height, colour in zip(heights, _colours_of(radii_m, ends_m).round().astype(int).tolist(), strict=True):
        canvas.rectangle((left, top + height, left + TEXT_PX, top + height), (colour[0], colour[1], colour[2]))
    occupied: list[float] = []
    for radius_m in [*bounds_m, *ends_m]:
        y = top + float(np.interp(np.log(radius_m), np.log(ends_m), [0, SCALE_PX - 1]))
        if all(abs(y - other) > TEXT_PX for other in occupied):
            occupied.append(y)
            words = length_text(radius_m, 3)
            if radius_m in bounds_m:
                words = f"{radius_m:g} m"  # as beside the contour
                canvas.line([(left, y), (left + TEXT_PX, y)], Ink.PAPER, 2)
            canvas.text((left + 1.6 * TEXT_PX, y), words, anchor="lm")
    return top + SCALE_PX + TEXT_PX


def _draw_north(canvas: Canvas, tip: tuple[float, float]) -> None:
    """An arrow up, with its letter."""
    x, y = tip
    canvas.area([(x, y), (x - 0.4 * TEXT_PX, y + 1.2 * TEXT_PX), (x + 0.4 * TEXT_PX, y + 1.2 * TEXT_PX)], Ink.PLAIN)
    canvas.text((x, y - TEXT_PX / 4), "N", Ink.PLAIN, "ms")


def radius_classes(radius_m: NDArray[np.floating[Any]]) -> list[tuple[float, str, Colour]]:
    """Classes of radii (...): upper bound [m], words and colour, the smallest first; the last bound is infinite.

    Values of `radius_m` that are not finite have no class; without any other there is none.
    """
    bounds_m = class_bounds_m(radius_m)
    if not bounds_m:
        return []
    texts = [f"{low:g} to {high:g} m" for low, high in pairwise(bounds_m)]
    texts = [f"less than {bounds_m[0]:g} m", *texts, f"more than {bounds_m[-1]:g} m"]
    at = np.rint(np.linspace(0, len(COLOURS) - 1, len(texts))).astype(int)
    return list(zip([*bounds_m, np.inf], texts, [COLOURS[k] for k in at], strict=True))


def class_bounds_m(radius_m: NDArray[np.floating[Any]]) -> list[float]:
    """Bounds of the classes between the 2nd and the 98th percentile: 1, 2, 5 times powers of ten, or even steps.

    Even steps where there would be fewer than three classes.
    """
    known = radius_m[np.isfinite(radius_m)]
    if not known.size:
        return []
    low, high = (float(bound) for bound in np.percentile(known, [2, 98]))
    bounds = [bound for bound in NICE if low < bound < high]
    if len(bounds) < 2 and high > low * (1.0 + LEAST_SPREAD):
        step = next(one for one in NICE if one >= (high - low) / len(COLOURS))
        bounds = [float(bound) for bound in step * np.arange(np.floor(low / step) + 1, np.ceil(high / step))]
    return bounds[: len(COLOURS) - 1] or [next(bound for bound in NICE if bound >= high)]


def _radius_of_pixels(drawn: Map, site: Site, radius95_m: Raster) -> Array:
    """Radius (H, W) [m] at the map's pixels, infinite without a position; carried beyond the last cells."""
    east, north = np.moveaxis(cell_points(drawn.half_m, drawn.window.pixels.shape[:2]), -1, 0)
    at = radius95_m.row_column(*latlon_from_enu(site, east, north, 0.0)).astype(np.float32)
    row, column = (np.ascontiguousarray(at[..., k]) for k in (0, 1))
    known = np.isfinite(radius95_m.heights_m)
    finite = extrapolate_values(np.where(known, radius95_m.heights_m, 0.0).astype(np.float32), known)
    filled, nowhere = (
        cv2.remap(values.astype(np.float32), column, row, method, borderMode=cv2.BORDER_REPLICATE)
        for values, method in ((finite, cv2.INTER_LINEAR), (np.isinf(radius95_m.heights_m), cv2.INTER_NEAREST))
    )
    return np.where(nowhere > 0, np.inf, filled)


def _draw_colours(drawn: Map, terrain: Terrain, colours: Array) -> Bools:
    """The `colours` (H, W, 3) on the relief; where they are drawn (H, W)."""
    ground_m, known = drawn.ground(terrain)
    known &= np.linalg.norm(cell_points(drawn.half_m, known.shape), axis=-1) <= terrain.search_radius_m
    window = drawn.window
    light = cv2.resize(hill_shading(ground_m, known, drawn.half_m), window.size, interpolation=cv2.INTER_CUBIC)
    shade = SHADE + (1.0 - SHADE) * np.clip(light, 0.0, 1.0)[:, :, None]
    cover, paper = edge_cover(known, window.size), np.array(Ink.PAPER)
    lit = paper + cover[:, :, None] * (colours * shade - paper)
    window.pixels[:] = lit.clip(0, 255).astype(np.uint8)
    return np.asarray(cover > 0.5)


def path_picture(
    distance_m: Array, radius_m: Array, p_ok: Array, title: str, lines: Sequence[str],
    more: Mapping[str, Array] | None = None,
) -> NDArray[np.uint8]:  # fmt: skip
    """The 95 % radius `radius_m` (k,) against `distance_m` (k,) along a path, below the `title` and `lines`.

    A radius is infinite where half of the draws or more have no position. `p_ok` (k,) is the part of the draws that
    have one; points below LOCATED are marked. `more` has radii (k,) with odometry, by the names of their curves.
    """
    top_m = 1.15 * float(radius_m.max(initial=0.0, where=np.isfinite(radius_m))) or 1.0
    curves = {"each image alone": radius_m, **(more or {})}
    if (p_ok < LOCATED).any():
        lines = [*lines, "red circle: fewer than 9 of 10 images give a position; red cross: half of them or fewer"]
    axes = _curve_axes(title, lines, (0.0, float(distance_m[-1])), (0.0, top_m))
    axes.draw_scales(RADIUS, "distance along the path [m]", zip(curves, CURVES, strict=False))
    for colour, values_m in zip(CURVES, curves.values(), strict=False):
        axes.draw_curve(distance_m, values_m, colour)
    for distance, radius, share in zip(distance_m, radius_m, p_ok, strict=True):
        if not np.isfinite(radius):
            axes.canvas.mark(axes.canvas_px(distance, 0.97 * top_m), "cross", TEXT_PX / 3, Ink.VERMILLION)
        elif share < LOCATED:
            axes.canvas.mark(axes.canvas_px(distance, radius), "ring", TEXT_PX / 3, Ink.VERMILLION)
        else:
            axes.canvas.mark(axes.canvas_px(distance, radius), "disc", TEXT_PX / 4, Ink.BLUE)
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
    colours = {camera: CURVES[k % len(CURVES)] for k, camera in enumerate(dict.fromkeys(row[0] for row in rows))}
    lines = ["median over the places"] if drawn else ["no position at half of the places"]
    axes = _curve_axes(title, lines, x, y, "xy")
    axes.draw_scales(RADIUS, "exposure [s]", colours.items())
    for camera, colour in colours.items():
        own = np.array(sorted(row[1:] for row in drawn if row[0] == camera)).reshape(-1, 2)
        axes.draw_curve(own[:, 0], own[:, 1], colour, TEXT_PX / 3)
        for exposure, radius in own:
            words = f"{exposure:.3g} s: {length_text(radius, 3)}"
            axes.canvas.label(axes.canvas_px(exposure, radius), words, Ink.PLAIN, TEXT_PX, axes.box)
    return axes.canvas.rendered_pixels()


def _curve_axes(
    title: str, lines: Sequence[str], x: tuple[float, float], y: tuple[float, float], logarithmic: str = ""
) -> Axes:
    """Axes for curves of radii on a canvas of their own, with a `title` and `lines` above."""
    box = (MARGIN_PX, HEAD_PX + LINE_PX, MARGIN_PX + 1.2 * SIDE_PX, HEAD_PX + LINE_PX + SIDE_PX / 2)
    canvas = _headed_canvas(round(box[2] + BELOW_PX), round(box[3] + MARGIN_PX), title, lines)
    return Axes(canvas, box, x, y, logarithmic)


def _headed_canvas(width: int, height: int, title: str, lines: Sequence[str]) -> Canvas:
    """A canvas with a title and lines of text at its top."""
    canvas = Canvas(width, height)
    canvas.text((MARGIN_PX, TEXT_PX), title, Ink.PLAIN, "lt", TITLE_PX)
    for k, line in enumerate(lines):
        canvas.text((MARGIN_PX, 2 * TITLE_PX + LINE_PX * k), line, anchor="lt")
    return canvas
