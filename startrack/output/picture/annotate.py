"""The annotated picture of a result: the exposure with what was found in it, and a panel with map and numbers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from startrack.output.picture.backdrop import View, backdrop, fitted
from startrack.output.picture.canvas import Canvas
from startrack.output.picture.horizon_marks import draw_compass, draw_skyline, wall_mask
from startrack.output.picture.panel import PANEL_HEIGHT, PANEL_WIDTH, draw_panel
from startrack.output.picture.star_marks import draw_bodies, draw_detections, draw_hidden, name_stars
from startrack.stages import Outcome, reached


def annotate(outcome: Outcome, truth_enu_m: tuple[float, float] | None = None) -> NDArray[np.uint8]:
    """The picture (H, W, 3), red, green, blue. Parts that were not reached are left out; `truth_enu_m` is optional."""
    value = reached(outcome)
    scale, size = fitted(value.exposure.size_px)
    height = max(size[1], PANEL_HEIGHT)
    canvas = Canvas(size[0] + PANEL_WIDTH, height)
    view = View(scale, (0.0, float((height - size[1]) // 2)), size)
    top = (height - size[1]) // 2
    canvas.pixels[top : top + size[1], : size[0]] = backdrop(value, size, wall_mask(value, size))
    draw_detections(canvas, view, value)
    draw_hidden(canvas, view, value)
    draw_skyline(canvas, view, value)
    draw_compass(canvas, view, value)
    draw_bodies(canvas, view, value)
    name_stars(canvas, view, value)
    draw_panel(canvas, size[0], outcome, truth_enu_m)
    return canvas.finished()
