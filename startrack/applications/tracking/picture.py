"""The picture of a track: a map with its positions and ellipses, the search area, and the stated errors by frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from startrack.applications.tracking.frame_graph import Series, draw_graph
from startrack.applications.tracking.track import Track
from startrack.applications.tracking.track_map import ODOMETRY, REFUSED, draw_track_map
from startrack.core.errors import length_text
from startrack.core.types import Array
from startrack.output.picture.annotate import draw_legend_sample
from startrack.output.picture.canvas import DIM_INK, INK, POSITION, SKY_BLUE, Box, Canvas, Colour, wrap_text
from startrack.output.picture.maps import MapView, draw_overview
from startrack.output.picture.terrain_picture import draw_distances

WIDTH_PX, HEIGHT_PX = 1340, 1240
MAP_BOX: Box = (70.0, 62.0, 930.0, 922.0)
PANEL: Box = (962.0, 62.0, 1316.0, 922.0)  # beside the map
GRAPH_TOP_PX, GRAPH_BOTTOM_PX = 1012.0, 1186.0
TITLE_SIZE, TEXT_SIZE = 24.0, 16.0


def draw_track(track: Track, odometry_m: Array | None = None) -> NDArray[np.uint8]:
    """The picture (H, W, 3), red, green, blue.

    A map of the smoothed track with the filtered positions and 95 % ellipses, enlarged where they would be too small;
    of a camera at rest, the position after each exposure. Beside it the search area, below it the stated 95 % radii.

    Args:
        track: with n frames.
        odometry_m: positions (n, 2) in enu by odometry alone, from the first smoothed position; None: not known.
    """
    canvas = Canvas(WIDTH_PX, HEIGHT_PX)
    left, top, right, _ = PANEL
    words = "camera at rest" if track.at_rest else "track"
    canvas.text((MAP_BOX[0], 40.0), f"{words} on {track.terrain.name}", TITLE_SIZE, INK)
    view, legend = draw_track_map(canvas, MAP_BOX, track, odometry_m)
    draw_distances(canvas, view)
    bottom = top + right - left
    _draw_extent(canvas, draw_overview(canvas, (left, top, right, bottom), track.terrain, None, False, None), view)
    bottom = _draw_lines(canvas, bottom + 36, _facts(track))
    _draw_legend(canvas, bottom + 18, legend)
    _draw_graphs(canvas, track, odometry_m)
    return canvas.rendered_pixels()


def _draw_extent(canvas: Canvas, overview: MapView, view: MapView) -> None:
    """Where the map lies in the search area: its edge, and a ring where that is too small to see."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * view.half_m + view.centre_m
    places = overview.canvas_px(corners)
    window = canvas.window(overview.box)
    window.line(places, POSITION, 2, closed=True)
    if np.ptp(places[:, 0]) < 16.0:
        window.circle(places.mean(axis=0), 11.0, POSITION, 2)


def _facts(track: Track) -> list[str]:
    """What the track rests on, and its last position."""
    statuses = [frame.status for frame in track.frames]
    counts = ", ".join(
        f"{statuses.count(status)} {words}"
        for status, words in (("used", "used"), ("left_out", "left out"), ("refused", "refused"))
        if status == "used" or status in statuses
    )
    lines = [f"{len(statuses)} frames: {counts}"]
    if statuses:
        start, end = (f"{track.frames[k].time_utc:%Y-%m-%d %H:%M:%S}" for k in (0, -1))
        lines.append(f"{start} to {end} UTC")
    radius_m = track.smoothed.radius95_m
    known = np.flatnonzero(np.isfinite(radius_m))
    if len(known):
        east_m, north_m, _ = track.smoothed.position_enu_m[known[-1]]
        lines += [
            f"last position: E {east_m:.1f} m  N {north_m:.1f} m",
            f"95 % within {length_text(radius_m[known[-1]])} of it",
        ]
    if len(known) > 1 and not track.at_rest:
        lines.append(f"95 % radius of all, smoothed: median {length_text(float(np.median(radius_m[known])))}")
    if track.slipped.any():
        lines.append(f"slips of the odometry: {np.count_nonzero(track.slipped)}")
    return lines


def _draw_lines(canvas: Canvas, y: float, lines: list[str]) -> float:
    """Lines of text in the panel, wrapped; returns where the next may stand."""
    left, _, right, _ = PANEL
    for line in lines:
        for k, part in enumerate(wrap_text(line, TEXT_SIZE, right - left)):
            canvas.text((left + (16 if k else 0), y), part, TEXT_SIZE, INK if not k else DIM_INK)
            y += 1.45 * TEXT_SIZE
    return y


def _draw_legend(canvas: Canvas, y: float, legend: list[tuple[str, Colour, str]]) -> None:
    left, _, right, _ = PANEL
    for kind, colour, words in legend:
        draw_legend_sample(canvas, left + 12, y - 5, kind, colour)
        for part in wrap_text(words, TEXT_SIZE, right - left - 34):
            canvas.text((left + 34, y), part, TEXT_SIZE, DIM_INK)
            y += 1.35 * TEXT_SIZE
        y += 0.3 * TEXT_SIZE


def _draw_graphs(canvas: Canvas, track: Track, odometry_m: Array | None) -> None:
    """Stated 95 % radii by frame; beside it, how far odometry alone departs from the smoothed track."""
    radii: list[Series] = [
        ("filtered", track.filtered.radius95_m, SKY_BLUE),
        ("smoothed", track.smoothed.radius95_m, POSITION),
    ]
    crossed = np.array([k for k, frame in enumerate(track.frames) if frame.status != "used"], dtype=np.int64)
    left, right = MAP_BOX[0], PANEL[2]
    middle = right if odometry_m is None else 0.5 * (left + right) - 40.0
    box = left, GRAPH_TOP_PX, middle, GRAPH_BOTTOM_PX
    draw_graph(canvas, box, "stated 95 % radius", radii, crossed, REFUSED, logarithmic=True)
    if odometry_m is not None:
        away_m = np.linalg.norm(odometry_m - track.smoothed.position_enu_m[:, :2], axis=1)
        box = middle + 80.0, GRAPH_TOP_PX, right, GRAPH_BOTTOM_PX
        draw_graph(canvas, box, "odometry alone, from the smoothed track", [("", away_m, ODOMETRY)], crossed, REFUSED)
