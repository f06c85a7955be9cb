"""Stars, bodies and detections on the picture, and their names."""

from __future__ import annotations

import numpy as np

from startrack.frames import azel_from_rays
from startrack.output.picture.backdrop import View
from startrack.output.picture.canvas import Canvas
from startrack.output.picture.palette import BODY, DETECTION, HIDDEN, IDENTIFIED, INK, mixed
from startrack.output.star_table import names_of, status_of
from startrack.output.values import place_m
from startrack.stages import Detected, Identified, Inputs, Located, Measured, Oriented
from startrack.types import Array, Bools, Ints

MOST_CIRCLES = 4000
MOST_CROSSES = 150  # of hidden stars, the brightest: more would hide the picture
MOST_NAMES = 20
MOST_HIDDEN_NAMES = 8
NAME_SIZE = 19.0
FAINT_RING = 0.6  # how far the ring of the faintest detection fades into the sky
DIMMEST_HIDDEN_V_MAG = 3.0  # a fainter planet behind the wall is not missed
BACKDROP = (12, 17, 28)
BRIGHT_SNR = 300.0


def draw_detections(canvas: Canvas, view: View, value: Inputs) -> None:
    """A green circle about each identified star; a grey one about each other detection inside the image circle."""
    if not isinstance(value, Detected):
        return
    found = value.detections
    identified = np.zeros(len(found), dtype=bool)
    if isinstance(value, Identified):
        identified[value.identification.detection] = True
    strength = np.clip(np.log(np.maximum(found.snr, 5.0) / 5.0) / np.log(BRIGHT_SNR / 5.0), 0, 1)
    places = view.at(found.xy_px)
    # The bright ones last, on top; the faint ones dim, so that a thousand of them do not drown the stars.
    shown = identified | _imaged(value, found.xy_px)
    for k in reversed(range(min(len(found), MOST_CIRCLES))):
        if not shown[k]:
            continue
        colour = IDENTIFIED if identified[k] else DETECTION
        faint = FAINT_RING * (1.0 - float(strength[k]))
        canvas.circle(places[k], 4.5 + 5.5 * float(strength[k]), mixed(colour, BACKDROP, faint))


def _imaged(value: Inputs, xy_px: Array) -> Bools:
    """Whether light of the lens can reach the pixels (n, 2); all, where the camera is not known."""
    if value.camera is None or value.camera.size_px != value.exposure.size_px:
        return np.ones(len(xy_px), dtype=bool)
    return value.camera.angle_rad(xy_px) <= value.camera.max_angle_rad


def draw_hidden(canvas: Canvas, view: View, value: Inputs) -> None:
    """A cross at each of the brighter stars that ought to shine there and do not."""
    _, xy_px = _hidden(value)
    places = view.at(xy_px[:MOST_CROSSES])
    for rank, place in enumerate(places):
        weight = 1.0 - rank / max(len(places), 1)
        colour = mixed(HIDDEN, BACKDROP, 0.35 * (1.0 - weight))
        canvas.cross(place, 3.5 + 3.0 * weight, colour, 2 if weight > 0.8 else 1)


def draw_bodies(canvas: Canvas, view: View, value: Inputs) -> None:
    """A ring and the name at each planet, moon or sun in the frame; stars beside it are not evidence."""
    if not isinstance(value, Oriented):
        return
    for body in value.bodies:
        xy_px, inside = value.camera.project(body.ray_icrs @ value.attitude.R_cam_icrs.T)
        if not inside:
            continue
        below = _below_skyline(value, body.ray_icrs)
        if below and body.v_mag > DIMMEST_HIDDEN_V_MAG:
            continue
        colour = mixed(BODY, BACKDROP, 0.4) if below else BODY
        at = view.at(xy_px)
        canvas.circle(at, 6.0 if below else 9.0, colour, 2)
        text, size = (f"{body.name} (hidden)", 0.85 * NAME_SIZE) if below else (body.name, NAME_SIZE)
        canvas.label(at, text, size, colour, 13.0, view.box)


def name_stars(canvas: Canvas, view: View, value: Inputs) -> None:
    """Names of the brightest identified stars and of the brightest hidden ones, where there is room."""
    if not isinstance(value, Identified):
        return
    order = np.argsort(value.stars.v_mag[value.identification.star], kind="stable")
    star = value.identification.star[order]
    xy_px = value.detections.xy_px[value.identification.detection[order]]
    seen = _named(value, star, xy_px, MOST_NAMES)
    hidden = _named(value, *_hidden(value), MOST_HIDDEN_NAMES)
    for place, name in seen:
        canvas.label(view.at(place), name, NAME_SIZE, INK, 13.0, view.box)
    for place, name in hidden:
        canvas.label(view.at(place), name, 0.9 * NAME_SIZE, mixed(HIDDEN, BACKDROP, 0.15), 11.0, view.box)


def _hidden(value: Inputs) -> tuple[Ints, Array]:
    """Stars that are hidden, and their predicted pixels, brightest first."""
    if not isinstance(value, Measured):
        return np.empty(0, dtype=np.int64), np.empty((0, 2))
    hidden = status_of(value.light) == "hidden"
    return value.light.star[hidden], value.light.xy_px[hidden]


def _named(value: Identified, star: Ints, xy_px: Array, most: int) -> list[tuple[Array, str]]:
    first = names_of(value.stars.hip[star[: 4 * most]])
    return [(place, name) for place, name in zip(xy_px, first, strict=False) if name][:most]


def _below_skyline(value: Inputs, ray_icrs: Array) -> bool:
    if not isinstance(value, Located):
        return False
    azimuth, elevation = azel_from_rays(value.R_enu_icrs @ ray_icrs)
    horizon = value.terrain.horizon_rad(np.array([place_m(value.fix)]), np.array([azimuth]))
    return bool(elevation < horizon[0])
