"""The annotated picture of a result: the exposure with stars and skyline, and a panel with maps and quantities."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from startrack.chain import Detected, Identified, Inputs, Located, Measured, Oriented, Outcome, last_value
from startrack.output.picture.backdrop import View, backdrop, fit_to_canvas
from startrack.output.picture.canvas import (
    BODY,
    DETECTION,
    DIM_INK,
    FAINT_INK,
    HIDDEN,
    IDENTIFIED,
    INK,
    MEASURED,
    PANEL,
    POSITION,
    SKYLINE,
    STATUS,
    TEXT_PX,
    TRUTH,
    Box,
    Canvas,
    Colour,
    text_width,
    wrap_text,
)
from startrack.output.picture.maps import draw_leaders, draw_overview, draw_residuals, draw_zoom
from startrack.output.picture.marks import (
    draw_bodies,
    draw_compass,
    draw_detections,
    draw_hidden,
    draw_measured_skyline,
    draw_skyline,
    name_stars,
    wall_mask,
)
from startrack.output.record import at_stage, image_name
from startrack.output.text import Rows, rows
from startrack.output.values import mode_text, modes_record

PANEL_WIDTH, PANEL_HEIGHT = 620, 1160
PANEL_MARGIN = 28
FACT_SIZE = 20.0
FACT_STEP, LEGEND_STEP = 1.6 * FACT_SIZE, round(1.6 * TEXT_PX)
VALUE_AT = 7.5 * FACT_SIZE  # from the left margin
OVERVIEW_PART = 0.58  # of the height left for maps
LOWEST_FIGURE_PX = 6 * FACT_SIZE
MAX_MODES = 4


def draw_panel(canvas: Canvas, left: int, outcome: Outcome, truth_enu_m: tuple[float, float] | None) -> None:
    """Fill the canvas from `left` to its right edge, top to bottom."""
    width, height = canvas.size
    canvas.rectangle((left, 0, width - 1, height - 1), PANEL)
    left, right = left + PANEL_MARGIN, width - PANEL_MARGIN
    value = last_value(outcome)
    facts, legend = _facts(value), _legend(value, truth_enu_m is not None)
    legend_top = height - PANEL_MARGIN - LEGEND_STEP * len(legend) - 14
    top = _draw_header(canvas, left, right, outcome)
    room = (left, top, right, legend_top - 30 - FACT_STEP * len(facts))
    y = _draw_figures(canvas, room, value, truth_enu_m)
    for name, fact in facts:
        y += FACT_STEP
        canvas.text((left, y), name, FACT_SIZE, DIM_INK)
        canvas.text((left + VALUE_AT, y), fact, FACT_SIZE, INK)
    if legend:
        canvas.line([(left, legend_top), (right, legend_top)], FAINT_INK)
    for row, (kind, colour, text) in enumerate(legend):
        y = legend_top + 14 + LEGEND_STEP * (row + 1)
        draw_legend_sample(canvas, left + 12, y - 6, kind, colour)
        canvas.text((left + 36, y), text, TEXT_PX, DIM_INK)


def _draw_header(canvas: Canvas, left: float, right: float, outcome: Outcome) -> float:
    """Name of the image, status, and the message of a result that is not ok; returns where the next thing may stand."""
    status = outcome.status.upper()
    badge = text_width(status, FACT_SIZE) + PANEL_MARGIN
    canvas.rectangle((right - badge, PANEL_MARGIN, right, PANEL_MARGIN + 36), STATUS[outcome.status])
    canvas.text((right - badge / 2, PANEL_MARGIN + 18), status, FACT_SIZE, (255, 255, 255), "mm")
    name = _shorten_text(image_name(outcome.exposure), 27.0, right - left - badge - 20)
    canvas.text((left, PANEL_MARGIN + 28), name, 27.0, INK)
    y = float(PANEL_MARGIN + 36 + 28)
    canvas.text((left, y), _shorten_text(_inputs_text(last_value(outcome)), TEXT_PX, right - left), TEXT_PX, DIM_INK)
    y += 18
    if outcome.status == "ok":
        return y
    y += 12
    reason = (outcome.reason or "").replace("_", " ")
    canvas.text((left, y + 14), reason, 22.0, STATUS[outcome.status])
    y += 26
    for line in wrap_text(outcome.message, FACT_SIZE, right - left)[:8]:
        y += 28
        canvas.text((left, y - 6), line, FACT_SIZE, INK)
    return y + 16


def _inputs_text(value: Inputs) -> str:
    """Camera, terrain and exposure in words."""
    camera, terrain, exposure_s = value.camera, value.terrain, value.exposure.exposure_s
    parts = [f"camera {camera.name}"] if camera is not None else []
    parts += [f"terrain {terrain.name}"] if terrain is not None else []
    parts += [f"{exposure_s:.3g} s exposure"] if exposure_s is not None else []
    return "   ".join(parts)


def _draw_figures(canvas: Canvas, room: Box, value: Inputs, truth: tuple[float, float] | None) -> float:
    """Maps where there is a terrain, else residuals; returns where the next thing may stand."""
    left, top, right, bottom = room
    zoomed = _has_circle(value)
    tallest = right - left if not zoomed else np.inf
    bottom = min(bottom, top + tallest)
    if bottom - top < LOWEST_FIGURE_PX:
        return top
    if value.terrain is None:
        if not isinstance(value, Oriented):
            return top
        draw_residuals(canvas, (left, top, right, bottom), value.attitude_fit)
        return bottom + 12
    split = top + (OVERVIEW_PART if zoomed else 1.0) * (bottom - top)
    fix = value.fix if isinstance(value, Located) else None
    ambiguous = fix is not None and fix.ambiguous
    overview = draw_overview(canvas, (left, top, right, split), value.terrain, fix, ambiguous, truth)
    if fix is not None and zoomed:
        zoom = draw_zoom(canvas, (left, split + 16, right, bottom), fix, truth)
        draw_leaders(canvas, overview, zoom)
    return bottom + 12


def _has_circle(value: Inputs) -> bool:
    """Whether the `value` has a position with a circle that can be drawn."""
    return isinstance(value, Located) and not value.fix.ambiguous and bool(np.isfinite(value.fix.radius95_m))


def _facts(value: Inputs) -> Rows:
    """Names and texts of the quantities that the panel shows."""
    when = value.exposure.time_utc
    found = [("Time", f"{when:%Y-%m-%d  %H:%M:%S} UTC" if when is not None else "not known")]
    if isinstance(value, Located) and value.fix.ambiguous:
        modes = modes_record(value.fix)[:MAX_MODES]
        found += [(f"Position {k + 1}", mode_text(mode)) for k, mode in enumerate(modes)]
    return found + rows("panel", at_stage(value))


def _legend(value: Inputs, truth: bool) -> list[tuple[str, Colour, str]]:
    found: list[tuple[str, Colour, str]] = []
    if isinstance(value, Identified):
        found += [("ring", IDENTIFIED, "star of the catalogue, identified")]
    if isinstance(value, Detected):
        other = "other point source" if isinstance(value, Identified) else "point source"
        found += [("ring", DETECTION, other)]
    if isinstance(value, Measured):
        found += [("cross", HIDDEN, "star that should be here, and is hidden")]
    if isinstance(value, Oriented) and value.bodies:
        found += [("ring", BODY, "planet, Sun, Earth or Moon, where it must be")]
    if isinstance(value, Located) and not value.fix.ambiguous:
        found += [("line", SKYLINE, "skyline of the terrain seen from the position found")]
        if value.sky_light is not None:
            found += [("dot", MEASURED, "skyline where the light of the sky stops")]
        around = "; circle 95 %, ellipse one sigma" if _has_circle(value) else ""
        found += [("disc", POSITION, f"position{around}")]
    if isinstance(value, Located) and value.fix.ambiguous:
        found += [("line", SKYLINE, "skyline of the terrain seen from position 1")]
        found += [("disc", POSITION, "position that fits the stars, its probability, circle 95 %")]
    if truth and value.terrain is not None:
        found += [("plus", TRUTH, "true position (not known to the method)")]
    return found


def draw_legend_sample(canvas: Canvas, x: float, y: float, kind: str, colour: Colour) -> None:
    """A mark of a legend on the `canvas` about (x, y), in a `colour`; `kind`: ring, cross, line, dot, plus or disc."""
    if kind == "ring":
        canvas.circle((x, y), 7.0, colour, 2)
    elif kind == "cross":
        canvas.cross((x, y), 5.5, colour, 2)
    elif kind == "line":
        canvas.line([(x - 11, y), (x + 11, y)], colour, 3)
    elif kind == "dot":
        canvas.circle((x, y), 2.0, colour, -1)
    elif kind == "plus":
        canvas.plus((x, y), 8.0, colour, 2)
    else:
        canvas.circle((x, y), 4.0, colour, -1)
        canvas.circle((x, y), 8.0, colour, 2)


def _shorten_text(text: str, size: float, width: float) -> str:
    """The text, or as much of its start and end as there is room for."""
    if text_width(text, size) <= width:
        return text
    kept = len(text)
    while kept > 4 and text_width(f"{text[: kept // 2]}…{text[-(kept // 2) :]}", size) > width:
        kept -= 1
    return f"{text[: kept // 2]}…{text[-(kept // 2) :]}"


def bare_picture(value: Inputs) -> NDArray[np.uint8]:
    """The exposure (H, W, 3) as the picture of a stage's `value` shows it, red, green, blue, without any mark."""
    _, size = fit_to_canvas(value.exposure.size_px)
    return backdrop(value, size, wall_mask(value, size))


def annotate(
    outcome: Outcome, truth_enu_m: tuple[float, float] | None = None, bare: NDArray[np.uint8] | None = None
) -> NDArray[np.uint8]:
    """The picture (H, W, 3) of an `outcome`, red, green, blue. Parts that were not reached are left out.

    `truth_enu_m` (east, north) [m] is drawn if it is given. `bare`: the `bare_picture`, where a caller has it.
    """
    value = last_value(outcome)
    scale, size = fit_to_canvas(value.exposure.size_px)
    height = max(size[1], PANEL_HEIGHT)
    canvas = Canvas(size[0] + PANEL_WIDTH, height)
    view = View(scale, (0.0, float((height - size[1]) // 2)), size)
    top = (height - size[1]) // 2
    canvas.pixels[top : top + size[1], : size[0]] = bare_picture(value) if bare is None else bare
    draw_detections(canvas, view, value)
    draw_hidden(canvas, view, value)
    draw_skyline(canvas, view, value)
    draw_measured_skyline(canvas, view, value)
    draw_compass(canvas, view, value)
    draw_bodies(canvas, view, value)
    name_stars(canvas, view, value)
    draw_panel(canvas, size[0], outcome, truth_enu_m)
    return canvas.rendered_pixels()
