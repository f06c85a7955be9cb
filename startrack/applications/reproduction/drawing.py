"""Shared by the figures: matplotlib without global state, captions, fisheye pictures and maps of errors."""

from __future__ import annotations

import io
import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np

from startrack.applications.reproduction.simulator import DIAMETER_M, directions
from startrack.core.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 100
EDGE_COLOUR = "#1a9641"  # the thesis draws the crater's edge in green
STAR, OTHER_STAR = "#20304a", "#b9c0cc"
CENTRE = PUBLISHED = "#d7191c"  # and centres of mass in red
COLOURS = 128  # of a PNG's palette: enough for these drawings, at a third of the size


def new_figure(width_in: float, height_in: float) -> Figure:
    """An empty figure, without pyplot's global state."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width_in, height_in), dpi=DPI, layout="constrained")


def png_bytes(figure: Figure, caption: str) -> bytes:
    """The figure with its caption below, as a PNG with a palette; the same figure gives the same bytes."""
    from PIL import Image

    lines = textwrap.wrap(caption, int(13.7 * figure.get_figwidth()))
    figure.supxlabel("\n".join(lines), fontsize=9, x=0.02, ha="left")
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", metadata={"Software": None})
    picture = Image.open(drawn).convert("RGB").quantize(COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    packed = io.BytesIO()
    picture.save(packed, format="PNG", optimize=True)
    return packed.getvalue()


def fisheye_points(azimuth_rad: Array, elevation_rad: Array) -> Array:
    """Points (n, 2) of the picture: zenith distance in degrees times the horizontal direction, east to the right."""
    return np.degrees(np.pi / 2 - elevation_rad)[:, None] * directions(azimuth_rad)


def fisheye_axes(axes: Axes) -> None:
    """Equal scales, the horizon as a circle, and no tick labels, as in the thesis."""
    ring = 90.0 * directions(np.linspace(0.0, 2 * np.pi, 361))
    axes.plot(*ring.T, color="0.6", linewidth=0.7)
    axes.set(aspect="equal", xlim=(-93, 93), ylim=(-93, 93), xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set_visible(False)


def error_map(positions_m: Array, errors_m: Array, title: str) -> Figure:
    """Position errors over the crater's floor, point size and colour scaled to the error."""
    from matplotlib.patches import Circle

    figure = new_figure(7.0, 6.6)
    axes = figure.subplots()
    order = np.argsort(errors_m, kind="stable")  # the large ones on top
    share = errors_m[order] / errors_m.max()
    area = (0.6 + 28.0 * share**1.5) * min(2.0, (2e4 / len(order)) ** 0.5)
    east, north = positions_m[order].T / 1e3
    points = axes.scatter(east, north, s=area, c=errors_m[order], cmap="turbo", linewidths=0)
    radius = DIAMETER_M / 2e3
    axes.add_patch(Circle((0, 0), radius, fill=False, color="0.3", linewidth=0.8))
    axes.set(aspect="equal", xlim=(-1.03 * radius, 1.03 * radius), ylim=(-1.03 * radius, 1.03 * radius))
    axes.set(xlabel="east (km)", ylabel="north (km)")
    axes.set_title(title, fontsize=10)
    figure.colorbar(points, ax=axes, label="position error (m)", shrink=0.85)
    return figure


def mark_published(axes: Any, x: float, y: float, text: str) -> None:
    """Draw a value of the thesis as a red diamond with a legend entry."""
    axes.plot([x], [y], "D", color=PUBLISHED, markersize=6, label=text, zorder=5)
