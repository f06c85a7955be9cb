"""Figures 3.3, 3.5, 3.6 and A.1: the starfield, whole, seen from the crater, and compared."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from startrack.applications.reproduction import published
from startrack.applications.reproduction.artefact import Artefact, Context, Picture
from startrack.applications.reproduction.drawing import (
    CENTRE,
    EDGE_COLOUR,
    OTHER_STAR,
    STAR,
    fisheye_axes,
    fisheye_points,
    new_figure,
)
from startrack.applications.reproduction.simulator import (
    Sky,
    crater,
    crater_edge,
    directions,
    star_count,
    visible_stars,
)
from startrack.core.types import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ALONG_KM = (-9.0, -6.0, -3.0, 0.0, 3.0, 6.0, 9.0, 9.9)  # positions of figure 3.3
EXAMPLE_M = np.array([5000.0, 2000.0])  # of figure 3.6, and the true position of figure 3.5
ESTIMATE_M = np.array([-3000.0, -1500.0])  # of figure 3.5: far from the true position, so that the vector is visible


def fig3_3(context: Context) -> Artefact:
    """Viewed starfields along the centreline."""
    sky = Sky.draw(context.seed, 0)
    points = sky.project_to_rim_plane(crater())
    counts = [int(visible_stars(points, np.array([1e3 * east, 0.0]), crater().radius_m).sum()) for east in ALONG_KM]
    caption = (
        "Figure 3.3: Viewed starfields at different positions along the centerline of the crater. The green line "
        "indicates the position of the edge. Fisheye picture (equidistant, the outer circle is the horizontal), east "
        f"to the right, {len(sky)} stars; the number in sight is given."
    )
    return Artefact.of_figure(
        "fig3.3", "Viewed starfields at different positions along the centerline of the crater",
        f"{max(counts)} to {min(counts)} of {len(sky)} stars in sight", Picture(partial(_draw_line, sky), caption),
        {"thesis": {}, "reproduced": {"in_sight": dict(zip(map(str, ALONG_KM), counts, strict=True))}},
    )  # fmt: skip


def fig3_5(context: Context) -> Artefact:
    """One step of the pseudo-gradient."""
    sky = Sky.draw(context.seed, 0)
    points, radius = sky.project_to_rim_plane(crater()), crater().radius_m
    views = [visible_stars(points, position, radius) for position in (ESTIMATE_M, EXAMPLE_M)]
    centres = np.stack([points[view].mean(axis=0) for view in views])
    step, wanted = centres[0] - centres[1], EXAMPLE_M - ESTIMATE_M
    angle = np.degrees(np.arctan2(wanted[0] * step[1] - wanted[1] * step[0], wanted @ step))
    caption = (
        "Figure 3.5: Example showing pseudo-gradient computation, on the plane of the rim. The red dots indicate the "
        f"centers of mass of the two views. The vector created from those points forms the pseudo-gradient: "
        f"{np.hypot(*step) / 1e3:.2f} km where {np.hypot(*wanted) / 1e3:.2f} km are wanted, {abs(angle):.1f} degrees "
        "off."
    )
    return Artefact.of_figure(
        "fig3.5", "Example showing pseudo-gradient computation",
        f"a step of {np.hypot(*step) / 1e3:.2f} km towards a position {np.hypot(*wanted) / 1e3:.2f} km away",
        Picture(partial(_draw_step, points, views, centres), caption),
        {"thesis": {}, "reproduced": {"step_m": step.tolist(), "wanted_m": wanted.tolist()}},
    )  # fmt: skip


def fig3_6(context: Context) -> Artefact:
    """The visible part of the starfield."""
    sky = Sky.draw(context.seed, 0)
    in_sight = int(visible_stars(sky.project_to_rim_plane(crater()), EXAMPLE_M, crater().radius_m).sum())
    caption = (
        "Figure 3.6: Example showing viewed starfield computation. The green line is the crater edge projected onto "
        f"the entire starfield. Stars within the crater edge are the viewed stars: {in_sight} of {len(sky)}."
    )
    return Artefact.of_figure(
        "fig3.6", "Example showing viewed starfield computation", f"{in_sight} of {len(sky)} stars in sight",
        Picture(partial(_draw_view, sky), caption), {"thesis": {}, "reproduced": {"in_sight": in_sight}},
    )  # fmt: skip


def fig_a1(context: Context) -> Artefact:
    """The whole starfield."""
    sky = Sky.draw(context.seed, 0)
    caption = (
        "Figure A.1: Simulation generated starfield for a magnitude 6 detection limit: (a) projected on the unit "
        f"hemisphere, (b) fisheye projection. {star_count(6.0)} stars (thesis: 2142)."
    )
    return Artefact.of_figure(
        "figA.1", "Simulation generated starfield for a magnitude 6 detection limit",
        f"{len(sky)} stars (thesis {published.STAR_COUNT})", Picture(partial(_draw_sky, sky), caption),
        {"thesis": {"stars": published.STAR_COUNT}, "reproduced": {"stars": len(sky)}},
    )  # fmt: skip


def _draw_line(sky: Sky) -> Figure:
    figure = new_figure(10.0, 5.9)
    cylinder, stars = crater(), fisheye_points(sky.azimuth_rad, sky.elevation_rad)
    points = sky.project_to_rim_plane(cylinder)
    for axes, east in zip(figure.subplots(2, 4).ravel(), ALONG_KM, strict=True):
        position = np.array([1e3 * east, 0.0])
        seen = visible_stars(points, position, cylinder.radius_m)
        axes.plot(*stars[seen].T, ".", color=STAR, markersize=1.6)
        axes.plot(*fisheye_points(*crater_edge(cylinder, position)).T, color=EDGE_COLOUR, linewidth=1.0)
        fisheye_axes(axes)
        axes.set_title(f"{east:g} km: {int(seen.sum())} stars", fontsize=9)
    return figure


def _draw_step(points_m: Array, views: list[Any], centres_m: Array) -> Figure:
    figure = new_figure(10.0, 4.2)
    titles = "Estimated view", "Observed view", "Both, and the vector (×4)"
    for k, (axes, title) in enumerate(zip(figure.subplots(1, 3), titles, strict=True)):
        for view, colour in ((views[0], "#e08214"), (views[1], "#2166ac")):
            if k == 2 or view is views[k]:
                both = views[0] & views[1]
                axes.plot(*(points_m[view & ~both] / 1e3).T, ".", color=colour, markersize=2.5)
                axes.plot(*(points_m[both] / 1e3).T, ".", color="0.6", markersize=1.2)
        shown = centres_m if k == 2 else centres_m[k : k + 1]
        axes.plot(*(shown / 1e3).T, "o", color=CENTRE, markersize=5)
        if k == 2:
            east, north = centres_m[1] / 1e3
            step = 4 * (centres_m[0] - centres_m[1]) / 1e3
            arrow = {"color": CENTRE, "width": 1.5, "headwidth": 7, "headlength": 7}
            axes.annotate("", (east + step[0], north + step[1]), (east, north), arrowprops=arrow)
        axes.set(aspect="equal", xlim=(-16, 16), ylim=(-14, 14), xlabel="east (km)")
        axes.set_title(title, fontsize=10)
    figure.axes[0].set_ylabel("north (km)")
    return figure


def _draw_view(sky: Sky) -> Figure:
    figure = new_figure(6.4, 6.8)
    axes, cylinder = figure.subplots(), crater()
    stars = fisheye_points(sky.azimuth_rad, sky.elevation_rad)
    seen = visible_stars(sky.project_to_rim_plane(cylinder), EXAMPLE_M, cylinder.radius_m)
    axes.plot(*stars[~seen].T, ".", color=OTHER_STAR, markersize=3)
    axes.plot(*stars[seen].T, ".", color=STAR, markersize=3)
    axes.plot(*fisheye_points(*crater_edge(cylinder, EXAMPLE_M)).T, color=EDGE_COLOUR, linewidth=1.5)
    fisheye_axes(axes)
    axes.set_title(f"{EXAMPLE_M[0] / 1e3:.0f} km east, {EXAMPLE_M[1] / 1e3:.0f} km north of the centre", fontsize=10)
    return figure


def _draw_sky(sky: Sky) -> Figure:
    figure = new_figure(6.4, 10.6)
    up = figure.add_subplot(2, 1, 1, projection="3d")
    level = np.cos(sky.elevation_rad)
    x, y = level * directions(sky.azimuth_rad).T
    up.plot(x, y, np.sin(sky.elevation_rad), ".", color=STAR, markersize=2)
    up.set(xlabel="east", ylabel="north", zlabel="up", zlim=(0, 1), box_aspect=(2, 2, 1))
    up.set_title("(a) Starfield projected on the unit hemisphere", fontsize=10)
    flat = figure.add_subplot(2, 1, 2)
    flat.plot(*fisheye_points(sky.azimuth_rad, sky.elevation_rad).T, ".", color=STAR, markersize=2)
    fisheye_axes(flat)
    flat.set_title("(b) Fisheye projection of the starfield", fontsize=10)
    return figure
