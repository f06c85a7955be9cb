"""Pictures of a skyline by azimuth: of a terrain, measured in photographs, and both with the stars near them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from startrack.chain import Located
from startrack.core.types import Array, MeasuredSkyline
from startrack.evidence import Skyline
from startrack.output.picture.axes import GAP_PX, Axes, known_runs, nice_step
from startrack.output.picture.canvas import (
    CAPTION_SIZE,
    DIM_INK,
    FAINT_INK,
    FLOOR,
    HIDDEN,
    IDENTIFIED,
    INK,
    MAP,
    MEASURED,
    SKYLINE,
    TEXT_PX,
    Canvas,
    Colour,
    mix_colours,
    text_width,
)
from startrack.output.picture.maps import LEFT_PX
from startrack.output.picture.overlay import COMPASS
from startrack.output.record import image_name
from startrack.output.tables import half_range_rad, status_of
from startrack.terrain import Terrain

WIDTH_PX, HEIGHT_PX, ENLARGED_PX = 1440, 420, 300
ABOVE_PX, RIGHT_PX = 2 * TEXT_PX, CAPTION_SIZE  # about a plot
LEGEND_PX = CAPTION_SIZE - 1.0
AZIMUTHS_RAD = np.radians(np.linspace(0.0, 360.0, 3601))
MAX_STARS = 1500  # the brightest
BANDS = {source: mix_colours(colour, MAP, 0.7) for source, colour in
         (("sky light", MEASURED), ("stars", IDENTIFIED), ("both", SKYLINE))}  # fmt: skip
LEGEND = {"seen": "seen star", "hidden": "hidden star", "sky light": "skyline by the light of the sky",
          "stars": "by stars seen and missing", "both": "by both"}  # fmt: skip


@dataclass(frozen=True)
class Plot(Axes):
    """Axes of azimuth from north to north to the right, and of elevations upwards [rad]."""

    def draw_scales(self, step: float) -> None:
        """Lines at even elevations, `step` [deg] apart, ticks and names of azimuths, the frame."""
        decimals = max(0, -int(np.floor(np.log10(step) + 1e-9)))
        low, high = (round(float(end) / step) for end in np.degrees(self.y))
        elevations = np.arange(low, high + 1) * step
        self.draw_rows(np.radians(elevations), [f"{one:.{decimals}f}°" for one in elevations], FAINT_INK)
        azimuths = range(0, 361, 30)
        self.draw_columns(np.radians(azimuths), [COMPASS.get(one % 360, f"{one}°") for one in azimuths], 6.0)
        self.canvas.rectangle(self.box, FAINT_INK, 1)

    def draw_ground(self, azimuth_rad: Array, elevation_rad: Array) -> None:
        """The ground below elevations (n,) at ascending azimuths (n,), where they are known."""
        for run in known_runs(np.isfinite(elevation_rad)):
            at = azimuth_rad[run]
            low = self.canvas_px(np.array([at[-1], at[0]]), self.y[0])
            self.window.area(np.concatenate([self.canvas_px(at, elevation_rad[run]), low]), FLOOR)

    def draw_line(self, azimuth_rad: Array, elevation_rad: Array, sigma_rad: Array | None = None) -> None:
        """A skyline (n,) at ascending azimuths (n,), where it is known; `sigma_rad` (n,) as two thin lines."""
        for run in known_runs(np.isfinite(elevation_rad)):
            at, top = azimuth_rad[run], elevation_rad[run]
            if sigma_rad is not None:
                for shift in (-sigma_rad[run], sigma_rad[run]):
                    self.window.line(self.canvas_px(at, top + shift), FAINT_INK)
            self.window.curve(self.canvas_px(at, top), SKYLINE, 2.0)

    def draw_bands(self, elevation_rad: Array, skyline: MeasuredSkyline) -> None:
        """One sigma of a `skyline` to either side of `elevation_rad` (n,), coloured by its source."""
        half_rad, window = np.pi / max(len(skyline), 1), self.window
        for k in np.flatnonzero(skyline.known):
            ends = elevation_rad[k] + np.array([1.0, -1.0]) * skyline.sigma_rad[k]
            corners = self.canvas_px(skyline.azimuth_rad[k] + np.array([-half_rad, half_rad]), ends)
            (left, top), (right, bottom) = corners.tolist()
            window.rectangle((left, top, right, bottom), BANDS[str(skyline.source[k])])

    def draw_marks(self, azimuth_rad: Array, elevation_rad: Array, kinds: NDArray[np.str_]) -> None:
        """Marks of LEGEND's `kinds` (n,) in directions (n,), without those that are not known or have another kind."""
        window = self.window
        for place, kind in zip(self.canvas_px(azimuth_rad, elevation_rad), kinds.tolist(), strict=True):
            if kind in LEGEND and np.isfinite(place).all():
                _draw_mark(window, place, kind)


