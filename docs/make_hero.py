"""Draws the picture of the front page: the sample near-wall.png with few marks and large words, for a small size.

    python docs/make_hero.py

Needs the extra `plots`.
"""

from __future__ import annotations

import tempfile
from io import BytesIO
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from astropy.table import Table
from PIL import Image

import startrack
from startrack.core.types import Array
from startrack.output.picture.annotate import Layers, layers_of

matplotlib.use("Agg")
from make_pictures import SAMPLE, save_webp
from matplotlib import patheffects
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon

DARK, WALL, SEEN, HIDDEN, EDGE, PLACE = "#0b1018", "#33261d", "#35c79a", "#f39a2d", "#7cc4ff", "#ff7a3c"
FAINTEST_RING, FAINTEST_HIDDEN = 4.0, 3.2  # magnitudes
NAMED_SEEN = ("Canopus", "Achernar", "Rigil Kentaurus", "Acrux", "Peacock", "Alnair")
NAMED_HIDDEN = ("Sirius", "Rigel", "Betelgeuse", "Procyon")
ORION = (
    ("Betelgeuse", "Bellatrix"), ("Betelgeuse", "Alnitak"), ("Bellatrix", "Mintaka"), ("Mintaka", "Alnilam"),
    ("Alnilam", "Alnitak"), ("Alnitak", "Saiph"), ("Mintaka", "Rigel"), ("Saiph", "Rigel"),
)  # fmt: skip
WIDE, HIGH = 13.5, 9.0  # inches


def main() -> None:
    """Draw and store the picture."""
    solution, layers, stars = locate_sample()
    figure = plt.figure(figsize=(WIDE, HIGH), facecolor=DARK)
    draw_sky(figure.add_axes((0.0, 0.0, HIGH / WIDE, 1.0)), layers, stars)
    draw_map(figure.add_axes((0.69, 0.42, 0.29, 0.435)), solution)
    words = {"color": "#e9eef6", "ha": "center", "va": "center", "transform": figure.transFigure}
    radius_m = solution.position.radius95.to_value("m")
    figure.text(0.835, 0.30, f"±{radius_m:.1f} m", fontsize=64, weight="bold", **words)
    figure.text(0.835, 0.20, "95 % circle of the position", fontsize=20, **words)
    figure.text(0.835, 0.93, "a simulated crater of 20 km", fontsize=20, **words)
    stored = BytesIO()
    figure.savefig(stored, dpi=120, facecolor=DARK)
    save_webp(Image.open(stored), "hero", 1400, str(solution))


def locate_sample() -> tuple[startrack.Solution, Layers, Table]:
    """The solution of the sample, the layers of its annotated picture, and its table of stars."""
    solution = startrack.locate(SAMPLE)
    with tempfile.TemporaryDirectory() as folder:
        solution.write(folder)
        layers = layers_of((Path(folder) / "near-wall.annotated.png").read_bytes())
        stars = Table.read(Path(folder) / "near-wall.stars.ecsv")
    if layers is None:
        raise SystemExit("the annotated picture has no layers")
    return solution, layers, stars


def draw_sky(axes: Axes, layers: Layers, stars: Table) -> None:
    """The picture with the wall in one colour, bright stars, the figure of Orion behind the wall, and the skyline."""
    width, height = layers.overlay["size"]
    draw_wall(axes, layers)
    place = {str(row["name"]): (row["x_px"], row["y_px"], str(row["status"])) for row in stars if row["name"]}
    bright = stars[(stars["v_mag"] < FAINTEST_RING) & (stars["status"] == "seen")]
    axes.scatter(bright["x_px"], bright["y_px"], s=90, facecolors="none", edgecolors=SEEN, lw=1.4)
    dark = stars[(stars["v_mag"] < FAINTEST_HIDDEN) & (stars["status"] == "hidden")]
    axes.scatter(dark["x_px"], dark["y_px"], s=42, marker="x", color=HIDDEN, lw=1.6)
    for one, other in ORION:
        if one in place and other in place:
            axes.plot(*zip(place[one][:2], place[other][:2], strict=True), color=HIDDEN, lw=1.6, alpha=0.9)
    for name in NAMED_SEEN + NAMED_HIDDEN:
        if name in place:
            write_name(axes, name, *place[name], width)
    axes.text(40, 1215, "Orion,\nbehind the wall", color=HIDDEN, fontsize=20, weight="bold")
    axes.text(40, 90, "the wall", color="#c9b8a8", fontsize=24, style="italic")
    axes.text(1000, 830, "the sky", color="#b9d6f5", fontsize=24, style="italic")
    for azimuth, (_, _, (x, y)) in ((one[0], one[1:]) for one in layers.overlay["compass"]):
        if azimuth % 90 == 0:
            axes.text(x, y, "NESW"[azimuth // 90], color="white", fontsize=24, ha="center", va="center", weight="bold",
                      path_effects=[patheffects.withStroke(linewidth=4, foreground=DARK)])  # fmt: skip
    axes.set(xlim=(0, width), ylim=(height, 0))
    axes.axis("off")


def draw_wall(axes: Axes, layers: Layers) -> None:
    """The picture with all that lies below the skyline in one colour."""
    width, height = layers.overlay["size"]
    axes.imshow(layers.bare, extent=(0, width, height, 0), interpolation="lanczos")
    (skyline,) = layers.overlay["skyline"]
    edge = np.array(skyline)
    frame = np.array([[0, 0], [width, 0], [width, height], [0, height], [0, 0]])
    outside = np.vstack([frame, edge[::-1] if is_clockwise(edge) == is_clockwise(frame) else edge])
    axes.add_patch(Polygon(outside, closed=True, facecolor=WALL, alpha=0.82, lw=0))
    axes.plot(*edge.T, color=EDGE, lw=2.2)


def write_name(axes: Axes, name: str, x: float, y: float, status: str, width: float) -> None:
    """A star's name to its right, or to its left at the right edge."""
    is_right = x > 0.8 * width
    colour = "white" if status == "seen" else HIDDEN
    axes.text(x + (-26 if is_right else 26), y, name, color=colour, fontsize=17, va="center",
              ha="right" if is_right else "left",
              path_effects=[patheffects.withStroke(linewidth=3, foreground=DARK)])  # fmt: skip


def is_clockwise(points: Array) -> bool:
    """Whether the outline (n, 2) runs clockwise."""
    x, y = points.T
    return bool(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) > 0)


def draw_map(axes: Axes, solution: Any) -> None:
    """The crater from above with the rover."""
    east, north = solution.position.east.to_value("km"), solution.position.north.to_value("km")
    axes.add_patch(Circle((0, 0), 10.0, facecolor="#1a2432", edgecolor=EDGE, lw=2))
    axes.plot(east, north, "o", color=PLACE, ms=13, mec="white", mew=1.5)
    axes.annotate("rover", (east, north), (east + 1.2, north + 1.4), color="white", fontsize=20)
    axes.set(xlim=(-10.6, 10.6), ylim=(-10.6, 10.6), aspect="equal")
    axes.axis("off")


if __name__ == "__main__":
    main()
