"""The picture of a track: a map with its positions and 95 % ellipses, odometry alone, and frames not used.

Ellipses have their true size: where the map shows the last one too small to see, it is enlarged beside the map.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from startrack.applications.tracking.track import Track, Trajectory
from startrack.core.errors import length_text
from startrack.core.types import Array
from startrack.estimation.trajectory import SIGMAS_95
from startrack.output import (
    MARGIN_PX,
    SIDE_PX,
    TEXT_PX,
    TITLE_PX,
    Box,
    Canvas,
    Colour,
    Ink,
    Legend,
    Map,
    box_around,
    ellipse_m,
)

MAP_BOX: Box = (MARGIN_PX, MARGIN_PX, MARGIN_PX + SIDE_PX, MARGIN_PX + SIDE_PX)
PANEL_PX = 22.5 * TEXT_PX  # beside the map
TRACK_SIZE_PX = round(MAP_BOX[2] + 4 * TEXT_PX + PANEL_PX), round(MAP_BOX[3] + MARGIN_PX)
ODOMETRY, UNUSED = Ink.YELLOW, Ink.PURPLE
SEEN_PX, HIDDEN_PX = 14.0, 3.0  # longer half axes of an ellipse that is seen well, and of one that its mark hides
RESERVED_PLACES = 100  # along a line
LEAST_INSET_PX = 8 * TEXT_PX  # a lower part of the panel has no room for the last position
SMALLEST_HALF_M = 0.05
WIDEST = 25.0  # ellipse that the map has room for, in half axes of the last one


def draw_track(track: Track) -> NDArray[np.uint8]:
    """The picture (H, W, 3), red, green, blue: the map, and beside it the track in words and a legend."""
    canvas = Canvas(*TRACK_SIZE_PX)
    title = f"{'camera at rest' if track.at_rest else 'track'} on {track.terrain.name}"
    canvas.text((MAP_BOX[0], 0.7 * MARGIN_PX), title, Ink.PLAIN, size=TITLE_PX)
    drawn, legend = draw_track_map(canvas, MAP_BOX, track)
    drawn.draw_distances()
    left, y = MAP_BOX[2] + 2 * TEXT_PX, MAP_BOX[1] + TEXT_PX
    for line in _facts(track):
        y = canvas.paragraph(left, y, line, PANEL_PX, Ink.PLAIN)
    y = canvas.legend(left, y + TEXT_PX, PANEL_PX, legend)
    draw_last_position(drawn, (left, max(y + TEXT_PX, MAP_BOX[3] - PANEL_PX), left + PANEL_PX, MAP_BOX[3]), track)
    return canvas.rendered_pixels()


def _facts(track: Track) -> list[str]:
    """Lines of text: the frames of a `track` by status, its times, its last position, its crater and its slips."""
    statuses = [frame.status for frame in track.frames]
    parts = [f"{statuses.count(one)} {one.replace('_', ' ')}" for one in dict.fromkeys(["used", *sorted(statuses)])]
    start, end = (f"{track.frames[k].time_utc:%Y-%m-%d %H:%M:%S}" for k in (0, -1))
    lines = [f"{len(statuses)} frames: {', '.join(parts)}", f"{start} to {end} UTC"]
    known = np.flatnonzero(np.isfinite(track.smoothed.radius95_m))
    if len(known):
        (east_m, north_m, _), radius_m = track.smoothed.position_enu_m[known[-1]], track.smoothed.radius95_m[known]
        lines += [
            f"last position: E {east_m:.1f} m  N {north_m:.1f} m",
            f"95 % within {length_text(radius_m[-1])} of it",
        ]
        lines += [f"95 % radius of all, smoothed: median {length_text(float(np.median(radius_m)))}"]
    return [*lines, *track.crater_texts, *track.leg_texts]


def track_extent(track: Track) -> tuple[tuple[float, float], float]:
    """Centre (east, north) and half side [m] of a map of the `track`; the search area where no position is known."""
    shown = _shown(track)
    around = known_points(np.concatenate([shown.position_enu_m[:, :2], track.odometry_m]))
    if not len(around):
        return (0.0, 0.0), track.terrain.search_radius_m
    low, high = around.min(axis=0), around.max(axis=0)
    axis = half_axes_95_m(shown.covariance_m2)
    axis = axis[np.isfinite(axis)]
    widest = min(float(axis.max(initial=SMALLEST_HALF_M)), WIDEST * float(axis[-1]) if len(axis) else np.inf)
    east, north = (float(x) for x in 0.5 * (low + high))
    span = float((high - low).max())
    return (east, north), max(0.57 * span, 0.5 * span + 1.3 * widest)


def half_axes_95_m(covariance_m2: Array) -> Array:
    """Longer half axes (n,) [m] of the 95 % ellipses of covariances (n, 2, 2); infinite where these are."""
    known = np.isfinite(covariance_m2).all(axis=(1, 2))
    axis = np.full(len(covariance_m2), np.inf)
    axis[known] = SIGMAS_95 * np.sqrt(np.maximum(np.linalg.eigvalsh(covariance_m2[known])[:, 1], 0.0))
    return axis


def known_points(points_m: Array) -> Array:
    """The points (n, 2) that are known."""
    return points_m[np.isfinite(points_m).all(axis=1)]


def draw_track_map(canvas: Canvas, box: Box, track: Track) -> tuple[Map, Legend]:
    """Draw the map into the box; returns it and its legend."""
    drawn = Map.of_extent(canvas, box, *track_extent(track))
    drawn.draw_ground(track.terrain)
    _keep_heights_off(drawn, track)
    words = drawn.draw_heights(track.terrain)
    legend = _draw_marks(drawn, track)
    drawn.draw_frame(words)
    return drawn, legend


def _keep_heights_off(drawn: Map, track: Track) -> None:
    """Keep the heights of contours off the caption, the scale bar and the lines of a `track` on a map."""
    left, top, right, bottom = drawn.box
    drawn.canvas.reserve((left, top, right, top + 2 * TEXT_PX))
    drawn.canvas.reserve((left + (right - left) / 2, bottom - 3 * TEXT_PX, right, bottom))
    for line in (track.smoothed.position_enu_m[:, :2], track.odometry_m):
        if len(points := drawn.canvas_px(known_points(line))):
            places = np.linspace(0, len(points) - 1, RESERVED_PLACES)
            for at in np.stack([np.interp(places, np.arange(len(points)), x) for x in points.T], axis=-1):
                drawn.canvas.reserve(box_around(at, TEXT_PX / 2))


def draw_last_position(drawn: Map, box: Box, track: Track) -> None:
    """The last known position of a `track` in the `box`, where its ellipse is small on the map that is `drawn`."""
    shown = _shown(track)
    axis_m = half_axes_95_m(shown.covariance_m2)
    known = np.flatnonzero(np.isfinite(axis_m))
    if not len(known) or axis_m[known[-1]] >= SEEN_PX * drawn.metres_per_px or box[3] - box[1] < LEAST_INSET_PX:
        return
    east_m, north_m = shown.position_enu_m[known[-1], :2].tolist()
    half_m = 2.0 * max(float(axis_m[known[-1]]), SMALLEST_HALF_M)
    inset = Map.of_extent(drawn.canvas, box, (east_m, north_m), half_m)
    inset.window.rectangle(box, Ink.FLOOR)
    inset.draw_grid()
    _draw_marks(inset, track)
    inset.draw_frame("")
    drawn.canvas.text((box[0], box[1] - TEXT_PX / 2), "the last position, enlarged")


def _shown(track: Track) -> Trajectory:
    """The positions of a `track` whose ellipses are drawn: at rest the smoothed ones are all the same."""
    return track.filtered if track.at_rest else track.smoothed


def _draw_marks(drawn: Map, track: Track) -> Legend:
    """Draw ellipses, lines and marks of a `track` on a map; returns their legend."""
    window, colour = drawn.window, Ink.BLUE if track.at_rest else Ink.POSITION
    _draw_ellipses(drawn, _shown(track), colour)
    legend: Legend = [("ring", colour, "95 % ellipses, at their true size")]
    if len(track.odometry_m):
        window.line(drawn.canvas_px(known_points(track.odometry_m)), ODOMETRY, 2)
        legend += [("line", ODOMETRY, "odometry alone")]
    smoothed, filtered = (drawn.canvas_px(one.position_enu_m[:, :2]) for one in (track.smoothed, track.filtered))
    window.line(known_points(smoothed), Ink.POSITION, 3)
    for place in known_points(filtered):
        window.mark(place, "disc", TEXT_PX / (5 if len(filtered) < 200 else 8), Ink.BLUE)
    legend += [("line", Ink.POSITION, "smoothed: by all frames"), ("disc", Ink.BLUE, "filtered: by those up to each")]
    status, slipped = np.array([frame.status for frame in track.frames], dtype=np.str_), np.flatnonzero(track.slipped)
    for kind, ink, what, at in (
        ("cross", UNUSED, "refused frame", smoothed[status == "refused"]),
        ("plus", UNUSED, "frame left out", smoothed[status == "left_out"]),
        ("ring", ODOMETRY, "slip of the odometry", 0.5 * (smoothed[slipped] + smoothed[slipped + 1])),
        ("plus", Ink.POSITION, "last position", smoothed[-1:]),
    ):  # fmt: skip
        for place in known_points(at):
            window.mark(place, kind, 0.45 * TEXT_PX, ink, 2 if kind == "ring" else 3)
        legend += [(kind, ink, what)] if len(at) else []
    return legend


def _draw_ellipses(drawn: Map, shown: Trajectory, colour: Colour) -> None:
    """Ellipses of positions that their marks do not hide, each clear of the last one's centre."""
    axis_m, last = half_axes_95_m(shown.covariance_m2), None
    seen = np.flatnonzero(np.isfinite(axis_m) & (axis_m > HIDDEN_PX * drawn.metres_per_px))
    for k in seen:
        centre_m = shown.position_enu_m[k, :2]
        if last is None or k == seen[-1] or np.linalg.norm(centre_m - last) > 0.8 * axis_m[k]:
            last = centre_m
            outline = ellipse_m(tuple(centre_m.tolist()), SIGMAS_95**2 * shown.covariance_m2[k])
            drawn.window.curve(drawn.canvas_px(outline[:-1]), colour, 1.6, closed=True)