def horizon_picture(terrain: Terrain, position_m: tuple[float, float]) -> NDArray[np.uint8]:
    """The horizon (H, W, 3) of a `terrain` from north to north, azimuth to the right, seen from `position_m`."""
    horizon_rad = terrain.horizon_rad(np.array(position_m)[None], AZIMUTHS_RAD)
    title = f"{terrain.name}: horizon seen from E {position_m[0]:.0f} m, N {position_m[1]:.0f} m"
    canvas = Canvas(WIDTH_PX, HEIGHT_PX)
    _draw_horizon(canvas, title, AZIMUTHS_RAD, horizon_rad).draw_line(AZIMUTHS_RAD, horizon_rad)
    return canvas.rendered_pixels()


def skyline_picture(skyline: MeasuredSkyline) -> NDArray[np.uint8]:
    """A measured `skyline` (H, W, 3) from north to north, with one sigma to either side."""
    azimuth_rad = np.append(skyline.azimuth_rad, 2 * np.pi)
    elevation_rad, sigma_rad = (np.append(a, a[0]) for a in (skyline.elevation_rad, skyline.sigma_rad))
    canvas = Canvas(WIDTH_PX, HEIGHT_PX)
    plot = _draw_horizon(canvas, "measured skyline", azimuth_rad, elevation_rad)
    plot.draw_line(azimuth_rad, elevation_rad, sigma_rad)
    return canvas.rendered_pixels()


def located_picture(value: Located, skyline: MeasuredSkyline) -> NDArray[np.uint8]:
    """The `skyline` (H, W, 3) of a located image on the horizon of its terrain, and its height above that, enlarged."""
    canvas = Canvas(WIDTH_PX, HEIGHT_PX + ENLARGED_PX)
    horizon = Skyline.trace(value.position_at_time_m, value.terrain)
    light, status = value.light, status_of(value.light)
    decided = np.isin(status, ("seen", "hidden"))  # brightest first
    azimuth_rad, elevation_rad, status = light.azimuth_rad[decided], light.elevation_rad[decided], status[decided]
    title = f"{image_name(value.exposure)}: horizon of {value.terrain.name} at the position found, skyline of the image"
    plot = _draw_horizon(canvas, title, AZIMUTHS_RAD, horizon(AZIMUTHS_RAD))
    near = np.flatnonzero(elevation_rad < plot.y[1])[:MAX_STARS]
    plot.draw_marks(azimuth_rad[near], elevation_rad[near], status[near])
    plot.draw_line(AZIMUTHS_RAD, horizon(AZIMUTHS_RAD))
    plot.draw_marks(skyline.azimuth_rad, skyline.elevation_rad, skyline.source)

    raised_rad = skyline.elevation_rad - horizon(skyline.azimuth_rad)
    plot = _draw_enlarged(canvas, raised_rad, skyline)
    above_rad = elevation_rad - horizon(azimuth_rad)
    near = np.flatnonzero(np.abs(above_rad) < plot.y[1])[:MAX_STARS]
    plot.draw_marks(azimuth_rad[near], above_rad[near], status[near])
    plot.draw_marks(skyline.azimuth_rad, raised_rad, skyline.source)
    _draw_legend(canvas, HEIGHT_PX + ABOVE_PX / 2, [kind for kind in LEGEND if kind in {*status, *skyline.source}])
    return canvas.rendered_pixels()


