"""The map of a track: smoothed line, filtered positions, 95 % ellipses, odometry alone, and frames not used."""

from __future__ import annotations

import numpy as np

from startrack.applications.tracking.track import Track, Trajectory
from startrack.core.types import Array
from startrack.estimation.trajectory import SIGMAS_95
from startrack.output import (
    CAPTION_SIZE,
    FAINT_INK,
    INK,
    POSITION,
    REDDISH_PURPLE,
    SKY_BLUE,
    YELLOW,
    Box,
    Canvas,
    Colour,
    MapView,
    box_around,
    draw_contours,
    draw_frame,
    draw_ground,
    ellipse_m,
    ground_of_view,
    map_view,
    mix_colours,
    nice_step,
)

Legend = list[tuple[str, Colour, str]]  # kind of the mark, its colour, words

ODOMETRY, REFUSED, LEFT_OUT, SLIP = YELLOW, REDDISH_PURPLE, REDDISH_PURPLE, YELLOW
SEEN_PX = 14.0  # half of the longer axis that the median ellipse has at least
SMALLEST_HALF_M = 0.05
REST_WIDEST = 25.0  # the map of a camera at rest, in half axes of the last ellipse


def draw_track_map(canvas: Canvas, box: Box, track: Track, odometry_m: Array | None) -> tuple[MapView, Legend]:
    """Draw the map into the box; returns it and its legend."""
    view = map_view(box, *track_extent(track, odometry_m))
    window = canvas.window(box)
    draw_ground(window, view, track.terrain)
    north = box[2] - 30.0, box[1] + 26.0
    canvas.reserve(box_around(north, 40.0))
    for place in () if track.at_rest else view.canvas_px(known_points(track.smoothed.position_enu_m[:, :2])):
        canvas.reserve(box_around(place, 0.75 * CAPTION_SIZE))  # heights of contours keep clear of it
    step_m = None
    if track.terrain.rim_radius_m is None:
        size = window.size[1], window.size[0]
        step_m = draw_contours(canvas, window, view, *ground_of_view(view, track.terrain, size))
    if track.at_rest:
        legend = _draw_rest(canvas, window, view, track)
    else:
        legend = _draw_drive(canvas, window, view, track, odometry_m)
    draw_frame(
        canvas, view, "" if step_m is None else f"contours each {step_m:g} m, heights above the sphere at the origin"
    )
    _draw_north(canvas, *north)
    return view, legend


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


def _draw_drive(canvas: Canvas, window: Canvas, view: MapView, track: Track, odometry_m: Array | None) -> Legend:
    legend: Legend = [("line", POSITION, "smoothed: by all frames")]
    times = _draw_ellipses(window, view, track)
    enlarged = f", enlarged {times:g} times" if times > 1 else ""
    legend += [("ring", POSITION, f"95 % ellipse of it{enlarged}")]
    if odometry_m is not None:
        window.line(view.canvas_px(known_points(odometry_m)), ODOMETRY, 2)
        legend += [("line", ODOMETRY, "odometry alone")]
    smoothed = known_points(track.smoothed.position_enu_m[:, :2])
    if len(smoothed) > 1:
        window.curve(view.canvas_px(smoothed), POSITION, 3.0)
    for place in view.canvas_px(known_points(track.filtered.position_enu_m[:, :2])):
        window.circle(place, 3.2 if len(smoothed) < 200 else 2.0, SKY_BLUE, -1)
    legend += [("dot", SKY_BLUE, "filtered: by the frames up to each")]
    legend += _draw_not_used(window, view, track)
    if len(smoothed) > 1:
        for word, place in zip(("start", "end"), view.canvas_px(smoothed[[0, -1]]), strict=True):
            window.circle(place, 7.0, INK, 2)
            canvas.text((place[0] + 14.0, place[1]), word, CAPTION_SIZE, INK, "lm", halo=True)
    return legend


def known_points(points_m: Array) -> Array:
    """The points (n, 2) that are known."""
    return points_m[np.isfinite(points_m).all(axis=1)]


