"""How far the identified stars lie from where the catalogue, the lens and the attitude put them."""

from __future__ import annotations

import numpy as np

from startrack.orient import AttitudeFit
from startrack.output.picture.canvas import Box, Canvas
from startrack.output.picture.minimap import CAPTION_SIZE, nice_step
from startrack.output.picture.palette import DIM_INK, FAINT_INK, GRID, IDENTIFIED, INK, MAP, mixed

WIDEST_RMS = 4.5  # residuals beyond this many rms are outliers and would squeeze the rest


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
    for place in middle + scale * residual_px:
        window.circle(place, 2.0, mixed(IDENTIFIED, INK, 0.15), -1)
    canvas.rectangle(box, FAINT_INK, 1)
    canvas.text((left + 12, top + 12), "measured minus predicted", CAPTION_SIZE, DIM_INK, "lt", halo=True)
    canvas.text(
        middle + 2 * step * scale * np.array([0.707, -0.707]), f"{2 * step:g} px", CAPTION_SIZE, INK, "mm", halo=True
    )
