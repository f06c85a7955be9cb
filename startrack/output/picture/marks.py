"""Marks on the picture: stars, bodies and detections with their names; wall, skyline, compass and the rover's nose."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from startrack.chain import Detected, Identified, Inputs, Located, Measured
from startrack.core.types import Array, Ints
from startrack.frames import azel_from_rays
from startrack.output.picture.backdrop import SAMPLE, View
from startrack.output.picture.canvas import (
    BODY,
    DETECTION,
    DIM_INK,
    FAINT_INK,
    HIDDEN,
    IDENTIFIED,
    INK,
    MEASURED,
    SKY_DARK,
    SKYLINE,
    TEXT_PX,
    Canvas,
    box_around,
    mix_colours,
)
from startrack.output.picture.overlay import (
    AZIMUTHS_RAD,
    COMPASS,
    LETTER_DEG,
    TICK_DEG,
    bodies_in_frame,
    compass_feet,
    heading_rad,
    horizon_at_fix,
    lowest_deg,
    measured_skyline_px,
    other_sources,
    project_azel,
    skyline_stretches_px,
)
from startrack.output.tables import names_of, status_of

MAX_CIRCLES = 4000
MAX_CROSSES = 150  # of hidden stars, the brightest: more would hide the picture
MAX_NAMES = 20
MAX_HIDDEN_NAMES = 8
NAME_SIZE = TEXT_PX + 2.0
FAINT_RING = 0.6  # how far the ring of the faintest detection fades into the sky
BRIGHTEST_SNR = 300.0


def draw_detections(canvas: Canvas, view: View, value: Inputs) -> None:
    """A green circle about each identified star; a grey one about each other detection inside the image circle."""
    if not isinstance(value, Detected):
        return
    found = value.detections
    identified = np.zeros(len(found), dtype=bool)
    if isinstance(value, Identified):
        identified[value.identification.detection] = True
    strength = np.clip(np.log(np.maximum(found.snr, 5.0) / 5.0) / np.log(BRIGHTEST_SNR / 5.0), 0, 1)
    places = view.canvas_px(found.xy_px)
    # The bright ones last, on top; the faint ones dim, so that a thousand of them do not drown the stars.
    shown = identified | other_sources(value)
    for k in reversed(range(min(len(found), MAX_CIRCLES))):
        if not shown[k]:
            continue
        colour = IDENTIFIED if identified[k] else DETECTION
        faint = FAINT_RING * (1.0 - float(strength[k]))
        canvas.circle(places[k], 4.5 + 5.5 * float(strength[k]), mix_colours(colour, SKY_DARK, faint))


def draw_hidden(canvas: Canvas, view: View, value: Inputs) -> None:
    """A cross at each of the brighter stars that the terrain hides."""
    _, xy_px = _hidden_stars(value)
    places = view.canvas_px(xy_px[:MAX_CROSSES])
    for rank, place in enumerate(places):
        weight = 1.0 - rank / max(len(places), 1)
        colour = mix_colours(HIDDEN, SKY_DARK, 0.35 * (1.0 - weight))
        canvas.cross(place, 3.5 + 3.0 * weight, colour, 2 if weight > 0.8 else 1)


def draw_bodies(canvas: Canvas, view: View, value: Inputs) -> None:
    """A ring and the name at each planet, moon or sun in the frame; stars beside it are not evidence."""
    for body in bodies_in_frame(value):
        colour = mix_colours(BODY, SKY_DARK, 0.4) if body.hidden else BODY
        at = view.canvas_px(body.xy_px)
        canvas.circle(at, 6.0 if body.hidden else 9.0, colour, 2)
        text, size = (f"{body.name} (hidden)", 0.85 * NAME_SIZE) if body.hidden else (body.name, NAME_SIZE)
        canvas.label(at, text, size, colour, 13.0, view.box)


def name_stars(canvas: Canvas, view: View, value: Inputs) -> None:
    """Names of the brightest identified stars and of the brightest hidden ones, where there is room."""
    if not isinstance(value, Identified):
        return
    order = np.argsort(value.stars.v_mag[value.identification.star], kind="stable")
    star = value.identification.star[order]
    xy_px = value.detections.xy_px[value.identification.detection[order]]
    seen = _names_at(value, star, xy_px, MAX_NAMES)
    hidden = _names_at(value, *_hidden_stars(value), MAX_HIDDEN_NAMES)
    for place, name in seen:
        canvas.label(view.canvas_px(place), name, NAME_SIZE, INK, 13.0, view.box)
    for place, name in hidden:
        canvas.label(view.canvas_px(place), name, 0.9 * NAME_SIZE, mix_colours(HIDDEN, SKY_DARK, 0.15), 11.0, view.box)


def _hidden_stars(value: Inputs) -> tuple[Ints, Array]:
    """Stars that are hidden, and their predicted pixels, brightest first."""
    if not isinstance(value, Measured):
        return np.empty(0, dtype=np.int64), np.empty((0, 2))
    hidden = status_of(value.light) == "hidden"
    return value.light.star[hidden], value.light.xy_px[hidden]


def _names_at(value: Identified, star: Ints, xy_px: Array, most: int) -> list[tuple[Array, str]]:
    first = names_of(value.stars.hip[star[: 4 * most]])
    return [(place, name) for place, name in zip(xy_px, first, strict=False) if name][:most]


EDGE_RAD = 0.003  # width of its edge
LETTER_SIZE = 30.0
SHORT_TICK_DEG = 1.2


def wall_mask(value: Inputs, size: tuple[int, int]) -> NDArray[np.float32] | None:
    """1 below the skyline of the fix and 0 above it, (H, W) of a picture of the size (W, H); None without a fix."""
    if not isinstance(value, Located):
        return None
    cells = [np.arange(0.5, -(-n // SAMPLE)) * n / -(-n // SAMPLE) for n in size]
    scale = np.array(value.camera.size_px) / size
    xy_px = np.stack(np.meshgrid(*cells), axis=-1) * scale - 0.5
    azimuth, elevation = azel_from_rays(value.camera.unproject(xy_px) @ value.R_cam_enu)
    below = np.interp(azimuth, AZIMUTHS_RAD, horizon_at_fix(value)) - elevation
    # The signed distance is what may be interpolated; cut off afterwards, it gives a sharp and smooth edge.
    below_rad = np.asarray(cv2.resize(below.astype(np.float32), size, interpolation=cv2.INTER_LINEAR))
    return np.clip(below_rad * np.float32(1 / EDGE_RAD) + np.float32(0.5), 0, 1)


def draw_skyline(canvas: Canvas, view: View, value: Inputs) -> None:
    """The skyline that the terrain shows from the fix."""
    for stretch in skyline_stretches_px(value):
        canvas.curve(view.canvas_px(stretch), SKYLINE, 2.5)


def draw_measured_skyline(canvas: Canvas, view: View, value: Inputs) -> None:
    """Dots where the light of the sky, and the stars with it, show the skyline."""
    for place in view.canvas_px(measured_skyline_px(value)):
        canvas.circle(tuple(place), 2.0, MEASURED, -1)


def draw_compass(canvas: Canvas, view: View, value: Inputs) -> None:
    """The letters of the compass, the rover's nose, and ticks each ten degrees: at the horizontal, or as low as the
    frame shows."""
    if not isinstance(value, Measured):
        return
    feet = compass_feet(value)
    for azimuth_deg in sorted(COMPASS.keys() & feet.keys()):
        at = _canvas_at(view, value, np.radians(azimuth_deg), feet[azimuth_deg] + LETTER_DEG)
        canvas.text(at, COMPASS[azimuth_deg], LETTER_SIZE, INK, "mm", halo=True)
    _draw_nose(canvas, view, value)
    for azimuth_deg, lowest in feet.items():
        main, letter = azimuth_deg % 30 == 0, azimuth_deg in COMPASS
        azimuth_rad = np.radians(azimuth_deg)
        reach_deg = TICK_DEG if main else SHORT_TICK_DEG
        ends = [_canvas_at(view, value, azimuth_rad, lowest + above) for above in (0.0, reach_deg)]
        canvas.line(np.array(ends), INK if letter else DIM_INK if main else FAINT_INK, 2 if main else 1)
        at = _canvas_at(view, value, azimuth_rad, lowest + LETTER_DEG)
        if main and not letter and canvas.is_free(box_around(at, 24.0)):
            canvas.text(at, str(azimuth_deg), 15.0, DIM_INK, "mm", halo=True)


def _draw_nose(canvas: Canvas, view: View, value: Measured) -> None:
    """An arrow head where the rover's nose points: at the edge of the picture, or further in where a letter stands."""
    heading = heading_rad(value)
    lowest = lowest_deg(value, heading)
    if lowest is None:
        return
    for further_in_deg in (0.5, 8.5, 16.5):
        tip = _canvas_at(view, value, heading, lowest + further_in_deg)
        along = tip - _canvas_at(view, value, heading, lowest + further_in_deg + 6.0)
        along /= np.linalg.norm(along)
        base, name = tip - 26.0 * along, tip - 48.0 * along
        if canvas.is_free(box_around(base, 20.0)) and canvas.is_free(box_around(name, 20.0)):
            break
    across = np.array([-along[1], along[0]])
    canvas.area([tip, base + 12.0 * across, base + 5.0 * along, base - 12.0 * across], INK)
    canvas.reserve(box_around(0.5 * (tip + base), 20.0))
    canvas.text(name, "forward", TEXT_PX, INK, "mm", halo=True)


def _canvas_at(view: View, value: Measured, azimuth_rad: float, elevation_deg: float) -> Array:
    """Canvas place (2,) of a direction."""
    return view.canvas_px(project_azel(value, np.array([azimuth_rad]), np.radians([elevation_deg]))[0][0])