def _draw_horizon(canvas: Canvas, title: str, azimuth_rad: Array, elevation_rad: Array) -> Plot:
    """A plot at the canvas's top with the ground below elevations (n,) at ascending azimuths (n,)."""
    known = np.degrees(elevation_rad[np.isfinite(elevation_rad)])
    low, high = min(float(known.min(initial=0.0)), 0.0), float(known.max(initial=0.0))
    step = nice_step(max(high - low, 2.0) / 3)
    low, high = np.floor(low / step) * step, np.ceil((high + 0.3 * step) / step) * step
    plot = _draw_plot(canvas, 0, title, low, high)
    plot.draw_ground(azimuth_rad, elevation_rad)
    plot.draw_scales(step)
    return plot


def _draw_enlarged(canvas: Canvas, raised_rad: Array, skyline: MeasuredSkyline) -> Plot:
    """A plot below that of the horizon: the heights (n,) of the `skyline` above it, with their sigma."""
    half = np.degrees(half_range_rad(raised_rad, skyline.sigma_rad))
    step = nice_step(half / 2)
    half = np.ceil(half / step - 1e-9) * step
    plot = _draw_plot(canvas, HEIGHT_PX, "enlarged: height above that horizon", -half, half)
    plot.draw_ground(np.array([0.0, 2 * np.pi]), np.zeros(2))
    plot.draw_bands(raised_rad, skyline)
    plot.draw_scales(step)
    plot.draw_line(np.array([0.0, 2 * np.pi]), np.zeros(2))
    return plot


def _draw_plot(canvas: Canvas, top: float, title: str, low: float, high: float) -> Plot:
    """An empty plot from `top` on, of elevations from `low` to `high` [deg], with its title."""
    height = HEIGHT_PX if top == 0 else ENLARGED_PX
    box = (LEFT_PX, top + ABOVE_PX, WIDTH_PX - RIGHT_PX, top + height - 5 * GAP_PX)
    canvas.rectangle(box, MAP)
    canvas.text((box[0], top + 9.0), title, TEXT_PX, INK, "lt")
    return Plot(canvas, box, (0.0, 2 * np.pi), (np.radians(low), np.radians(high)))


def _draw_mark(canvas: Canvas, place: Array, kind: str) -> None:
    """The mark of one of LEGEND's kinds: each has its own shape."""
    if kind == "hidden":
        canvas.cross(place, 2.5, HIDDEN)
    elif kind == "seen":
        _draw_polygon(canvas, place, 2.3, 12, IDENTIFIED)
    elif kind == "sky light":
        canvas.circle(place, 1.5, MEASURED, -1)
    else:
        _draw_polygon(canvas, place, 4.0, 4, MEASURED, filled=kind == "both")


def _draw_polygon(
    canvas: Canvas, place: Array, radius: float, count: int, colour: Colour, *, filled: bool = True
) -> None:
    """A regular polygon of `count` corners, one of them on top."""
    turn = np.arange(count) * 2 * np.pi / count
    corners = place + radius * np.stack([np.sin(turn), -np.cos(turn)], axis=-1)
    if filled:
        canvas.area(corners, colour)
    else:
        canvas.line(corners, colour, closed=True)


def _draw_legend(canvas: Canvas, y: float, kinds: list[str]) -> None:
    """Marks and words in one line that ends at the plot's right edge."""
    x = WIDTH_PX - RIGHT_PX
    for kind in reversed(kinds):
        x -= text_width(LEGEND[kind], LEGEND_PX)
        canvas.text((x, y), LEGEND[kind], LEGEND_PX, DIM_INK, "lm")
        _draw_mark(canvas, np.array([x - 11.0, y]), kind)
        x -= 36.0
