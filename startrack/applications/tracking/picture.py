"""The picture of a track: a map with its positions and ellipses, the search area, and the stated errors by frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from startrack.applications.tracking.track import Track
from startrack.applications.tracking.track_map import ODOMETRY, REFUSED, draw_track_map
from startrack.core.errors import length_text
from startrack.core.types import Array, Ints
from startrack.output import (
    CAPTION_SIZE,
    DIM_INK,
    FAINT_INK,
    GRID,
    INK,
    MAP,
    POSITION,
    SKY_BLUE,
    Box,
    Canvas,
    Colour,
    MapView,
    distance_text,
    draw_distances,
    draw_legend_sample,
    draw_overview,
    nice_step,
    wrap_text,
)

TITLE_SIZE, GRAPH_TEXT_SIZE = 1.5 * CAPTION_SIZE, CAPTION_SIZE - 1.0
TRACK_LEFT_PX, TOP_PX, TRACK_SIDE_PX, PANEL_PX = 70.0, 62.0, 860.0, 354.0  # of the map; width of the panel beside it
MAP_BOX: Box = (TRACK_LEFT_PX, TOP_PX, TRACK_LEFT_PX + TRACK_SIDE_PX, TOP_PX + TRACK_SIDE_PX)
PANEL: Box = (MAP_BOX[2] + 2 * CAPTION_SIZE, TOP_PX, MAP_BOX[2] + 2 * CAPTION_SIZE + PANEL_PX, MAP_BOX[3])
TRACK_WIDTH_PX, TRACK_HEIGHT_PX = round(PANEL[2] + TITLE_SIZE), 1240
GRAPH_TOP_PX, GRAPH_BOTTOM_PX = MAP_BOX[3] + 90.0, TRACK_HEIGHT_PX - 54.0
LOGARITHMIC = 8.0  # a scale whose ends have a larger ratio
TICKS = 20  # of frames, at most

Series = tuple[str, Array, Colour]  # name, and lengths (n,) [m], nan or infinite where not known


def draw_track(track: Track, odometry_m: Array | None = None) -> NDArray[np.uint8]:
    """The picture (H, W, 3), red, green, blue.

    A map of the smoothed track with the filtered positions and 95 % ellipses, enlarged where they would be too small;
    of a camera at rest, the position after each exposure. Beside it the search area, below it the stated 95 % radii.

    Args:
        track: with n frames.
        odometry_m: positions (n, 2) in enu by odometry alone, from the first smoothed position; None: not known.
    """
    canvas = Canvas(TRACK_WIDTH_PX, TRACK_HEIGHT_PX)
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
        for k, part in enumerate(wrap_text(line, CAPTION_SIZE, right - left)):
            canvas.text((left + (16 if k else 0), y), part, CAPTION_SIZE, INK if not k else DIM_INK)
            y += 1.45 * CAPTION_SIZE
    return y


def _draw_legend(canvas: Canvas, y: float, legend: list[tuple[str, Colour, str]]) -> None:
    left, _, right, _ = PANEL
    for kind, colour, words in legend:
        draw_legend_sample(canvas, left + 12, y - 5, kind, colour)
        for part in wrap_text(words, CAPTION_SIZE, right - left - 34):
            canvas.text((left + 34, y), part, CAPTION_SIZE, DIM_INK)
            y += 1.35 * CAPTION_SIZE
        y += 0.3 * CAPTION_SIZE


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


def draw_graph(
    canvas: Canvas, box: Box, caption: str, series: Sequence[Series], crossed: Ints, colour: Colour,
    logarithmic: bool = False,
) -> None:  # fmt: skip
    """Lengths [m] above the number of the frame, and a cross of the `colour` below each frame of `crossed`.

    `logarithmic`: where the lengths differ much.
    """
    left, top, right, bottom = box
    count = len(series[0][1])
    known = np.concatenate([values[np.isfinite(values) & (values >= 0)] for _, values, _ in series])
    canvas.rectangle(box, MAP)
    x = canvas.text((left, top - 9), caption, GRAPH_TEXT_SIZE, DIM_INK)[2]
    for name, of in [(name, of) for name, _, of in series] + [("x: frame not used", colour)] * (len(crossed) > 0):
        if name:
            x = canvas.text((x + 18, top - 9), name, GRAPH_TEXT_SIZE, of)[2]
    canvas.text(((left + right) / 2, bottom + 27), "frame", GRAPH_TEXT_SIZE, DIM_INK, "mt")
    if len(known) and known.max() > 0:
        logarithmic = logarithmic and known.min() > 0 and known.max() > LOGARITHMIC * known.min()
        scale = _logarithms if logarithmic else _lengths
        ticks_m, low, high = scale(known, (bottom - top) / (2 * GRAPH_TEXT_SIZE))
        x_of = left + (right - left) * (np.arange(count) + 0.5) / count

        def y_of(values_m: Array) -> Array:
            at = np.log10(np.maximum(values_m, 1e-9)) if logarithmic else values_m
            return np.asarray(bottom - (bottom - top) * (at - low) / (high - low))

        for value, y in zip(ticks_m, y_of(ticks_m), strict=True):
            canvas.line([(left, y), (right, y)], GRID)
            text = distance_text(float(value)) if value else "0"
            canvas.text((left - 8, y), text, GRAPH_TEXT_SIZE, DIM_INK, "rm")
        step = max(1, round(nice_step(max(2.0 * count / TICKS, 1.0))))
        for number in sorted({1, *range(step, count + 1, step)}):
            canvas.line([(x_of[number - 1], bottom), (x_of[number - 1], bottom + 5)], FAINT_INK)
            canvas.text((x_of[number - 1], bottom + 8), str(number), GRAPH_TEXT_SIZE, DIM_INK, "mt")
        for _, values, of in series:
            _draw_series(canvas.window(box), np.stack([x_of, y_of(values)], axis=-1), of)
        for k in crossed:
            canvas.cross((x_of[k], bottom - 9), 4.5, colour, 2)
    canvas.rectangle(box, FAINT_INK, 1)


def _lengths(known_m: Array, most: float) -> tuple[Array, float, float]:
    """Ticks [m] from zero, at most so many, and the ends of the scale."""
    high = 1.15 * float(known_m.max())
    return np.arange(0.0, high, nice_step(2.0 * high / most)), 0.0, high


def _logarithms(known_m: Array, most: float) -> tuple[Array, float, float]:
    """Ticks [m] at 1, 2, 5 times powers of ten, or at those powers alone, and the logarithms of the scale's ends."""
    low, high = np.log10(0.8 * float(known_m.min())), np.log10(1.25 * float(known_m.max()))
    decades = 10.0 ** np.arange(np.floor(low), np.ceil(high))
    for steps in ([1.0, 2.0, 5.0], [1.0]):
        ticks = np.outer(decades, steps).ravel()
        ticks = ticks[(np.log10(ticks) >= low) & (np.log10(ticks) <= high)]
        if len(ticks) <= most:
            break
    return ticks, float(low), float(high)


def _draw_series(window: Canvas, places: Array, colour: Colour) -> None:
    """A line, broken where a value is not known, with dots on it."""
    known = np.isfinite(places).all(axis=1)
    for run in np.split(places, np.flatnonzero(~known)):
        run = run[np.isfinite(run).all(axis=1)]
        if len(run) > 1:
            window.curve(run, colour, 2.2)
    for place in places[known]:
        window.circle(place, 3.0 if len(places) < 150 else 1.2, colour, -1)
