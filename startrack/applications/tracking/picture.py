"""The picture of a track: a map with its positions and ellipses, the search area, and the stated errors by frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from startrack.applications.tracking.track import Track
from startrack.applications.tracking.track_map import ODOMETRY, REFUSED, draw_track_map
from startrack.core.errors import length_text
from startrack.core.types import Array
from startrack.output import MARGIN_PX, SIDE_PX, TEXT_PX, TITLE_PX, Axes, Box, Canvas, Colour, Ink, Map, draw_overview

PANEL_PX, GRAPH_PX = 22.5 * TEXT_PX, 15 * TEXT_PX  # beside and below the map
MAP_BOX: Box = (MARGIN_PX, MARGIN_PX, MARGIN_PX + SIDE_PX, MARGIN_PX + SIDE_PX)
PANEL: Box = (MAP_BOX[2] + 2 * TEXT_PX, MARGIN_PX, MAP_BOX[2] + 2 * TEXT_PX + PANEL_PX, MARGIN_PX + PANEL_PX)
TRACK_WIDTH_PX, TRACK_HEIGHT_PX = round(PANEL[2] + 2 * TEXT_PX), round(MAP_BOX[3] + 2.5 * MARGIN_PX + GRAPH_PX)
LOGARITHMIC = 8.0  # a scale whose ends have a larger ratio

Series = list[tuple[str, Colour, Array]]  # names, colours, and lengths (n,) [m], nan or infinite where not known


def draw_track(track: Track, odometry_m: Array | None = None) -> NDArray[np.uint8]:
    """The picture (H, W, 3), red, green, blue.

    A map of the smoothed track with the filtered positions and 95 % ellipses, enlarged where they would be too small;
    of a camera at rest, the position after each exposure. Beside it the search area, below it the stated 95 % radii.

    Args:
        track: with n frames.
        odometry_m: positions (n, 2) in enu by odometry alone, from the first smoothed position; None: not known.
    """
    canvas = Canvas(TRACK_WIDTH_PX, TRACK_HEIGHT_PX)
    title = f"{'camera at rest' if track.at_rest else 'track'} on {track.terrain.name}"
    canvas.text((MAP_BOX[0], 0.7 * MARGIN_PX), title, Ink.PLAIN, size=TITLE_PX)
    drawn, legend = draw_track_map(canvas, MAP_BOX, track, odometry_m)
    drawn.draw_distances()
    _draw_extent(draw_overview(canvas, PANEL, track.terrain), drawn)
    y = PANEL[3] + 2 * TEXT_PX
    for line in _facts(track):
        y = canvas.paragraph(PANEL[0], y, line, PANEL_PX, Ink.PLAIN)
    canvas.legend(PANEL[0], y + TEXT_PX, PANEL_PX, legend)
    filtered, smoothed = track.filtered.radius95_m, track.smoothed.radius95_m
    unused = np.array([frame.status != "used" for frame in track.frames], dtype=bool)
    left, right, bottom = MAP_BOX[0], PANEL[2], TRACK_HEIGHT_PX - MARGIN_PX
    middle = right if odometry_m is None else 0.5 * (left + right - MARGIN_PX)
    radii: Series = [("filtered", Ink.BLUE, filtered), ("smoothed", Ink.POSITION, smoothed)]
    draw_graph(canvas, (left, bottom - GRAPH_PX, middle, bottom), "stated 95 % radius [m]", radii, unused, True)
    if odometry_m is not None:
        away_m = np.linalg.norm(odometry_m - track.smoothed.position_enu_m[:, :2], axis=1)
        box = (middle + MARGIN_PX, bottom - GRAPH_PX, right, bottom)
        draw_graph(canvas, box, "odometry alone, from the smoothed track [m]", [("", ODOMETRY, away_m)], unused)
    return canvas.rendered_pixels()


def _draw_extent(overview: Map, drawn: Map) -> None:
    """Where a map lies in the search area: its edge, and a ring where that is too small to see."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * drawn.half_m + drawn.centre_m
    places = overview.canvas_px(corners)
    overview.window.line(places, Ink.POSITION, 2, closed=True)
    if np.ptp(places[:, 0]) < TEXT_PX:
        overview.window.mark(places.mean(axis=0), "ring", 0.7 * TEXT_PX, Ink.POSITION)


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
    lines += track.crater_texts
    slips = f"slips of the odometry: {np.count_nonzero(track.slipped)} moves in {len(track.legs)} legs"
    return lines + ([slips] if track.slipped.any() else [])


def draw_graph(
    canvas: Canvas, box: Box, caption: str, series: Series, unused: NDArray[np.bool_], logarithmic: bool = False
) -> None:
    """Lengths [m] of the `series` above the number of the frame in the `box` of the `canvas`, below a `caption`.

    There is a cross below each frame that is `unused` (n,). `logarithmic`: where the lengths differ much.
    """
    values = np.concatenate([values for _, _, values in series])
    known, count = values[np.isfinite(values) & (values >= 0)], len(unused)
    low, high = float(known.min(initial=np.inf)), float(known.max(initial=0.0)) or 1.0
    logarithmic = logarithmic and 0 < LOGARITHMIC * low < high
    y = (0.8 * low, 1.25 * high) if logarithmic else (0.0, 1.15 * high)
    axes = Axes(canvas, box, (0.5, count + 0.5), y, "y" if logarithmic else "")
    names = [(name, colour) for name, colour, _ in series]
    names += [("x: frame not used", REFUSED)] if unused.any() else []
    step = max(1, round(float(np.diff(axes.ticks("x")).min(initial=count))))
    axes.draw_scales(caption, "frame", names, np.array(sorted({1, *range(step, count + 1, step)})))
    frame = np.arange(1.0, count + 1)
    for _, colour, values in series:
        axes.draw_curve(frame, values, colour, TEXT_PX / (5 if count < 150 else 10))
    for x in frame[unused]:
        canvas.mark(axes.canvas_px(x, y[0]) - (0, TEXT_PX / 2), "cross", TEXT_PX / 4, REFUSED)
