"""Marks on the picture of an exposure: stars, bodies and detections with their names, skyline, compass, the nose.

`overlay_of` has those that no table of a result holds, in pixels of the exposure, for the HTML page also.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from startrack.chain import Detected, Identified, Inputs, Located, Measured, Oriented
from startrack.core.types import Array, Bools, Ints
from startrack.estimation.match import SIGNIFICANT_SNR
from startrack.frames import azel_from_rays, heading_pitch_roll_from_R_body_enu, rays_from_azel
from startrack.output.picture.backdrop import AZIMUTHS_RAD, KNEE_SNR, View
from startrack.output.picture.canvas import (
    LARGE_PX,
    TEXT_PX,
    TITLE_PX,
    Canvas,
    Ink,
    box_around,
    known_runs,
    mix_colours,
)
from startrack.output.tables import names_of, status_of
from startrack.output.values import R_body_enu, horizon_at_fix

DIMMEST_HIDDEN_V_MAG = 3.0  # a fainter planet behind the wall is not missed
COMPASS_DEG = np.arange(0.0, 60.0, 0.5)  # elevations from the horizontal up at which a tick of the compass may stand
COMPASS = {0: "N", 90: "E", 180: "S", 270: "W"}
TICK_RAD = np.radians([0.0, 2.2, 5.0])  # foot and top of a tick of the compass and the middle of its letter
MAX_CROSSES = 150  # of hidden stars, the brightest: more would hide the picture
MAX_OTHERS = 300  # of rings about sources without a name, the most significant
MAX_NAMES = 20  # of stars, and half as many of hidden ones
KEPT_CLEAR = 3 * MAX_NAMES  # of the marks of seen and of hidden stars, the brightest: no name lies on them
MARK_PX = 8.0  # half the side of the box about a mark that is kept clear
LETTER_PARTS = (1.0, 1.5, 2.0, 2.5)  # of the way from a tick's foot to the usual place of its letter
FAINTEST_SNR = KNEE_SNR  # with the smallest mark
BRIGHTEST_SNR = 300.0  # with the largest one


def overlay_of(value: Inputs) -> dict[str, Any]:
    """Marks of a stage's `value` for JSON: those that no table of the result holds. Pixels of the exposure.

    `size` of the exposure; `others`, point sources that are no named star, and `undrawn`, how many more there are;
    `skyline`, its stretches in the frame;
    `measured`, where the light of the sky shows it; `bodies`; `compass`, [azimuth_deg, foot, top, letter] of each tick;
    `nose`, [foot, top, letter] of the rover's nose, or None.
    """
    found: dict[str, Any] = {
        "size": list(value.exposure.size_px), "others": [], "undrawn": 0, "skyline": [], "measured": [], "bodies": [],
        "compass": [], "nose": None,
    }  # fmt: skip
    if isinstance(value, Detected):
        others, drawn = _other_sources(value)
        found["others"], found["undrawn"] = _pairs(value.detections.xy_px[drawn]), len(others) - len(drawn)
    if isinstance(value, Oriented):
        found["bodies"] = _bodies(value)
    if isinstance(value, Measured):
        ticks = ((deg, _tick_px(value, np.radians(deg))) for deg in range(0, 360, 10))
        found["compass"] = [[deg, *tick] for deg, tick in ticks if tick is not None]
        found["nose"] = _tick_px(value, heading_pitch_roll_from_R_body_enu(R_body_enu(value))[0])
    if isinstance(value, Located):
        xy_px, imaged = _project_azel(value, AZIMUTHS_RAD, horizon_at_fix(value, AZIMUTHS_RAD))
        found["skyline"] = [_pairs(xy_px[run]) for run in known_runs(imaged)]
        if value.sky_at_skyline is not None and value.skyline is not None:
            by_sky = value.skyline.known & (value.skyline.source != "stars")
            angles_rad = value.skyline.azimuth_rad[by_sky], value.skyline.elevation_rad[by_sky]
            xy_px, imaged = _project_azel(value, *angles_rad)
            found["measured"] = _pairs(xy_px[imaged])
    return found


def _other_sources(value: Detected) -> tuple[Ints, Ints]:
    """Detections that are no named star or body and lie where light of the lens can reach, and those that are drawn.

    The most significant are drawn, the first of them first; beside identified stars only those that should be a star.
    """
    sources, camera = value.detections, value.camera
    others = value.names.is_nameless.copy() if isinstance(value, Identified) else np.ones(len(sources), dtype=bool)
    if camera is not None and camera.size_px == value.exposure.size_px:
        others &= camera.angle_rad(sources.xy_px) <= camera.max_angle_rad
    found = np.flatnonzero(others)
    drawn = found[np.argsort(-sources.snr[found], kind="stable")[:MAX_OTHERS]]
    return found, drawn[sources.snr[drawn] > SIGNIFICANT_SNR] if isinstance(value, Identified) else drawn


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
    seen, seen_px = _seen_stars(value)
    for xy_px in (seen_px[:KEPT_CLEAR], hidden_px[:KEPT_CLEAR], [body[1:3] for body in overlay["bodies"]]):
        for place in xy_px:
            canvas.reserve(box_around(view.canvas_px(place), MARK_PX))
    _draw_compass(canvas, view, overlay)
    for name, x, y, behind in overlay["bodies"]:
        colour = mix_colours(Ink.BODY, Ink.SKY_DARK, 0.4) if behind else Ink.BODY
        canvas.mark(view.canvas_px((x, y)), "ring", 6.0 if behind else 9.0, colour)
        any(
            canvas.label(view.canvas_px((x, y)), name, colour, gap, view.box) for gap in (0.75 * LARGE_PX, 2 * LARGE_PX)
        )
    faded = mix_colours(Ink.HIDDEN, Ink.SKY_DARK, 0.15)
    for stars, px, most, colour, size in (
        (seen, seen_px, MAX_NAMES, Ink.PLAIN, LARGE_PX), (hidden, hidden_px, MAX_NAMES // 2, faded, TEXT_PX)
    ):  # fmt: skip
        if isinstance(value, Identified):
            first = names_of(value.stars.hip[stars[: 4 * most]])
            for place, name in [pair for pair in zip(px, first, strict=False) if pair[1]][:most]:
                canvas.label(view.canvas_px(place), name, colour, 0.75 * LARGE_PX, view.box, size)


def _draw_detections(canvas: Canvas, view: View, value: Detected) -> None:
    """A green circle about each named star; a grey one about each other detection that is drawn."""
    sources, (_, others) = value.detections, _other_sources(value)
    xy_px, snr, colours = sources.xy_px[others], sources.snr[others], [Ink.DETECTION] * len(others)
    if isinstance(value, Identified):
        named, known = value.names.stars, value.identification
        star_snr = np.full(
            len(named), BRIGHTEST_SNR
        )  # of those that the identification has not, which are the brightest
        _, row, match = np.intersect1d(named.star, known.star, return_indices=True)
        star_snr[row] = sources.snr[known.detection[match]]
        xy_px, snr = np.concatenate([xy_px, named.xy_px]), np.concatenate([snr, star_snr])
        colours += [Ink.IDENTIFIED] * len(named)
    strength = np.log(np.maximum(snr, FAINTEST_SNR) / FAINTEST_SNR) / np.log(BRIGHTEST_SNR / FAINTEST_SNR)
    places = view.canvas_px(xy_px).tolist()
    # The bright ones last, on top; the faint ones dim, so that a thousand of them do not drown the stars.
    for k in np.argsort(snr, kind="stable").tolist():
        bright = min(float(strength[k]), 1.0)
        canvas.circle(places[k], 4.5 + 5.5 * bright, mix_colours(colours[k], Ink.SKY_DARK, 0.6 * (1.0 - bright)))


def _seen_stars(value: Inputs) -> tuple[Ints, Array]:
    """The named stars and their measured pixels, brightest first."""
    if not isinstance(value, Identified):
        return np.empty(0, dtype=np.int64), np.empty((0, 2))
    named = value.names.stars
    order = np.argsort(value.stars.v_mag[named.star], kind="stable")
    return named.star[order], named.xy_px[order]


def _hidden_stars(value: Inputs) -> tuple[Ints, Array]:
    """Stars that are hidden, and their predicted pixels, brightest first."""
    if not isinstance(value, Measured):
        return np.empty(0, dtype=np.int64), np.empty((0, 2))
    hidden = status_of(value.photometry) == "hidden"
    return value.photometry.star[hidden], value.photometry.xy_px[hidden]


def _draw_compass(canvas: Canvas, view: View, overlay: dict[str, Any]) -> None:
    """The letters of the compass, the rover's nose, and ticks each ten degrees: at the horizontal, or as low as the
    frame shows.
    """
    ticks = [(azimuth_deg, view.canvas_px(tick)) for azimuth_deg, *tick in overlay["compass"]]
    for azimuth_deg, (foot, _, letter) in ticks:
        if azimuth_deg in COMPASS:
            further = [foot + part * (letter - foot) for part in LETTER_PARTS]  # where no mark stands
            place = next((one for one in further if canvas.is_free(box_around(one, TEXT_PX))), letter)
            canvas.text(place, COMPASS[azimuth_deg], Ink.PLAIN, "mm", 2 * TEXT_PX, halo=True)
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
