"""Pictures of a terrain: its relief with the search area, and the panorama seen from a position."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from startrack.output.picture.canvas import (
    DIM_INK,
    FAINT_INK,
    FLOOR,
    GRID,
    INK,
    MAP,
    POSITION,
    SKYLINE,
    Box,
    Canvas,
    box_around,
)
from startrack.output.picture.maps import CAPTION_SIZE, MapView, draw_overview, grid_lines_m, nice_step
from startrack.output.picture.relief import draw_contours, ground_of_view
from startrack.terrain import Terrain
from startrack.types import Array

SIZE_PX = 900
LEFT_PX, BELOW_PX = 56.0, 52.0  # beside the map, for its scales
PANORAMA_PX = (1440, 420)
MARGIN_PX = 56.0
TEXT_PX = 17.0
STEP_DEG = 0.1
COMPASS = {0: "N", 90: "E", 180: "S", 270: "W"}


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
    _draw_distances(canvas, view)
    if terrain.rim_radius_m is None:
        window = canvas.window(box)
        step_m = draw_contours(canvas, window, view, *ground_of_view(view, terrain, (window.size[1], window.size[0])))
        if step_m is not None:
            words = f"contours each {step_m:g} m, heights above the origin"
            canvas.text((box[0] + 12.0, box[3] - 14.0), words, CAPTION_SIZE, DIM_INK, "ls", halo=True)
    return canvas.rendered_pixels()


def _draw_distances(canvas: Canvas, view: MapView) -> None:
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


def panorama_picture(terrain: Terrain, position_m: tuple[float, float]) -> NDArray[np.uint8]:
    """The horizon (H, W, 3) from north to north, azimuth to the right, seen by a camera at a position."""
    azimuth_rad = np.radians(np.arange(0.0, 360.0 + STEP_DEG / 2, STEP_DEG))
    horizon_rad = terrain.horizon_rad(np.array(position_m)[None], azimuth_rad)
    title = f"{terrain.name}: horizon seen from E {position_m[0]:.0f} m, N {position_m[1]:.0f} m"
    return skyline_picture(azimuth_rad, horizon_rad, title)


def skyline_picture(
    azimuth_rad: Array, elevation_rad: Array, title: str, sigma_rad: Array | None = None
) -> NDArray[np.uint8]:
    """A skyline (H, W, 3) from north to north: elevations (n,) at ascending azimuths (n,), nan where unknown.

    `sigma_rad` (n,): errors, drawn as two thin lines.
    """
    width, height = PANORAMA_PX
    canvas = Canvas(width, height)
    azimuth_deg, horizon_deg = np.degrees(azimuth_rad), np.degrees(elevation_rad)
    shown = horizon_deg[np.isfinite(horizon_deg)]
    low, high = min(float(shown.min(initial=0.0)), 0.0), float(shown.max(initial=0.0))
    step = nice_step(max(high - low, 2.0) / 3)
    low, high = np.floor(low / step) * step, np.ceil((high + 0.3 * step) / step) * step
    box = (MARGIN_PX, 34.0, width - 16.0, height - 40.0)
    canvas.rectangle(box, MAP)

    def canvas_px(azimuth: Array | float, elevation: Array | float) -> Array:
        x = box[0] + np.asarray(azimuth) / 360 * (box[2] - box[0])
        y = box[3] - (np.asarray(elevation) - low) / (high - low) * (box[3] - box[1])
        return np.stack(np.broadcast_arrays(x, y), axis=-1)

    runs = _runs(np.isfinite(horizon_deg))
    for run in runs:
        at, top = azimuth_deg[run], horizon_deg[run]
        ground = np.concatenate([canvas_px(at, top), canvas_px(np.array([at[-1], at[0]]), low)])
        canvas.window(box).area(ground, FLOOR)
    _draw_scales(canvas, box, canvas_px, low, high, step)
    for run in runs:
        at, top = azimuth_deg[run], horizon_deg[run]
        if sigma_rad is not None:
            for shift in (-np.degrees(sigma_rad[run]), np.degrees(sigma_rad[run])):
                canvas.window(box).line(canvas_px(at, top + shift), FAINT_INK)
        canvas.window(box).curve(canvas_px(at, top), SKYLINE, 2.0)
    canvas.text((box[0], 9.0), title, TEXT_PX, INK, "lt")
    return canvas.rendered_pixels()


def _runs(known: NDArray[np.bool_]) -> list[slice]:
    """Stretches of at least two known points."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(np.int8)))
    return [slice(first, last) for first, last in edges.reshape(-1, 2) if last - first > 1]


def _draw_scales(canvas: Canvas, box: Box, canvas_px, low: float, high: float, step: float) -> None:  # type: ignore[no-untyped-def]
    for elevation in np.arange(low, high + step / 2, step):
        canvas.line(canvas_px(np.array([0.0, 360.0]), elevation), GRID if elevation else FAINT_INK)
        canvas.text((box[0] - 8, float(canvas_px(0.0, elevation)[1])), f"{elevation:g}°", TEXT_PX, DIM_INK, "rm")
    for azimuth in range(0, 361, 30):
        canvas.line([canvas_px(azimuth, low), canvas_px(azimuth, low) + np.array([0.0, 6.0])], DIM_INK)
        name = COMPASS.get(azimuth % 360, f"{azimuth}°")
        canvas.text((float(canvas_px(azimuth, low)[0]), box[3] + 10), name, TEXT_PX, DIM_INK, "mt")
    canvas.rectangle(box, FAINT_INK, 1)
