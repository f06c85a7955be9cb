"""Pictures of a skyline by azimuth: of a terrain, measured in photographs, and both with the stars near them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from startrack.chain import Measured, Positioned
from startrack.core.types import Array, MeasuredSkyline
from startrack.evidence import Skyline
from startrack.output.picture.canvas import (
    GAP_PX,
    TEXT_PX,
    Axes,
    Canvas,
    Colour,
    Ink,
    known_runs,
    mix_colours,
    multiples,
    nice_step,
    text_box,
    text_width,
)
from startrack.output.picture.maps import MARGIN_PX, draw_overview, draw_zoom
from startrack.output.picture.marks import COMPASS
from startrack.output.record import image_name
from startrack.output.tables import half_range_rad, status_of
from startrack.terrain import Terrain

WIDTH_PX = 90 * round(TEXT_PX)
HEIGHT_PX, ENLARGED_PX = 3 * WIDTH_PX // 10, 2 * WIDTH_PX // 10  # of both plots
MAPS_PX = 4 * WIDTH_PX // 10  # of two maps below them
ABOVE_PX, RIGHT_PX = 2 * TEXT_PX, TEXT_PX  # about a plot
AZIMUTHS_RAD = np.radians(np.linspace(0.0, 360.0, 3601))
UNKNOWN = mix_colours(Ink.HIDDEN, Ink.PAPER, 0.75)
UNKNOWN_WORDS = "brown: the maps end, and ground beyond could stand so high"
UNSEEN_WORDS, HATCH_PX = "not seen", 9.0  # of azimuths without a skyline; between the lines
MAX_STARS = 1500  # the brightest
LEGEND: dict[str, tuple[str, str, float, Colour]] = {  # words, mark, half its size, colour
    "seen": ("seen star", "disc", 2.3, Ink.IDENTIFIED),
    "hidden": ("hidden star", "cross", 2.5, Ink.HIDDEN),
    "sky light": ("skyline by the light of the sky", "disc", 1.5, Ink.MEASURED),
    "stars": ("by stars seen and missing", "diamond", 4.0, Ink.MEASURED),
    "file": ("measured skyline", "disc", 1.5, Ink.MEASURED),
    "both": ("by both", "square", 4.0, Ink.MEASURED),
    "varies": ("differs between the pictures", "cross", 2.5, Ink.HIDDEN),
}
BANDS = {"sky light": Ink.MEASURED, "file": Ink.MEASURED, "stars": Ink.IDENTIFIED, "both": Ink.SKYLINE}


# Azimuths (W,) and elevations (H,) [rad] to levels of grey (H, W), nan where there is none.
Photograph = Callable[[Array, Array], Array]


@dataclass(frozen=True)
class Plot(Axes):
    """Axes of azimuth from north to north to the right, and of elevations upwards [rad]."""

    def draw_degrees(self, step: float) -> None:
        """Lines at even elevations, `step` [deg] apart, and at azimuths, with their names; the frame."""
        decimals = max(0, -int(np.floor(np.log10(step) + 1e-9)))
        elevations, azimuths = multiples(np.degrees(self.y[0]), np.degrees(self.y[1]), step), range(0, 361, 30)
        self.draw_rows(np.radians(elevations), [f"{one:.{decimals}f}°" for one in elevations])
        self.draw_columns(np.radians(azimuths), [COMPASS.get(one % 360, f"{one}°") for one in azimuths])
        self.canvas.rectangle(self.box, Ink.FAINT, 1)

    def draw_ground(self, azimuth_rad: Array, elevation_rad: Array) -> None:
        """The ground below elevations (n,) at ascending azimuths (n,), where they are known."""
        for run in known_runs(np.isfinite(elevation_rad)):
            at = azimuth_rad[run]
            low = self.canvas_px(np.array([at[-1], at[0]]), self.y[0])
            self.window.area(np.concatenate([self.canvas_px(at, elevation_rad[run]), low]), Ink.FLOOR)

    def draw_photograph(self, photograph: Photograph) -> None:
        """The directions of the box in a `photograph`, in its levels of grey."""
        pixels = self.window.pixels
        (low, high), (rows, columns) = self.y, pixels.shape[:2]
        across, down = ((np.arange(count) + 0.5) / count for count in (columns, rows))
        grey = photograph(2 * np.pi * across, high - (high - low) * down)
        shown = np.isfinite(grey)
        pixels[shown] = np.rint(grey[shown]).astype(np.uint8)[:, None]

    def draw_unseen(self, azimuth_rad: Array, unseen: NDArray[np.bool_]) -> None:
        """Hatch the azimuths (n,), in ascending order, that are `unseen` (n,); with the words where there is room."""
        window, (_, top, _, bottom) = self.window, self.box
        for run in known_runs(unseen):
            left, right = self.canvas_px(azimuth_rad[[run.start, run.stop - 1]], self.y[0])[:, 0]
            band = self.canvas.window((left, top, right, bottom))
            for start in np.arange(left - (bottom - top), right, HATCH_PX):
                band.line([(start, bottom), (start + bottom - top, top)], Ink.FAINT)
            if right - left > text_width(UNSEEN_WORDS, TEXT_PX) + TEXT_PX:
                middle = (left + right) / 2, top + TEXT_PX
                window.rectangle(text_box(middle, UNSEEN_WORDS, "mt", TEXT_PX), Ink.PAPER)
                self.canvas.text(middle, UNSEEN_WORDS, Ink.PLAIN, "mt", halo=True)

    def draw_unknown(self, azimuth_rad: Array, low_rad: Array, high_rad: Array) -> None:
        """Elevations from `low_rad` (n,) up to `high_rad` (n,), at ascending azimuths (n,), where that is higher."""
        for run in known_runs(high_rad > low_rad):
            at, top = azimuth_rad[run], np.minimum(high_rad[run], self.y[1])
            below = self.canvas_px(at[::-1], np.minimum(low_rad[run][::-1], top[::-1]))
            self.window.area(np.concatenate([self.canvas_px(at, top), below]), UNKNOWN)

    def draw_bands(self, elevation_rad: Array, skyline: MeasuredSkyline) -> None:
        """One sigma of a `skyline` to either side of `elevation_rad` (n,), coloured by its source."""
        half_rad, window = np.pi / max(len(skyline), 1), self.window
        for k in np.flatnonzero(skyline.known):
            ends = elevation_rad[k] + np.array([1.0, -1.0]) * skyline.sigma_rad[k]
            (left, top), (right, bottom) = self.canvas_px(skyline.azimuth_rad[k] + [-half_rad, half_rad], ends)
            colour = mix_colours(BANDS[str(skyline.source[k])], Ink.PAPER, 0.7)
            window.rectangle((left, top, right, bottom), colour)

    def draw_marks(self, azimuth_rad: Array, elevation_rad: Array, kinds: NDArray[np.str_]) -> None:
        """Marks of LEGEND's `kinds` (n,) in directions (n,), without those that are not known or have another kind."""
        window = self.window
        for place, kind in zip(self.canvas_px(azimuth_rad, elevation_rad), kinds.tolist(), strict=True):
            if kind in LEGEND and np.isfinite(place).all():
                window.mark(place, *LEGEND[kind][1:], width=1)


