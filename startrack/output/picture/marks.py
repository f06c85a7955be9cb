"""Marks on the picture of an exposure: stars, bodies and detections with their names, skyline, compass, the nose.

`overlay_of` has those that no table of a result holds, in pixels of the exposure, for the HTML page also.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from startrack.chain import Detected, Identified, Inputs, Located, Measured, Oriented
from startrack.core.types import Array, Bools, Ints
from startrack.frames import azel_from_rays, heading_pitch_roll_from_R_body_enu, rays_from_azel
from startrack.output.picture.axes import known_runs
from startrack.output.picture.backdrop import AZIMUTHS_RAD, KNEE_SNR, View, horizon_at_fix
from startrack.output.picture.canvas import LARGE_PX, TEXT_PX, TITLE_PX, Canvas, Ink, box_around, mix_colours
from startrack.output.tables import names_of, status_of
from startrack.output.values import R_body_enu

DIMMEST_HIDDEN_V_MAG = 3.0  # a fainter planet behind the wall is not missed
COMPASS_DEG = np.arange(0.0, 60.0, 0.5)  # elevations from the horizontal up at which a tick of the compass may stand
COMPASS = {0: "N", 90: "E", 180: "S", 270: "W"}
TICK_RAD = np.radians([0.0, 2.2, 5.0])  # foot and top of a tick of the compass and the middle of its letter
MAX_CROSSES = 150  # of hidden stars, the brightest: more would hide the picture
MAX_NAMES = 20  # of stars, and half as many of hidden ones
FAINTEST_SNR = KNEE_SNR  # with the smallest mark
BRIGHTEST_SNR = 300.0  # with the largest one


def overlay_of(value: Inputs) -> dict[str, Any]:
    """Marks of a stage's `value` for JSON: those that no table of the result holds. Pixels of the exposure.

    `size` of the exposure; `others`, point sources that are no named star; `skyline`, its stretches in the frame;
    `measured`, where the light of the sky shows it; `bodies`; `compass`, [azimuth_deg, foot, top, letter] of each tick;
    `nose`, [foot, top, letter] of the rover's nose, or None.
    """
    found: dict[str, Any] = {
        "size": list(value.exposure.size_px), "others": [], "skyline": [], "measured": [], "bodies": [], "compass": [],
        "nose": None,
    }  # fmt: skip
    if isinstance(value, Detected):
        found["others"] = _pairs(value.detections.xy_px[_other_sources(value)])
    if isinstance(value, Oriented):
        found["bodies"] = _bodies(value)
    if isinstance(value, Measured):
        ticks = ((deg, _tick_px(value, np.radians(deg))) for deg in range(0, 360, 10))
        found["compass"] = [[deg, *tick] for deg, tick in ticks if tick is not None]
        found["nose"] = _tick_px(value, heading_pitch_roll_from_R_body_enu(R_body_enu(value))[0])
    if isinstance(value, Located):
        xy_px, imaged = _project_azel(value, AZIMUTHS_RAD, horizon_at_fix(value, AZIMUTHS_RAD))
        found["skyline"] = [_pairs(xy_px[run]) for run in known_runs(imaged)]
        if value.sky is not None and value.skyline is not None:
            by_sky = value.skyline.known & (value.skyline.source != "stars")
            angles_rad = value.skyline.azimuth_rad[by_sky], value.skyline.elevation_rad[by_sky]
            xy_px, imaged = _project_azel(value, *angles_rad)
            found["measured"] = _pairs(xy_px[imaged])
    return found


def _other_sources(value: Detected) -> Bools:
    """Which detections (n,) are no identified star, and lie where light of the lens can reach."""
    xy_px, camera = value.detections.xy_px, value.camera
    others = np.ones(len(xy_px), dtype=bool)
    if camera is not None and camera.size_px == value.exposure.size_px:
        others = camera.angle_rad(xy_px) <= camera.max_angle_rad
    if isinstance(value, Identified):
        others[value.identification.detection] = False
    return others


def _bodies(value: Oriented) -> list[list[Any]]:
    """Name, x, y and whether the terrain hides it, of planets, Moon, Earth and Sun in the frame; of hidden ones only
    the bright.
    """
    found = []
    for body in value.bodies:
        xy_px, inside = value.camera.project(body.ray_icrs @ value.attitude.R_cam_icrs.T)
        hidden = False
        if isinstance(value, Located):
            azimuth, elevation = azel_from_rays(value.R_enu_icrs @ body.ray_icrs)
            hidden = bool(elevation < horizon_at_fix(value, np.array([azimuth]))[0])
        if inside and not (hidden and body.v_mag > DIMMEST_HIDDEN_V_MAG):
            found.append([body.name, *_pairs(xy_px), hidden])
    return found


def _tick_px(value: Measured, azimuth_rad: float) -> list[Any] | None:
    """Foot and top of a tick of the compass, and the middle of its letter: as low as the frame shows the azimuth."""
    rays_cam = rays_from_azel(azimuth_rad, np.radians(COMPASS_DEG)) @ value.R_cam_enu.T
    _, inside = value.camera.project(rays_cam)
    if not inside.any():
        return None
    elevation_rad = np.radians(COMPASS_DEG[np.argmax(inside)]) + TICK_RAD
    return _pairs(_project_azel(value, np.full(3, azimuth_rad), elevation_rad)[0])


def _project_azel(value: Measured, azimuth_rad: Array, elevation_rad: Array) -> tuple[Array, Bools]:
    """Pixels (n, 2), and which directions (n,) the lens images, within the frame or not."""
    rays_cam = rays_from_azel(azimuth_rad, elevation_rad) @ value.R_cam_enu.T
    xy_px, _ = value.camera.project(rays_cam)
    angle = np.arctan2(np.hypot(rays_cam[:, 0], rays_cam[:, 1]), rays_cam[:, 2])
    return xy_px, angle <= min(value.camera.max_angle_rad, value.camera.lens.max_invertible_rad)


def _pairs(xy_px: Array) -> list[Any]:
    return np.round(xy_px, 1).tolist()


def draw_marks(canvas: Canvas, view: View, value: Inputs, overlay: dict[str, Any]) -> None:
    """Everything on the picture of a stage's `value` in the `view` of the `canvas`; `overlay` is that of the value."""
    hidden, hidden_px = _hidden_stars(value)
    if isinstance(value, Detected):
        _draw_detections(canvas, view, value)
    places = view.canvas_px(hidden_px[:MAX_CROSSES])
    for weight, place in zip(np.linspace(1.0, 0.0, len(places)), places, strict=True):
        colour = mix_colours(Ink.HIDDEN, Ink.SKY_DARK, 0.35 * (1.0 - weight))
        canvas.mark(place, "cross", 3.5 + 3.0 * weight, colour, 2 if weight > 0.8 else 1)
    for stretch in overlay["skyline"]:
        canvas.curve(view.canvas_px(stretch), Ink.SKYLINE, 2.5)
    for place in overlay["measured"]:
        canvas.mark(view.canvas_px(place), "disc", 2.0, Ink.MEASURED)
    _draw_compass(canvas, view, overlay)
    for name, x, y, behind in overlay["bodies"]:
        colour = mix_colours(Ink.BODY, Ink.SKY_DARK, 0.4) if behind else Ink.BODY
        canvas.mark(view.canvas_px((x, y)), "ring", 6.0 if behind else 9.0, colour)
        words = f"{name} (hidden)" if behind else name
        canvas.label(view.canvas_px((x, y)), words, colour, TEXT_PX, view.box)
    if isinstance(value, Identified):
        order = np.argsort(value.stars.v_mag[value.identification.star], kind="stable")
        star = value.identification.star[order]
        xy_px = value.detections.xy_px[value.identification.detection[order]]
        faded = mix_colours(Ink.HIDDEN, Ink.SKY_DARK, 0.15)
        for stars, px, most, colour, size in (
            (star, xy_px, MAX_NAMES, Ink.PLAIN, LARGE_PX), (hidden, hidden_px, MAX_NAMES // 2, faded, TEXT_PX)
        ):  # fmt: skip
            first = names_of(value.stars.hip[stars[: 4 * most]])
            for place, name in [pair for pair in zip(px, first, strict=False) if pair[1]][:most]:
                canvas.label(view.canvas_px(place), name, colour, 0.75 * LARGE_PX, view.box, size)


def _draw_detections(canvas: Canvas, view: View, value: Detected) -> None:
    """A green circle about each identified star; a grey one about each other detection inside the image circle."""
    found = value.detections
    identified = np.zeros(len(found), dtype=bool)
    if isinstance(value, Identified):
        identified[value.identification.detection] = True
    shown = np.flatnonzero(identified | _other_sources(value))
    strength = np.log(np.maximum(found.snr, FAINTEST_SNR) / FAINTEST_SNR) / np.log(BRIGHTEST_SNR / FAINTEST_SNR)
    places = view.canvas_px(found.xy_px).tolist()
    # The bright ones last, on top; the faint ones dim, so that a thousand of them do not drown the stars.
    for k in shown[::-1]:
        bright = min(float(strength[k]), 1.0)
        colour = Ink.IDENTIFIED if identified[k] else Ink.DETECTION
        colour = mix_colours(colour, Ink.SKY_DARK, 0.6 * (1.0 - bright))
        canvas.circle(places[k], 4.5 + 5.5 * bright, colour)


def _hidden_stars(value: Inputs) -> tuple[Ints, Array]:
    """Stars that are hidden, and their predicted pixels, brightest first."""
    if not isinstance(value, Measured):
        return np.empty(0, dtype=np.int64), np.empty((0, 2))
    hidden = status_of(value.light) == "hidden"
    return value.light.star[hidden], value.light.xy_px[hidden]


def _draw_compass(canvas: Canvas, view: View, overlay: dict[str, Any]) -> None:
    """The letters of the compass, the rover's nose, and ticks each ten degrees: at the horizontal, or as low as the
    frame shows.
    """
    ticks = [(azimuth_deg, view.canvas_px(tick)) for azimuth_deg, *tick in overlay["compass"]]
    for azimuth_deg, (_, _, letter) in ticks:
        if azimuth_deg in COMPASS:
            canvas.text(letter, COMPASS[azimuth_deg], Ink.PLAIN, "mm", 2 * TEXT_PX, halo=True)
    if overlay["nose"] is not None:
        _draw_nose(canvas, *view.canvas_px(overlay["nose"]))
    for azimuth_deg, (foot, top, letter) in ticks:
        main, named = azimuth_deg % 30 == 0, azimuth_deg in COMPASS
        colour = Ink.PLAIN if named else Ink.DIM if main else Ink.FAINT
        canvas.line([foot, top if main else 0.5 * (foot + top)], colour, 2 if main else 1)
        if main and not named and canvas.is_free(box_around(letter, TITLE_PX)):
            canvas.text(letter, str(azimuth_deg), anchor="mm", halo=True)


def _draw_nose(canvas: Canvas, foot: Array, top: Array, letter: Array) -> None:
    """An arrow head where the rover's nose points: at the edge of the picture, or further in where a letter stands."""
    along = (foot - top) / np.linalg.norm(foot - top)
    for inwards in (0.0, 1.5, 3.0):
        tip = foot + inwards * (letter - foot)
        base, name = tip - 1.5 * TEXT_PX * along, tip - 3.0 * TEXT_PX * along
        if canvas.is_free(box_around(base, LARGE_PX)) and canvas.is_free(box_around(name, LARGE_PX)):
            break
    across = 0.75 * TEXT_PX * np.array([-along[1], along[0]])
    canvas.area([tip, base + across, base + 0.3 * TEXT_PX * along, base - across], Ink.PLAIN)
    canvas.reserve(box_around(0.5 * (tip + base), LARGE_PX))
    canvas.text(name, "forward", Ink.PLAIN, "mm", halo=True)
