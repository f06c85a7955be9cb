"""Draws four of the pictures of docs/idea.md from the sample near-wall.png; the fifth is `make_pictures.py posterior`.

    python docs/make_idea.py

Needs the extra `plots`.
"""

from __future__ import annotations

from io import BytesIO
from typing import Any

import matplotlib
import numpy as np
from astropy.table import Table
from PIL import Image

from startrack.core.types import Array
from startrack.output.picture.annotate import Layers

matplotlib.use("Agg")
from make_hero import (
    DARK,
    EDGE,
    FAINTEST_RING,
    HIDDEN,
    NAMED_SEEN,
    PLACE,
    SEEN,
    WALL,
    draw_wall,
    locate_sample,
    write_name,
)  # fmt: skip
from make_pictures import save_webp
from matplotlib import patheffects
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import Polygon

CROP_PX = (230.0, 930.0, 620.0, 1090.0)  # left, right, top, bottom of the part that shows hidden stars
WIDTH_PX = 900
FAINTEST_SHOWN = 5.5  # magnitude of stars with a mark in that part
FAINTEST_ON_SPHERE = 4.5
EYE = np.array([0.75, 0.45, 0.48])  # towards the reader of the drawn sphere, in the camera's axes
ROVER_KM, RIM_KM, DEEP_KM = -8.3, 10.0, 2.0  # of the sample, seen from the south-west; its crater


def main() -> None:
    """Draw and store the pictures."""
    solution, layers, stars = locate_sample()
    store("idea-1-crater", draw_crater, layers)
    store("idea-2-stars", draw_stars, layers, stars)
    store("idea-3-attitude", draw_sphere, solution)
    store("idea-4-hidden", draw_hidden, layers, stars)


def store(name: str, draw: Any, *values: Any) -> None:
    """Store the figure that `draw` returns."""
    figure, stored = draw(*values), BytesIO()
    figure.savefig(stored, dpi=100, facecolor=DARK)
    plt.close(figure)
    save_webp(Image.open(stored), name, width_px=WIDTH_PX)


def draw_crater(layers: Layers) -> Any:
    """Section of the crater with sight lines, and the picture from its floor."""
    figure = plt.figure(figsize=(9.0, 4.2), facecolor=DARK)
    axes = figure.add_axes((0.0, 0.0, 0.53, 1.0))
    ground = np.array([[-16.5, -2.5], [-16.5, DEEP_KM], [-RIM_KM, DEEP_KM], [-RIM_KM, 0.0], [RIM_KM, 0.0],
                       [RIM_KM, DEEP_KM], [13.5, DEEP_KM], [13.5, -2.5]])  # fmt: skip
    axes.add_patch(Polygon(ground, closed=True, facecolor=WALL, edgecolor=EDGE, lw=1.5))
    for degrees, colour in ((20.0, SEEN), (45.0, SEEN), (80.0, SEEN), (112.0, SEEN), (147.0, HIDDEN), (161.0, HIDDEN)):
        draw_sight_line(axes, np.radians(degrees), colour)
    axes.plot(ROVER_KM, 0.25, "o", color=PLACE, ms=9, mec="white", mew=1.2)
    axes.text(ROVER_KM + 0.7, 0.35, "rover", color="white", fontsize=14)
    axes.text(3.2, -1.6, "crater floor", color="#c9b8a8", fontsize=14, style="italic")
    axes.set(xlim=(-16.5, 13.5), ylim=(-2.5, 10.1), aspect="equal")
    axes.axis("off")
    sky = figure.add_axes((0.54, 0.0, 0.46, 1.0))
    sky.imshow(layers.bare, interpolation="lanczos")
    sky.axis("off")
    return figure


def draw_sight_line(axes: Axes, elevation_rad: float, colour: str) -> None:
    """From the rover to a star, dotted from where the wall hides it."""
    direction = np.array([np.cos(elevation_rad), np.sin(elevation_rad)])
    rover = np.array([ROVER_KM, 0.25])
    star, wall = rover + 7.9 * direction, rover + (-RIM_KM - ROVER_KM) / direction[0] * direction
    end = wall if colour == HIDDEN else star
    axes.plot(*np.stack([rover, end], axis=1), color=colour, lw=1.6)
    axes.plot(*np.stack([end, star], axis=1), color=colour, lw=1.2, ls=":")
    axes.plot(*star, marker="*", color=colour, ms=14, mew=0)