def horizon_picture(terrain: Terrain, position_m: tuple[float, float]) -> NDArray[np.uint8]:
    """The horizon (H, W, 3) of a `terrain` from north to north, azimuth to the right, seen from `position_m`."""
    horizon_rad = terrain.horizon_rad(np.array(position_m)[None], AZIMUTHS_RAD)
    title = f"{terrain.name}: horizon seen from E {position_m[0]:.0f} m, N {position_m[1]:.0f} m"
    canvas = Canvas(WIDTH_PX, HEIGHT_PX)
    unknown_rad = terrain.unknown_below_rad(AZIMUTHS_RAD)
    plot = _draw_horizon(canvas, title, AZIMUTHS_RAD, horizon_rad, unknown_rad, from_level=False)
    plot.draw_curve(AZIMUTHS_RAD, horizon_rad, Ink.SKYLINE)
    return canvas.rendered_pixels()


def skyline_picture(skyline: MeasuredSkyline, photograph: Photograph | None = None) -> NDArray[np.uint8]:
    """A measured `skyline` (H, W, 3) from north to north, with one sigma to either side.

    Behind it is the `photograph`, if there is one. Azimuths without a skyline are hatched.
    """
    azimuth_rad = np.append(skyline.azimuth_rad, 2 * np.pi)
    elevation_rad, sigma_rad = (np.append(a, a[0]) for a in (skyline.elevation_rad, skyline.sigma_rad))
    canvas = Canvas(WIDTH_PX, HEIGHT_PX)
    varies = np.where(skyline.source == "varies", "varies", "")
    title = f"measured skyline{'; crossed: it ' + LEGEND['varies'][0] if (varies != '').any() else ''}"
    plot = _draw_horizon(canvas, title, azimuth_rad, elevation_rad, photograph=photograph)
    plot.draw_unseen(azimuth_rad, ~np.isfinite(elevation_rad))
    for run in known_runs(np.isfinite(elevation_rad)):
        for shift in (-sigma_rad[run], sigma_rad[run]):
            plot.window.line(plot.canvas_px(azimuth_rad[run], elevation_rad[run] + shift), Ink.FAINT)
    plot.draw_curve(azimuth_rad, elevation_rad, Ink.SKYLINE)
    plot.draw_marks(skyline.azimuth_rad, skyline.elevation_rad, varies)
    return canvas.rendered_pixels()


