"""Maps: the search area with the position, the position with its error, residuals of the stars, relief of a terrain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from startrack.core.errors import length_text
from startrack.core.types import Array, Fix
from startrack.estimation.attitude import AttitudeFit
from startrack.output.picture.axes import nice_step
from startrack.output.picture.canvas import (
    CAPTION_SIZE,
    DIM_INK,
    FAINT_INK,
    FLOOR,
    GRID,
    IDENTIFIED,
    INK,
    MAP,
    POSITION,
    TEXT_PX,
    TRUTH,
    Box,
    Canvas,
    box_around,
    mix_colours,
)
from startrack.output.picture.relief import draw_contours, draw_relief, ground_of_view
from startrack.terrain import Terrain

WIDEST_RMS = 4.5  # residuals beyond this many rms are outliers and would squeeze the rest
CIRCLE_RAD = np.linspace(0.0, 2 * np.pi, 181)
SIZE_PX, LEFT_PX, BELOW_PX = 900, 56.0, 52.0  # of the picture of a terrain's map, and beside it, for its scales
SEARCH_MARGIN = 1.07  # of a map, in radii of the search area


@dataclass(frozen=True)
class MapView:
    """Points of enu on the canvas; north is up."""

    box: Box
    centre_m: tuple[float, float]
    metres_per_px: float

    def canvas_px(self, points_m: ArrayLike) -> Array:
        """Canvas pixels (..., 2) of `points_m` (..., 2), east and north."""
        offset = (np.asarray(points_m, dtype=float) - self.centre_m) / self.metres_per_px
        return self.middle + offset * [1.0, -1.0]

    @property
    def middle(self) -> Array:
        left, top, right, bottom = self.box
        return np.array([(left + right) / 2, (top + bottom) / 2])

    @property
    def half_m(self) -> Array:
        """Half of the shown extent, east and north [m]."""
        left, top, right, bottom = self.box
        return np.array([right - left, bottom - top]) / 2 * self.metres_per_px


def map_view(box: Box, centre_m: tuple[float, float], half_m: float) -> MapView:
    """A map in the `box` that shows `half_m` in every direction from `centre_m`, east and north."""
    left, top, right, bottom = box
    return MapView(box, centre_m, 2 * half_m / min(right - left, bottom - top))


def draw_overview(
    canvas: Canvas, box: Box, terrain: Terrain, fix: Fix | None, ambiguous: bool, truth: ArrayLike | None
) -> MapView:
    """Draw the `terrain` as `draw_ground` does, and the position of a `fix`, in the `box` of the `canvas`.

    All positions of the fix are drawn if it is `ambiguous`. `truth` (2,) is the true one, east and north [m].
    """
    rim = terrain.rim_radius_m or 0.0
    view = map_view(box, (0.0, 0.0), SEARCH_MARGIN * max(min(terrain.search_radius_m, terrain.reach_m), rim))
    window = canvas.window(box)
    draw_ground(window, view, terrain)
    if truth is not None:
        window.plus(view.canvas_px(truth), 9.0, TRUTH, 2)
    if fix is not None:
        for k, mode in enumerate(fix.modes if ambiguous else fix.modes[:1]):
            position = view.canvas_px((mode.east_m, mode.north_m))
            window.circle(position, 5.0, POSITION, -1)
            window.circle(position, 9.0, POSITION, 2)
            radius_px = mode.radius95_m / view.metres_per_px
            if ambiguous and 9.0 < radius_px < np.inf:
                window.circle(position, radius_px, POSITION, 2)
            if ambiguous:
                canvas.label(position, f"{k + 1}: {100 * mode.weight:.0f} %", CAPTION_SIZE, INK, 14.0, box)
    draw_frame(canvas, view, "search area, north up")
    return view


def draw_ground(window: Canvas, view: MapView, terrain: Terrain) -> None:
    """The shape of the ground of a `terrain`, or the rim of a cylinder; the search area (dashed) and a grid.

    `window` is the part of the canvas that the `view` fills.
    """
    rim = terrain.rim_radius_m or 0.0
    window.rectangle(view.box, MAP)
    if rim:
        _draw_floor(window, view, rim)
    else:
        draw_relief(window, view, *ground_of_view(view, terrain, (window.size[1], window.size[0])))
    _draw_grid(window, view)
    if rim:
        window.circle(view.canvas_px((0.0, 0.0)), rim / view.metres_per_px, DIM_INK, 2)
    if abs(terrain.search_radius_m - rim) > 0.01 * rim:
        window.dashes(view.canvas_px(ring((0.0, 0.0), terrain.search_radius_m)), DIM_INK)


def _draw_floor(window: Canvas, view: MapView, radius_m: float) -> None:
    """The floor within a rim of `radius_m` about the origin; all of a map that ends within it."""
    if float(np.linalg.norm(np.abs(view.centre_m) + view.half_m)) < radius_m:
        window.rectangle(view.box, FLOOR)
    else:
        window.circle(view.canvas_px((0.0, 0.0)), radius_m / view.metres_per_px, FLOOR, -1)


def draw_zoom(canvas: Canvas, box: Box, fix: Fix, truth: ArrayLike | None) -> MapView:
    """The position with its covariance ellipse (one sigma, filled) and the circle that holds 95 % of the posterior."""
    position = (float(fix.position_enu_m[0]), float(fix.position_enu_m[1]))
    half = 1.3 * fix.radius95_m
    if truth is not None:  # as far out as that is still a zoom
        half = max(half, min(1.3 * float(np.linalg.norm(np.subtract(truth, position))), 4 * half))
    view = map_view(box, position, half)
    window = canvas.window(box)
    window.rectangle(box, MAP)
    _draw_grid(window, view)
    ellipse = view.canvas_px(ellipse_m(position, fix.covariance_m2))
    window.area(ellipse, mix_colours(MAP, POSITION, 0.35))
    window.line(ellipse, mix_colours(MAP, POSITION, 0.8))
    window.circle(view.canvas_px(position), fix.radius95_m / view.metres_per_px, POSITION, 2)
    window.plus(view.canvas_px(position), 8.0, INK, 2)
    if truth is not None and bool(np.all(np.abs(np.subtract(truth, position)) < view.half_m)):
        window.plus(view.canvas_px(truth), 9.0, TRUTH, 2)
        canvas.label(view.canvas_px(truth), "truth", CAPTION_SIZE, TRUTH, 14.0, box)
    draw_frame(canvas, view, f"95 % within {length_text(fix.radius95_m, 3)}")
    return view


def draw_leaders(canvas: Canvas, overview: MapView, zoom: MapView) -> None:
    """Faint lines from the position in the overview to the corners of the zoom below it."""
    position = overview.canvas_px(zoom.centre_m)
    left, top, right, _ = zoom.box
    for corner in ((left, top), (right, top)):
        toward = np.asarray(corner) - position
        start = position + 12.0 * toward / np.linalg.norm(toward)
        canvas.line(np.array([start, corner]), FAINT_INK)


def distance_text(metres: float) -> str:
    """A scale bar's length of `metres` in words."""
    return f"{metres / 1000:g} km" if metres >= 1000 else f"{metres:g} m" if metres >= 0.1 else f"{100 * metres:g} cm"


