"""The annotated picture of a result: the exposure with its marks, and a panel with maps and quantities.

Its file also holds the picture without marks and the marks as coordinates, for the HTML page.
"""

from __future__ import annotations

import json
import warnings
import zlib
from dataclasses import dataclass
from io import BytesIO
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from startrack.chain import Detected, Identified, Inputs, Located, Measured, Oriented, Outcome, last_value
from startrack.core.errors import BadInput
from startrack.core.stored import finite_json
from startrack.estimation.attitude import AttitudeFit
from startrack.exposure import insert_png_chunks, png_chunks
from startrack.output.picture.backdrop import View, bare_picture, fit_to_canvas
from startrack.output.picture.canvas import (
    GAP_PX,
    LARGE_PX,
    LINE_PX,
    QUALITY,
    TEXT_PX,
    TITLE_PX,
    Box,
    Canvas,
    Ink,
    Legend,
    encoded_bytes,
    mix_colours,
    multiples,
    nice_step,
    png_bytes,
    text_width,
    wrap_text,
)
from startrack.output.picture.maps import draw_overview, draw_zoom
from startrack.output.picture.marks import draw_marks, overlay_of
from startrack.output.record import image_name, stage_values
from startrack.output.text import Rows, rows
from startrack.output.values import mode_text

PANEL_WIDTH, PANEL_HEIGHT = round(38.75 * TEXT_PX), round(72.5 * TEXT_PX)
FACT_STEP_PX = 2 * TEXT_PX
STATUS = {"ok": Ink.GREEN, "ambiguous": Ink.ORANGE, "refused": Ink.VERMILLION}
OVERVIEW_PART = 0.58  # of the height left for maps
WIDEST_RMS = 4.5  # residuals beyond this many rms are outliers and would squeeze the rest
MAX_MODES = 4  # of positions that fit
MAX_LINES = 2 * MAX_MODES  # of a message
MAX_SIDE_PX, MAX_MARKS_BYTES = 4096, 2**24  # of a picture and its marks; ours are half as long, and 1 MB
BARE_CHUNK, MARKS_CHUNK = b"stPX", b"stOV"  # a JPEG; compressed JSON
EastNorth = tuple[float, float] | None  # east and north [m] of the true position, where a caller knows it


def annotate(outcome: Outcome, truth_enu_m: EastNorth = None) -> NDArray[np.uint8]:
    """The picture (H, W, 3) of an `outcome`, red, green, blue. Parts that were not reached are left out.

    `truth_enu_m` (east, north) [m] is drawn if it is given.
    """
    value = last_value(outcome)
    return _draw_picture(outcome, truth_enu_m, bare_picture(value), overlay_of(value))