def located_picture(value: Positioned, skyline: MeasuredSkyline) -> NDArray[np.uint8]:
    """The `skyline` (H, W, 3) of a located image on the horizon of its terrain, and its height above that, enlarged.

    Without stars maps of the position stand below.
    """
    has_stars = isinstance(value, Measured)
    canvas = Canvas(WIDTH_PX, HEIGHT_PX + ENLARGED_PX + (0 if has_stars else MAPS_PX))
    horizon = Skyline.trace(value.fix.compared_at_m, value.terrain)
    if isinstance(value, Measured):
        light, status = value.photometry, status_of(value.photometry)
        decided = np.isin(status, ("seen", "hidden"))  # brightest first
        azimuth_rad, elevation_rad, status = light.azimuth_rad[decided], light.elevation_rad[decided], status[decided]
    else:
        azimuth_rad, elevation_rad, status = np.zeros(0), np.zeros(0), np.zeros(0, dtype="U1")
        _draw_maps(canvas, value)
    title = f"{image_name(value.exposure)}: horizon of {value.terrain.name} at the position found, skyline of the image"
    unknown_rad = value.terrain.unknown_below_rad(AZIMUTHS_RAD)
    plot = _draw_horizon(canvas, title, AZIMUTHS_RAD, horizon(AZIMUTHS_RAD), unknown_rad)
    near = np.flatnonzero(elevation_rad < plot.y[1])[:MAX_STARS]
    plot.draw_marks(azimuth_rad[near], elevation_rad[near], status[near])
    plot.draw_curve(AZIMUTHS_RAD, horizon(AZIMUTHS_RAD), Ink.SKYLINE)
    plot.draw_marks(skyline.azimuth_rad, skyline.elevation_rad, skyline.source)

    raised_rad = skyline.elevation_rad - horizon(skyline.azimuth_rad)
    half = np.degrees(half_range_rad(raised_rad, skyline.sigma_rad))
    step = nice_step(half / 2)
    half = np.ceil(half / step - 1e-9) * step
    plot = _empty_plot(canvas, HEIGHT_PX, "enlarged: height above that horizon; bars: one sigma", -half, half)
    ends_rad = np.array([0.0, 2 * np.pi])
    plot.draw_ground(ends_rad, np.zeros(2))
    plot.draw_unknown(AZIMUTHS_RAD, np.zeros(len(AZIMUTHS_RAD)), unknown_rad - horizon(AZIMUTHS_RAD))
    plot.draw_bands(raised_rad, skyline)
    plot.draw_degrees(step)
    plot.draw_curve(ends_rad, np.zeros(2), Ink.SKYLINE)
    above_rad = elevation_rad - horizon(azimuth_rad)
    near = np.flatnonzero(np.abs(above_rad) < plot.y[1])[:MAX_STARS]
    plot.draw_marks(azimuth_rad[near], above_rad[near], status[near])
    plot.draw_marks(skyline.azimuth_rad, raised_rad, skyline.source)
    x, y = WIDTH_PX - RIGHT_PX, HEIGHT_PX + ABOVE_PX / 2  # the legend ends at the plot's right edge
    for kind in (kind for kind in reversed(LEGEND) if kind in {*status, *skyline.source}):
        words, *_ = LEGEND[kind]
        x -= text_width(words, TEXT_PX) + TEXT_PX
        canvas.text((x + TEXT_PX, y), words, anchor="lm")
        canvas.mark((x, y), *LEGEND[kind][1:], width=1)
        x -= TEXT_PX
    return canvas.rendered_pixels()


