"""The map of a track: smoothed line, filtered positions, 95 % ellipses, odometry alone, and frames not used."""

from __future__ import annotations

import numpy as np

from startrack.applications.tracking.track import Track, Trajectory
from startrack.core.types import Array
from startrack.estimation.trajectory import SIGMAS_95
from startrack.output import TEXT_PX, Box, Canvas, Ink, Legend, Map, box_around, ellipse_m, mix_colours, nice_step

ODOMETRY, REFUSED, LEFT_OUT, SLIP = Ink.YELLOW, Ink.PURPLE, Ink.PURPLE, Ink.YELLOW
SEEN_PX = 14.0  # half of the longer axis that the median ellipse has at least
SMALLEST_HALF_M = 0.05
REST_WIDEST = 25.0  # the map of a camera at rest, in half axes of the last ellipse


def draw_track_map(canvas: Canvas, box: Box, track: Track, odometry_m: Array | None) -> tuple[Map, Legend]:
    """Draw the map into the box; returns it and its legend."""
    drawn = Map.of_extent(canvas, box, *track_extent(track, odometry_m))
    drawn.draw_ground(track.terrain)
    x, y = box[2] - 2 * TEXT_PX, box[1] + 2 * TEXT_PX
    canvas.reserve(box_around((x, y), 2.5 * TEXT_PX))
    for place in () if track.at_rest else drawn.canvas_px(known_points(track.smoothed.position_enu_m[:, :2])):
        canvas.reserve(box_around(place, 0.75 * TEXT_PX))  # heights of contours keep clear of it
    words = drawn.draw_heights(track.terrain)
    legend = _draw_rest(drawn, track) if track.at_rest else _draw_drive(drawn, track, odometry_m)
    drawn.draw_frame(words)
    canvas.area([(x, y - 12), (x + 8, y + 16), (x, y + 9), (x - 8, y + 16)], Ink.PLAIN)  # an arrow to the north
    canvas.text((x, y + 2 * TEXT_PX), "N", Ink.PLAIN, "ms", halo=True)
    return drawn, legend


def track_extent(track: Track, odometry_m: Array | None = None) -> tuple[tuple[float, float], float]:
    """Centre (east, north) and half side [m] of a map of the `track`; the search area where no position is known."""
    if track.at_rest:
        return _rest_extent(track)
    points = [track.smoothed.position_enu_m[:, :2], *([] if odometry_m is None else [odometry_m])]
    around = np.concatenate(points)
    around = around[np.isfinite(around).all(axis=1)]
    if not len(around):
        return (0.0, 0.0), track.terrain.search_radius_m
    low, high = around.min(axis=0), around.max(axis=0)
    axis = half_axes_95_m(track.smoothed.covariance_m2)
    widest = float(axis[np.isfinite(axis)].max(initial=SMALLEST_HALF_M))
    east, north = (float(x) for x in 0.5 * (low + high))
    span = float((high - low).max())
    return (east, north), max(0.57 * span, 0.5 * span + 1.3 * widest)


def _rest_extent(track: Track) -> tuple[tuple[float, float], float]:
    axis = half_axes_95_m(track.filtered.covariance_m2)
    known = np.flatnonzero(np.isfinite(axis))
    if not len(known):
        return (0.0, 0.0), track.terrain.search_radius_m
    east, north = (float(x) for x in track.smoothed.position_enu_m[known[-1], :2])
    away = np.linalg.norm(track.filtered.position_enu_m[known, :2] - (east, north), axis=1)
    half = 1.12 * float((away + axis[known]).max())
    return (east, north), max(min(half, REST_WIDEST * float(axis[known[-1]])), SMALLEST_HALF_M)


def half_axes_95_m(covariance_m2: Array) -> Array:
    """Longer half axes (n,) [m] of the 95 % ellipses of covariances (n, 2, 2); infinite where these are."""
    known = np.isfinite(covariance_m2).all(axis=(1, 2))
    axis = np.full(len(covariance_m2), np.inf)
    axis[known] = SIGMAS_95 * np.sqrt(np.maximum(np.linalg.eigvalsh(covariance_m2[known])[:, 1], 0.0))
    return axis


def known_points(points_m: Array) -> Array:
    """The points (n, 2) that are known."""
    return points_m[np.isfinite(points_m).all(axis=1)]