def ring(centre_m: tuple[float, float], radius_m: float) -> Array:
    """Points (n, 2) of a circle."""
    return np.asarray(centre_m) + radius_m * np.stack([np.sin(CIRCLE_RAD), np.cos(CIRCLE_RAD)], axis=-1)


def ellipse_m(centre_m: tuple[float, float], covariance_m2: Array) -> Array:
    """Points (n, 2) [m] of the ellipse of one sigma of `covariance_m2` (2, 2) about `centre_m`."""
    lengths, axes = np.linalg.eigh(covariance_m2)
    half_m = np.sqrt(np.maximum(lengths, 0.0))
    return np.asarray(centre_m) + (ring((0.0, 0.0), 1.0) * half_m) @ axes.T


def grid_lines_m(view: MapView, axis: int) -> Array:
    """Coordinates of the grid's lines [m], east (axis 0) or north (1)."""
    step = nice_step(0.7 * float(view.half_m.min()))
    low, high = view.centre_m[axis] - view.half_m[axis], view.centre_m[axis] + view.half_m[axis]
    return np.arange(np.ceil(low / step), high / step) * step


def _draw_grid(window: Canvas, view: MapView) -> None:
    low, high = view.centre_m - view.half_m, view.centre_m + view.half_m
    for axis in (0, 1):
        for value in grid_lines_m(view, axis):
            ends = np.array([low, high])
            ends[:, axis] = value
            window.line(view.canvas_px(ends), GRID)