def _draw_maps(canvas: Canvas, value: Positioned) -> None:
    """The search area and, of a single position with a circle, its surroundings, below the plots."""
    top, side = HEIGHT_PX + ENLARGED_PX, MAPS_PX - GAP_PX
    draw_overview(canvas, (MARGIN_PX, top, MARGIN_PX + side, top + side), value.terrain, value.fix)
    if not value.fix.ambiguous:
        right = WIDTH_PX - RIGHT_PX
        draw_zoom(canvas, (right - side, top, right, top + side), value.fix, None)


def _draw_horizon(
    canvas: Canvas,
    title: str,
    azimuth_rad: Array,
    elevation_rad: Array,
    unknown_rad: Array | None = None,
    photograph: Photograph | None = None,
    from_level: bool = True,
) -> Plot:
    """A plot at the canvas's top with the ground below elevations (n,) at ascending azimuths (n,).

    Above it what ground off the maps could hide, up to `unknown_rad` (n,). A `photograph` covers both. The plot begins
    at elevation 0 or lower if it is `from_level`, else below the lowest elevation.
    """
    if unknown_rad is not None and (unknown_rad > elevation_rad).any():
        title += f"; {UNKNOWN_WORDS}"
    known = np.degrees(elevation_rad[np.isfinite(elevation_rad)])
    low, high = float(known.min(initial=0.0)), float(known.max(initial=0.0))
    if not from_level and known.size:
        low, high = float(known.min()), float(known.max())
        low -= 0.3 * max(high - low, 2.0)
    step = nice_step(max(high - low, 2.0) / 3)
    low, high = np.floor(low / step) * step, np.ceil((high + 0.3 * step) / step) * step
    plot = _empty_plot(canvas, 0, title, low, high)
    plot.draw_ground(azimuth_rad, elevation_rad)
    if unknown_rad is not None:
        plot.draw_unknown(azimuth_rad, elevation_rad, unknown_rad)
    if photograph is not None:
        plot.draw_photograph(photograph)
    plot.draw_degrees(step)
    return plot


def _empty_plot(canvas: Canvas, top: float, title: str, low: float, high: float) -> Plot:
    """A plot from `top` on, of elevations from `low` to `high` [deg], with its title."""
    height = HEIGHT_PX if top == 0 else ENLARGED_PX
    box = (MARGIN_PX, top + ABOVE_PX, WIDTH_PX - RIGHT_PX, top + height - 5 * GAP_PX)
    canvas.text((box[0], top + GAP_PX), title, Ink.PLAIN, "lt")
    return Plot(canvas, box, (0.0, 2 * np.pi), (np.radians(low), np.radians(high)))