def annotated_png(outcome: Outcome, truth_enu_m: EastNorth = None) -> bytes:
    """The picture of `annotate` as a PNG file with the layers of `layers_of`."""
    value = last_value(outcome)
    bare, overlay = bare_picture(value), overlay_of(value)
    png = png_bytes(_draw_picture(outcome, truth_enu_m, bare, overlay))
    jpeg = encoded_bytes(".jpg", bare[:, :, ::-1], cv2.IMWRITE_JPEG_QUALITY, QUALITY)
    text = json.dumps(overlay, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return insert_png_chunks(png, [(BARE_CHUNK, jpeg), (MARKS_CHUNK, zlib.compress(text.encode("utf-8")))])


@dataclass(frozen=True)
class Layers:
    """The exposure (H, W, 3), red, green, blue, and the marks of `overlay_of`."""

    bare: NDArray[np.uint8]
    overlay: dict[str, Any]


def layers_of(png: bytes) -> Layers | None:
    """The layers of a PNG file; None where it has none, or is damaged."""
    marks = zlib.decompressobj()
    try:
        found = {kind: body for kind, body in png_chunks(png) if kind in (BARE_CHUNK, MARKS_CHUNK)}
        overlay = finite_json(marks.decompress(found[MARKS_CHUNK], MAX_MARKS_BYTES)) if len(found) == 2 else None
    except (BadInput, zlib.error, ValueError, RecursionError):  # the page shows what there is
        return None
    if not isinstance(overlay, dict) or not _is_size(overlay.get("size")):
        return None
    bare = picture_in(bytes(found[BARE_CHUNK]))
    return None if bare is None else Layers(bare, overlay)


def _is_size(value: Any) -> bool:
    """Whether a value of JSON is a width and a height."""
    return isinstance(value, list) and len(value) == 2 and all(isinstance(n, int | float) and n > 0 for n in value)


def picture_in(data: bytes) -> NDArray[np.uint8] | None:
    """The picture (H, W, 3), red, green, blue, in the PNG or JPEG file `data`; None for any other, or a larger one.

    By Pillow: OpenCV prints what is damaged, and makes room for any length that a file states.
    """
    from PIL import Image

    try:
        with warnings.catch_warnings(action="error"), Image.open(BytesIO(data), formats=("PNG", "JPEG")) as image:
            return np.asarray(image.convert("RGB")) if max(image.size) <= MAX_SIDE_PX else None
    except (Image.DecompressionBombError, OSError, SyntaxError, ValueError, Warning):
        return None


def _draw_picture(
    outcome: Outcome, truth_enu_m: EastNorth, bare: NDArray[np.uint8], overlay: dict[str, Any]
) -> NDArray[np.uint8]:
    value = last_value(outcome)
    scale, size = fit_to_canvas(value.exposure.size_px)
    canvas = Canvas(size[0] + PANEL_WIDTH, max(size[1], PANEL_HEIGHT))
    top = (canvas.size[1] - size[1]) // 2
    canvas.pixels[top : top + size[1], : size[0]] = bare
    draw_marks(canvas, View(scale, (0.0, float(top)), size), value, overlay)
    _draw_panel(canvas, size[0], outcome, truth_enu_m, overlay["undrawn"])
    return canvas.rendered_pixels()


def _draw_panel(canvas: Canvas, left: float, outcome: Outcome, truth_enu_m: EastNorth, undrawn: int) -> None:
    """Fill the canvas from `left` to its right edge, top to bottom; `undrawn` point sources have no ring."""
    width, height = canvas.size
    canvas.rectangle((left, 0, width - 1, height - 1), Ink.PANEL)
    left, right = left + TITLE_PX, width - TITLE_PX
    value = last_value(outcome)
    facts, legend = _facts(value), _legend(value, truth_enu_m is not None, undrawn)
    legend_top = height - TITLE_PX - LINE_PX * len(legend)
    top = _draw_header(canvas, left, right, outcome)
    y = _draw_figures(canvas, (left, top, right, legend_top - FACT_STEP_PX * (len(facts) + 2)), value, truth_enu_m)
    for name, fact in facts:
        y += FACT_STEP_PX
        canvas.text((left, y), name, size=LARGE_PX)
        canvas.text((left + 7.5 * LARGE_PX, y), fact, Ink.PLAIN, size=LARGE_PX)
    if legend:
        canvas.line([(left, legend_top - TEXT_PX), (right, legend_top - TEXT_PX)], Ink.FAINT)
    canvas.legend(left, legend_top + TEXT_PX, right - left, legend)


def _draw_header(canvas: Canvas, left: float, right: float, outcome: Outcome) -> float:
    """Name of the image, status, and the message of a result that is not ok; returns where the next thing may stand."""
    status, colour, top = outcome.status.upper(), STATUS[outcome.status], TITLE_PX
    badge, base = text_width(status, LARGE_PX) + TITLE_PX, top + TITLE_PX
    canvas.rectangle((right - badge, top, right, top + 1.5 * TITLE_PX), colour)
    canvas.text((right - badge / 2, top + 0.75 * TITLE_PX), status, (255, 255, 255), "mm", LARGE_PX)
    name = _shorten_text(image_name(outcome.exposure), TITLE_PX, right - left - badge - TEXT_PX)
    canvas.text((left, base), name, Ink.PLAIN, size=TITLE_PX)
    value = last_value(outcome)
    parts = [f"camera {value.camera.name}"] if value.camera is not None else []
    parts += [f"terrain {value.terrain.name}"] if value.terrain is not None else []
    parts += [f"{value.exposure.exposure_s:.3g} s exposure"] if value.exposure.exposure_s is not None else []
    y = base + 1.25 * TITLE_PX
    canvas.text((left, y), _shorten_text("   ".join(parts), TEXT_PX, right - left))
    if outcome.status == "ok":
        return y + TEXT_PX
    y += 2.5 * TEXT_PX
    canvas.text((left, y), (outcome.reason or "").replace("_", " "), colour, size=LARGE_PX)
    lines = wrap_text(outcome.message, LARGE_PX, right - left)[:MAX_LINES]
    return canvas.paragraph(left, y + FACT_STEP_PX, " ".join(lines), right - left, Ink.PLAIN, LARGE_PX)


def _draw_figures(canvas: Canvas, room: Box, value: Inputs, truth: EastNorth) -> float:
    """Maps where there is a terrain, else residuals; returns where the next thing may stand."""
    left, top, right, bottom = room
    zoomed = _has_circle(value)
    bottom = bottom if zoomed else min(bottom, top + right - left)
    if bottom - top < PANEL_WIDTH / 5:
        return top
    if value.terrain is None:
        if not isinstance(value, Oriented):
            return top
        _draw_residuals(canvas, (left, top, right, bottom), value.attitude_fit)
        return bottom + TEXT_PX
    split = top + (OVERVIEW_PART if zoomed else 1.0) * (bottom - top)
    fix = value.fix if isinstance(value, Located) else None
    overview = draw_overview(canvas, (left, top, right, split), value.terrain, fix, truth)
    if fix is not None and zoomed:
        zoom = draw_zoom(canvas, (left, split + TEXT_PX, right, bottom), fix, truth)
        position = overview.canvas_px(zoom.centre_m)
        for corner in (zoom.box[:2], (zoom.box[2], zoom.box[1])):  # from the position to its enlarged map
            toward = np.asarray(corner) - position
            start = position + TEXT_PX * toward / np.linalg.norm(toward)
            canvas.line(np.stack([start, corner]), Ink.FAINT)
    return bottom + TEXT_PX


def _draw_residuals(canvas: Canvas, box: Box, fit: AttitudeFit) -> None:
    """Measured minus predicted pixels of the stars that the attitude rests on, with rings to read them by."""
    left, top, right, bottom = box
    window, middle = canvas.window(box), np.array([(left + right) / 2, (top + bottom) / 2])
    window.rectangle(box, Ink.PAPER)
    reach_px = WIDEST_RMS * max(fit.rms_px, 1e-3)
    scale = 0.5 * min(right - left, bottom - top) / reach_px
    step = nice_step(reach_px / 2)
    for radius in multiples(step, 2 * reach_px, step):
        window.circle(middle, radius * scale, Ink.GRID)
    window.mark(middle, "plus", max(right - left, bottom - top), Ink.GRID, 1)
    for position in middle + scale * fit.residual_px[fit.used]:
        window.circle(position, 2.0, mix_colours(Ink.IDENTIFIED, Ink.PLAIN, 0.15), -1)
    canvas.rectangle(box, Ink.FAINT, 1)
    canvas.text((left + GAP_PX, top + GAP_PX), "measured minus predicted", anchor="lt", halo=True)
    canvas.text(middle + step * scale * np.array([2**0.5, -(2**0.5)]), f"{2 * step:g} px", Ink.PLAIN, "mm", halo=True)


def _has_circle(value: Inputs) -> bool:
    """Whether the `value` has a position with a circle that can be drawn."""
    return isinstance(value, Located) and not value.fix.ambiguous and bool(np.isfinite(value.fix.radius95_m))


def _facts(value: Inputs) -> Rows:
    """Names and texts of the quantities that the panel shows."""
    when, at = value.exposure.time_utc, stage_values(value)
    found = [("Time", f"{when:%Y-%m-%d  %H:%M:%S} UTC" if when is not None else "not known")]
    modes = (at("modes.text") or [])[:MAX_MODES]
    return [*found, *((f"Position {k}", mode_text(mode)) for k, mode in enumerate(modes, 1)), *rows("panel", at)]


def _legend(value: Inputs, truth: bool, undrawn: int) -> Legend:
    found: Legend = []
    if isinstance(value, Identified):
        found += [("ring", Ink.IDENTIFIED, "star of the catalogue, identified")]
    if isinstance(value, Detected):
        other = "other point source" if isinstance(value, Identified) else "point source"
        further = f"; {undrawn:,} further point sources not drawn" if undrawn else ""
        found += [("ring", Ink.DETECTION, f"{other}{further}")]
    if isinstance(value, Measured):
        found += [("cross", Ink.HIDDEN, "star that should be here, and is hidden")]
    if isinstance(value, Oriented) and value.bodies:
        found += [("ring", Ink.BODY, "planet, Sun, Earth or Moon, where it must be; dim: hidden")]
    if isinstance(value, Located) and not value.fix.ambiguous:
        found += [("line", Ink.SKYLINE, "skyline of the terrain seen from the position found")]
        if value.sky_at_skyline is not None:
            found += [("disc", Ink.MEASURED, "skyline where the light of the sky stops")]
        around = "; circle 95 %, ellipse one sigma" if _has_circle(value) else ""
        found += [("place", Ink.POSITION, f"position{around}")]
    if isinstance(value, Located) and value.fix.ambiguous:
        found += [("line", Ink.SKYLINE, "skyline of the terrain seen from position 1")]
        found += [("place", Ink.POSITION, "position that fits the stars, its probability, circle 95 %")]
    if truth and value.terrain is not None:
        found += [("plus", Ink.TRUTH, "true position (not known to the method)")]
    return found


def _shorten_text(text: str, size: float, width: float) -> str:
    """The text, or as much of its start and end as there is room for."""
    kept, short = len(text), text
    while kept > 4 and text_width(short, size) > width:
        kept -= 1
        short = f"{text[: kept // 2]}…{text[-(kept // 2) :]}"
    return short