def draw_frame(canvas: Canvas, view: MapView, caption: str) -> None:
    """Frame, `caption` and scale bar of the `view` on the `canvas`."""
    left, top, right, bottom = view.box
    canvas.rectangle(view.box, FAINT_INK, 1)
    canvas.text((left + 12, top + 12), caption, CAPTION_SIZE, DIM_INK, "lt", halo=True)
    length_m = nice_step(0.3 * 2 * float(view.half_m[0]))
    length = length_m / view.metres_per_px
    x, y = right - 14 - length, bottom - 14
    canvas.line([(x, y - 6), (x, y), (x + length, y), (x + length, y - 6)], INK, 2)
    canvas.text((x + length / 2, y - 10), distance_text(length_m), CAPTION_SIZE, INK, "ms", halo=True)


def draw_residuals(canvas: Canvas, box: Box, fit: AttitudeFit) -> None:
    """Measured minus predicted pixels of the stars that the attitude rests on, with rings to read them by."""
    left, top, right, bottom = box
    window, middle = canvas.window(box), np.array([(left + right) / 2, (top + bottom) / 2])
    window.rectangle(box, MAP)
    residual_px = fit.residual_px[fit.used]
    reach_px = WIDEST_RMS * max(fit.rms_px, 1e-3)
    scale = 0.5 * min(right - left, bottom - top) / reach_px
    step = nice_step(reach_px / 2)
    for ring in np.arange(step, 2 * reach_px, step):
        window.circle(middle, ring * scale, GRID)
    window.line([(left, middle[1]), (right, middle[1])], GRID)
    window.line([(middle[0], top), (middle[0], bottom)], GRID)
    for position in middle + scale * residual_px:
        window.circle(position, 2.0, mix_colours(IDENTIFIED, INK, 0.15), -1)
    canvas.rectangle(box, FAINT_INK, 1)
    canvas.text((left + 12, top + 12), "measured minus predicted", CAPTION_SIZE, DIM_INK, "lt", halo=True)
    canvas.text(
        middle + 2 * step * scale * np.array([0.707, -0.707]), f"{2 * step:g} px", CAPTION_SIZE, INK, "mm", halo=True
    )


def relief_picture(terrain: Terrain, position_m: tuple[float, float] | None = None) -> NDArray[np.uint8]:
    """The relief (H, W, 3) of a `terrain`, lit from the north-west, with contours and the search area (dashed).

    `position_m`, east and north, is marked if it is given.
    """
    canvas = Canvas(SIZE_PX + round(LEFT_PX), SIZE_PX + round(BELOW_PX))
    box = (LEFT_PX, 8.0, LEFT_PX + SIZE_PX - 9.0, SIZE_PX - 1.0)
    view = draw_overview(canvas, box, terrain, None, False, None)
    canvas.text((box[2] - 13.0, box[1] + 12.0), terrain.name, TEXT_PX, INK, "rt", halo=True)
    if position_m is not None:
        canvas.circle(view.canvas_px(position_m), 6.0, POSITION, -1)
        canvas.circle(view.canvas_px(position_m), 11.0, POSITION, 2)
        canvas.reserve(box_around(view.canvas_px(position_m), 14.0))
    draw_distances(canvas, view)
    if terrain.rim_radius_m is None:
        window = canvas.window(box)
        step_m = draw_contours(canvas, window, view, *ground_of_view(view, terrain, (window.size[1], window.size[0])))
        if step_m is not None:
            words = f"contours each {step_m:g} m, heights above the sphere at the origin"
            canvas.text((box[0] + 12.0, box[3] - 14.0), words, CAPTION_SIZE, DIM_INK, "ls", halo=True)
    return canvas.rendered_pixels()


def draw_distances(canvas: Canvas, view: MapView) -> None:
    """East and north of the lines of the grid, on the `canvas` outside of the map `view`."""
    left, _, right, bottom = view.box
    unit, metres = ("km", 1000.0) if float(view.half_m.min()) >= 2000.0 else ("m", 1.0)
    for east_m in grid_lines_m(view, 0):
        x = float(view.canvas_px((east_m, 0.0))[0])
        canvas.text((x, bottom + 8), f"{east_m / metres:g}", TEXT_PX, DIM_INK, "mt")
    for north_m in grid_lines_m(view, 1):
        y = float(view.canvas_px((0.0, north_m))[1])
        canvas.text((left - 8, y), f"{north_m / metres:g}", TEXT_PX, DIM_INK, "rm")
    canvas.text(((left + right) / 2, bottom + 28), f"east and north of the origin [{unit}]", TEXT_PX, DIM_INK, "mt")