def draw_stars(layers: Layers, stars: Table) -> Any:
    """The picture with a ring about each identified star, and the names of some."""
    width, height = layers.overlay["size"]
    figure = plt.figure(figsize=(6.4, 6.4 * 0.86 / 0.76), facecolor=DARK)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.imshow(layers.bare, extent=(0, width, height, 0), interpolation="lanczos")
    found = stars[(stars["v_mag"] < FAINTEST_RING) & (stars["status"] == "seen")]
    axes.scatter(found["x_px"], found["y_px"], s=90, facecolors="none", edgecolors=SEEN, lw=1.4)
    for row in found:
        if str(row["name"]) in NAMED_SEEN:
            write_name(axes, str(row["name"]), row["x_px"], row["y_px"], "seen", 0.9 * width)
    axes.set(xlim=(0.24 * width, width), ylim=(0.93 * height, 0.07 * height))
    axes.axis("off")
    return figure


def draw_sphere(solution: Any) -> Any:
    """The sphere of the sky from outside with the part that the camera sees, and the camera's axes in it."""
    located = solution.result
    R_cam_icrs = located.attitude.R_cam_icrs
    eye = EYE / np.linalg.norm(EYE)
    right = np.cross([0.0, 0.0, 1.0], eye)
    right /= np.linalg.norm(right)
    to_view = np.stack([right, np.cross(eye, right), eye])  # right, up, towards the reader
    figure = plt.figure(figsize=(6.4, 5.6), facecolor=DARK)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    turn = np.linspace(0, 2 * np.pi, 361)
    axes.plot(np.cos(turn), np.sin(turn), color="#58606e", lw=1)
    for line in sky_grid():
        draw_line(axes, line @ R_cam_icrs.T @ to_view.T, "#3a4456", 0.8)
    rays = located.stars.rays_icrs[located.stars.v_mag < FAINTEST_ON_SPHERE] @ R_cam_icrs.T @ to_view.T
    star = located.identification.star
    named = located.stars.rays_icrs[star[located.stars.v_mag[star] < FAINTEST_ON_SPHERE]] @ R_cam_icrs.T @ to_view.T
    axes.scatter(*rays[rays[:, 2] > 0, :2].T, s=7, color="#9fb0c8", lw=0)
    axes.scatter(*named[named[:, 2] > 0, :2].T, s=26, facecolors="none", edgecolors=SEEN, lw=1.0)
    for axis, name in zip(np.eye(3), ("image right", "image down", "camera axis"), strict=True):
        tip = to_view @ axis
        axes.annotate("", tip[:2], (0, 0), arrowprops={"arrowstyle": "-|>", "color": PLACE, "lw": 2})
        axes.text(*(1.12 * tip[:2]), name, color="white", fontsize=14, ha="center", va="center",
                  path_effects=[patheffects.withStroke(linewidth=4, foreground=DARK)])  # fmt: skip
    axes.set(xlim=(-1.32, 1.32), ylim=(-1.12, 1.12), aspect="equal")
    axes.axis("off")
    return figure


def sky_grid() -> list[Array]:
    """Circles of right ascension each 30 degrees and of declination each 30, as rays (n, 3) in ICRS."""
    along = np.linspace(0, 2 * np.pi, 181)
    lines = [rays_of(np.full_like(along, ra), along) for ra in np.radians(np.arange(0, 180, 30))]
    return lines + [rays_of(along, np.full_like(along, dec)) for dec in np.radians(np.arange(-60, 90, 30))]


def rays_of(ra_rad: Array, dec_rad: Array) -> Array:
    """Unit vectors (n, 3) of right ascensions and declinations."""
    return np.stack([np.cos(dec_rad) * np.cos(ra_rad), np.cos(dec_rad) * np.sin(ra_rad), np.sin(dec_rad)], axis=-1)


def draw_line(axes: Axes, points: Array, colour: str, width: float) -> None:
    """The part of a line on the sphere (n, 3) that faces the reader."""
    front = np.where(points[:, 2:] > 0, points[:, :2], np.nan)
    axes.plot(*front.T, color=colour, lw=width)


def draw_hidden(layers: Layers, stars: Table) -> Any:
    """A part of the picture beside the skyline: stars that shine, and stars that do not."""
    left, right, top, bottom = CROP_PX
    figure = plt.figure(figsize=(9.0, 9.0 * (bottom - top) / (right - left)), facecolor=DARK)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    draw_wall(axes, layers)
    axes.set(xlim=(left, right), ylim=(bottom, top))
    shown = stars[stars["v_mag"] < FAINTEST_SHOWN]
    for status, marker, colour in (("seen", "o", SEEN), ("hidden", "x", HIDDEN)):
        rows = shown[shown["status"] == status]
        face = {"facecolors": "none", "edgecolors": colour} if marker == "o" else {"color": colour}
        axes.scatter(rows["x_px"], rows["y_px"], s=80, marker=marker, lw=1.6, **face)
    words = {"fontsize": 20, "style": "italic"}
    axes.text(left + 30, top + 40, "the wall", color="#c9b8a8", **words)
    axes.text(right - 30, top + 40, "the sky", color="#b9d6f5", ha="right", **words)
    axes.axis("off")
    return figure


if __name__ == "__main__":
    main()
