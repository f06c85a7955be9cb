"""Figures 3.3, 3.5, 3.6 and A.1: the starfield, whole, seen from the crater, and compared."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from startrack.applications.reproduction.artefact import (
    CENTRE,
    EDGE_COLOUR,
    OTHER_STAR,
    STAR,
    Artefact,
    Context,
    fisheye_axes,
    fisheye_points,
)
from startrack.applications.reproduction.simulator import (
    THESIS,
    Sky,
    crater,
    crater_edge,
    directions,
    star_count,
    visible_stars,
)
from startrack.core.types import Array, Bools

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ALONG_KM = (-9.0, -6.0, -3.0, 0.0, 3.0, 6.0, 9.0, 9.9)  # positions of figure 3.3
EXAMPLE_M = np.array([5000.0, 2000.0])  # of figure 3.6, and the true position of figure 3.5
ESTIMATE_M = np.array([-3000.0, -1500.0])  # of figure 3.5: far from the true position, so that the vector is visible


def fig3_3(context: Context) -> Artefact:
    """Figure 3.3: viewed starfields along the centreline."""
    sky, positions = Sky.draw(context.seed, 0), [np.array([1e3 * east, 0.0]) for east in ALONG_KM]
    views = [_view(sky, position) for position in positions]
    counts = [int(view.sum()) for view in views]

    def draw(figure: Figure) -> None:
        for k, axes in enumerate(figure.subplots(2, 4).ravel()):
            _draw_view(axes, sky, positions[k], views[k], 1.6, 1.0)
            axes.set_title(f"{ALONG_KM[k]:g} km: {counts[k]} stars", fontsize=9)

    return Artefact.of_figure(
        "fig3.3", "Viewed starfields at different positions along the centerline of the crater",
        ". The green line indicates the position of the edge. Fisheye picture (equidistant, the outer circle is the "
        f"horizontal), east to the right, {len(sky)} stars; the number in sight is given.",
        f"{max(counts)} to {min(counts)} of {len(sky)} stars in sight", (10.0, 5.9), draw,
        {"thesis": {}, "reproduced": {"in_sight": dict(zip(map(str, ALONG_KM), counts, strict=True))}},
    )  # fmt: skip


def fig3_5(context: Context) -> Artefact:
    """Figure 3.5: one step of the pseudo-gradient."""
    sky = Sky.draw(context.seed, 0)
    points_km = sky.project_to_rim_plane(crater()) / 1e3
    views = [_view(sky, position) for position in (ESTIMATE_M, EXAMPLE_M)]
    centres = np.stack([points_km[view].mean(axis=0) for view in views])
    step, wanted = centres[0] - centres[1], (EXAMPLE_M - ESTIMATE_M) / 1e3
    angle = np.degrees(np.arctan2(wanted[0] * step[1] - wanted[1] * step[0], wanted @ step))

    def draw(figure: Figure) -> None:
        titles, both = ("Estimated view", "Observed view", "Both, and the vector (×4)"), views[0] & views[1]
        for k, (axes, title) in enumerate(zip(figure.subplots(1, 3), titles, strict=True)):
            for view, colour in ((views[0], "#e08214"), (views[1], "#2166ac")):
                if k == 2 or view is views[k]:
                    axes.plot(*points_km[view & ~both].T, ".", color=colour, markersize=2.5)
                    axes.plot(*points_km[both].T, ".", color="0.6", markersize=1.2)
            axes.plot(*(centres if k == 2 else centres[k : k + 1]).T, "o", color=CENTRE, markersize=5)
            axes.set(aspect="equal", xlim=(-16, 16), ylim=(-14, 14), xlabel="east (km)", title=title)
        arrow = {"color": CENTRE, "width": 1.5, "headwidth": 7, "headlength": 7}
        axes.annotate("", centres[1] + 4 * step, centres[1], arrowprops=arrow)
        figure.axes[0].set_ylabel("north (km)")

    return Artefact.of_figure(
        "fig3.5", "Example showing pseudo-gradient computation",
        ", on the plane of the rim. The red dots indicate the centers of mass of the two views. The vector created "
        f"from those points forms the pseudo-gradient: {np.hypot(*step):.2f} km where {np.hypot(*wanted):.2f} km are "
        f"wanted, {abs(angle):.1f} degrees off.",
        f"a step of {np.hypot(*step):.2f} km towards a position {np.hypot(*wanted):.2f} km away", (10.0, 4.2), draw,
        {"thesis": {}, "reproduced": {"step_m": (1e3 * step).tolist(), "wanted_m": (1e3 * wanted).tolist()}},
    )  # fmt: skip


def fig3_6(context: Context) -> Artefact:
    """Figure 3.6: the visible part of the starfield."""
    sky = Sky.draw(context.seed, 0)
    seen = _view(sky, EXAMPLE_M)
    in_sight = int(seen.sum())

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.plot(*_fisheye_stars(sky)[~seen].T, ".", color=OTHER_STAR, markersize=3)
        _draw_view(axes, sky, EXAMPLE_M, seen, 3, 1.5)
        axes.set_title("{:.0f} km east, {:.0f} km north of the centre".format(*EXAMPLE_M / 1e3))

    return Artefact.of_figure(
        "fig3.6", "Example showing viewed starfield computation",
        ". The green line is the crater edge projected onto the entire starfield. Stars within the crater edge are the "
        f"viewed stars: {in_sight} of {len(sky)}.",
        f"{in_sight} of {len(sky)} stars in sight", (6.4, 6.8), draw,
        {"thesis": {}, "reproduced": {"in_sight": in_sight}},
    )  # fmt: skip


def fig_a1(context: Context) -> Artefact:
    """Figure A.1: the whole starfield."""
    sky = Sky.draw(context.seed, 0)

    def draw(figure: Figure) -> None:
        up = figure.add_subplot(2, 1, 1, projection="3d")
        x, y = np.cos(sky.elevation_rad) * directions(sky.azimuth_rad).T
        up.plot(x, y, np.sin(sky.elevation_rad), ".", color=STAR, markersize=2)
        up.set(xlabel="east", ylabel="north", zlabel="up", zlim=(0, 1), box_aspect=(2, 2, 1))
        up.set_title("(a) Starfield projected on the unit hemisphere")
        flat = figure.add_subplot(2, 1, 2)
        flat.plot(*_fisheye_stars(sky).T, ".", color=STAR, markersize=2)
        fisheye_axes(flat)
        flat.set_title("(b) Fisheye projection of the starfield")

    return Artefact.of_figure(
        "figA.1", "Simulation generated starfield for a magnitude 6 detection limit",
        ": (a) projected on the unit hemisphere, (b) fisheye projection. "
        f"{star_count(6.0)} stars (thesis: 2142).",
        f"{len(sky)} stars (thesis 2142)", (6.4, 10.6), draw,
        {"thesis": {"stars": THESIS["stars"]}, "reproduced": {"stars": len(sky)}},
    )  # fmt: skip


def _view(sky: Sky, position_m: Array) -> Bools:
    """The stars (n,) in sight from a position (2,)."""
    return visible_stars(sky.project_to_rim_plane(crater()), position_m, crater().radius_m)


def _fisheye_stars(sky: Sky) -> Array:
    return fisheye_points(sky.azimuth_rad, sky.elevation_rad)


def _draw_view(axes: Axes, sky: Sky, position_m: Array, seen: Bools, size: float, width: float) -> None:
    """The stars in sight from a position, and the crater's edge."""
    axes.plot(*_fisheye_stars(sky)[seen].T, ".", color=STAR, markersize=size)
    axes.plot(*fisheye_points(*crater_edge(crater(), position_m)).T, color=EDGE_COLOUR, linewidth=width)
    fisheye_axes(axes)