def _draw_drive(drawn: Map, track: Track, odometry_m: Array | None) -> Legend:
    window = drawn.window
    legend: Legend = [("line", Ink.POSITION, "smoothed: by all frames")]
    times = _draw_ellipses(drawn, track)
    enlarged = f", enlarged {times:g} times" if times > 1 else ""
    legend += [("ring", Ink.POSITION, f"95 % ellipse of it{enlarged}")]
    if odometry_m is not None:
        window.line(drawn.canvas_px(known_points(odometry_m)), ODOMETRY, 2)
        legend += [("line", ODOMETRY, "odometry alone")]
    smoothed = drawn.canvas_px(known_points(track.smoothed.position_enu_m[:, :2]))
    if len(smoothed) > 1:
        window.curve(smoothed, Ink.POSITION, 3.0)
    for place in drawn.canvas_px(known_points(track.filtered.position_enu_m[:, :2])):
        window.mark(place, "disc", TEXT_PX / (5 if len(smoothed) < 200 else 8), Ink.BLUE)
    legend += [("disc", Ink.BLUE, "filtered: by the frames up to each")]
    legend += _draw_not_used(drawn, track)
    if len(smoothed) > 1:
        for word, place in zip(("start", "end"), smoothed[[0, -1]], strict=True):
            window.mark(place, "ring", TEXT_PX / 2, Ink.PLAIN)
            drawn.canvas.text((place[0] + TEXT_PX, place[1]), word, Ink.PLAIN, "lm", halo=True)
    return legend


def _draw_ellipses(drawn: Map, track: Track) -> float:
    """Ellipses of the smoothed positions, each clear of the last one's centre; returns how much they are enlarged."""
    axis_m = half_axes_95_m(track.smoothed.covariance_m2)
    known = np.flatnonzero(np.isfinite(axis_m))
    if not len(known):
        return 1.0
    median_px = max(float(np.median(axis_m[known])) / drawn.metres_per_px, 1e-6)
    times = 1.0 if median_px >= SEEN_PX else nice_step(2.5 * SEEN_PX / median_px)
    last = None
    for k in known:
        centre_m = track.smoothed.position_enu_m[k, :2]
        if last is None or k == known[-1] or np.linalg.norm(centre_m - last) > 0.8 * times * axis_m[k]:
            last = centre_m
            outline = _outline(drawn, track.smoothed, int(k), times)
            drawn.window.curve(outline, mix_colours(Ink.POSITION, Ink.PLAIN, 0.25), 1.6, closed=True)
    return times


def _outline(drawn: Map, trajectory: Trajectory, k: int, times: float = 1.0) -> Array:
    """Canvas places (n, 2) of the 95 % ellipse of frame k, enlarged so many times."""
    east, north, _ = trajectory.position_enu_m[k]
    return drawn.canvas_px(ellipse_m((east, north), (times * SIGMAS_95) ** 2 * trajectory.covariance_m2[k])[:-1])


def _draw_not_used(drawn: Map, track: Track) -> Legend:
    """Marks at the smoothed positions of frames that were refused or left out, and after slips of the odometry."""
    places = drawn.canvas_px(track.smoothed.position_enu_m[:, :2])
    slipped = np.flatnonzero(track.slipped)
    status = np.array([frame.status for frame in track.frames], dtype=np.str_)
    legend: Legend = []
    for kind, colour, words, at in (
        ("cross", REFUSED, "refused frame", places[status == "refused"]),
        ("plus", LEFT_OUT, "frame left out", places[status == "left_out"]),
        ("ring", SLIP, "slip of the odometry", 0.5 * (places[slipped] + places[slipped + 1])),
    ):
        for place in known_points(at):
            drawn.window.mark(place, kind, 0.45 * TEXT_PX, colour, 2 if kind == "ring" else 3)
        legend += [(kind, colour, words)] if len(at) else []
    return legend


def _draw_rest(drawn: Map, track: Track) -> Legend:
    """The position after each exposure with its ellipse; brighter ones are later."""
    window, known = drawn.window, np.flatnonzero(np.isfinite(track.filtered.position_enu_m).all(axis=1))
    for rank, k in enumerate(known):
        colour = mix_colours(Ink.FAINT, Ink.BLUE, (rank + 1) / len(known))
        outline = _outline(drawn, track.filtered, int(k))
        window.curve(outline, colour, 2.0, closed=True)
        drawn.canvas.label(outline[int(np.argmin(outline[:, 1]))], str(k + 1), colour, TEXT_PX / 2, drawn.box)
    places = drawn.canvas_px(track.filtered.position_enu_m[known, :2])
    window.line(places, Ink.BLUE)
    for place in places:
        window.mark(place, "disc", TEXT_PX / 5, Ink.BLUE)
    if len(known):
        last = int(known[-1])
        window.curve(_outline(drawn, track.smoothed, last), Ink.POSITION, 3.0, closed=True)
        window.mark(drawn.canvas_px(track.smoothed.position_enu_m[last, :2]), "plus", TEXT_PX / 2, Ink.POSITION)
    return [
        ("ring", Ink.BLUE, "position after each exposure, and its 95 % ellipse"),
        ("ring", Ink.POSITION, "by all exposures"),
    ]