def _draw_ellipses(window: Canvas, view: MapView, track: Track) -> float:
    """Ellipses of the smoothed positions, each clear of the last one's centre; returns how much they are enlarged."""
    axis_m = half_axes_95_m(track.smoothed.covariance_m2)
    known = np.flatnonzero(np.isfinite(axis_m))
    if not len(known):
        return 1.0
    median_px = max(float(np.median(axis_m[known])) / view.metres_per_px, 1e-6)
    times = 1.0 if median_px >= SEEN_PX else nice_step(2.5 * SEEN_PX / median_px)
    last = None
    for k in known:
        centre_m = track.smoothed.position_enu_m[k, :2]
        if last is None or k == known[-1] or np.linalg.norm(centre_m - last) > 0.8 * times * axis_m[k]:
            last = centre_m
            outline = _outline(view, track.smoothed, int(k), times)
            window.curve(outline, mix_colours(POSITION, INK, 0.25), 1.6, closed=True)
    return times


def _outline(view: MapView, trajectory: Trajectory, k: int, times: float = 1.0) -> Array:
    """Canvas places (n, 2) of the 95 % ellipse of frame k, enlarged so many times."""
    east, north, _ = trajectory.position_enu_m[k]
    return view.canvas_px(ellipse_m((east, north), (times * SIGMAS_95) ** 2 * trajectory.covariance_m2[k])[:-1])


def _draw_not_used(window: Canvas, view: MapView, track: Track) -> Legend:
    """Marks at the smoothed positions of frames that were refused or left out, and after slips of the odometry."""
    legend: Legend = []
    places = view.canvas_px(track.smoothed.position_enu_m[:, :2])
    seen = np.asarray(np.isfinite(places).all(axis=1))
    statuses = [frame.status for frame in track.frames]
    for place, known, status in zip(places, seen, statuses, strict=True):
        if known and status == "refused":
            window.cross(place, 6.5, REFUSED, 3)
        elif known and status == "left_out":
            window.plus(place, 8.0, LEFT_OUT, 3)
    if "refused" in statuses:
        legend += [("cross", REFUSED, "refused frame")]
    if "left_out" in statuses:
        legend += [("plus", LEFT_OUT, "frame left out")]
    if track.slipped.any():
        for k in np.flatnonzero(track.slipped):
            if seen[k] and seen[k + 1]:
                window.circle(0.5 * (places[k] + places[k + 1]), 6.0, SLIP, 2)
        legend += [("ring", SLIP, "slip of the odometry")]
    return legend


def _draw_rest(canvas: Canvas, window: Canvas, view: MapView, track: Track) -> Legend:
    """The position after each exposure with its ellipse; brighter ones are later."""
    known = np.flatnonzero(np.isfinite(track.filtered.position_enu_m).all(axis=1))
    for rank, k in enumerate(known):
        colour = mix_colours(FAINT_INK, SKY_BLUE, (rank + 1) / len(known))
        outline = _outline(view, track.filtered, int(k))
        window.curve(outline, colour, 2.0, closed=True)
        canvas.label(outline[int(np.argmin(outline[:, 1]))], str(k + 1), CAPTION_SIZE, colour, 9.0, view.box)
    window.line(view.canvas_px(track.filtered.position_enu_m[known, :2]), SKY_BLUE)
    for place in view.canvas_px(track.filtered.position_enu_m[known, :2]):
        window.circle(place, 3.5, SKY_BLUE, -1)
    if len(known):
        last = int(known[-1])
        window.curve(_outline(view, track.smoothed, last), POSITION, 3.0, closed=True)
        window.plus(view.canvas_px(track.smoothed.position_enu_m[last, :2]), 7.0, POSITION, 2)
    return [
        ("ring", SKY_BLUE, "position after each exposure, and its 95 % ellipse"),
        ("ring", POSITION, "by all exposures"),
    ]


def _draw_north(canvas: Canvas, x: float, y: float) -> None:
    """An arrow to the north about (x, y)."""
    canvas.area([(x, y - 12), (x + 8, y + 16), (x, y + 9), (x - 8, y + 16)], INK)
    canvas.text((x, y + 36), "N", CAPTION_SIZE, INK, "ms", halo=True)
