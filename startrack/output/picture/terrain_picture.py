"""The picture of a terrain: its relief with the search area."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from startrack.output.picture.canvas import DIM_INK, INK, POSITION, Canvas, box_around
from startrack.output.picture.maps import CAPTION_SIZE, MapView, draw_overview, grid_lines_m
from startrack.output.picture.relief import draw_contours, ground_of_view
from startrack.terrain import Terrain

SIZE_PX = 900
LEFT_PX, BELOW_PX = 56.0, 52.0  # beside the map, for its scales
TEXT_PX = 17.0


def relief_picture(terrain: Terrain, position_m: tuple[float, float] | None = None) -> NDArray[np.uint8]:
    """The relief (H, W, 3), lit from the north-west, with contours, the search area (dashed) and the position."""
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
    """East and north of the grid's lines, outside of the map."""
    left, _, right, bottom = view.box
    unit, metres = ("km", 1000.0) if float(view.half_m.min()) >= 2000.0 else ("m", 1.0)
    for east_m in grid_lines_m(view, 0):
        x = float(view.canvas_px((east_m, 0.0))[0])
        canvas.text((x, bottom + 8), f"{east_m / metres:g}", TEXT_PX, DIM_INK, "mt")
    for north_m in grid_lines_m(view, 1):
        y = float(view.canvas_px((0.0, north_m))[1])
        canvas.text((left - 8, y), f"{north_m / metres:g}", TEXT_PX, DIM_INK, "rm")
    canvas.text(((left + right) / 2, bottom + 28), f"east and north of the origin [{unit}]", TEXT_PX, DIM_INK, "mt")
