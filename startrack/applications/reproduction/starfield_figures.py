"""Figures 3.3 and 3.5 to 3.9, A.1 and A.2: starfields, how they differ from place to place, and aspect ratios."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from startrack.applications.reproduction.artefact import (
    CENTRE,
    EDGE_COLOUR,
    OTHER_STAR,
    PUBLISHED,
    STAR,
    Artefact,
    Context,
    fisheye_axes,
    fisheye_points,
)
from startrack.applications.reproduction.simulator import (
    ASPECT_RATIO,
    MAGNITUDE,
    STEP_M,
    THESIS,
    Sky,
    change_steps_m,
    changes_m,
    crater,
    crater_edge,
    directions,
    gaps_m,
    mean_gap_m,
    star_count,
    visible_stars,
)
from startrack.core.types import Array, Bools
from startrack.output import Column

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
if TYPE_CHECKING:
    from matplotlib.figure import Figure

ALONG_KM = (-9.0, -6.0, -3.0, 0.0, 3.0, 6.0, 9.0, 9.9)  # positions of figure 3.3
EXAMPLE_M = np.array([5000.0, 2000.0])  # of figure 3.6, and the true position of figure 3.5
ESTIMATE_M = np.array([-3000.0, -1500.0])  # of figure 3.5: far from the true position, so that the vector is visible
MAGNITUDES = np.arange(2.0, 7.01, 0.25)
ASPECT_RATIOS = np.logspace(-1, 3, 33)
VIEWS = f"views compared at every {STEP_M:.0f} m"


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


def fig3_7(context: Context) -> Artefact:
    """Figure 3.7: distance [m] between changes of the visible stars, against the faintest magnitude."""
    curves = np.array([_gaps(context, magnitude, ASPECT_RATIO) for magnitude in MAGNITUDES])
    six = curves[int(np.argmin(np.abs(MAGNITUDES - MAGNITUDE)))].mean(axis=0)
    detail = (
        f", {context.size.traverses} starfields (line: mean, band: all). At magnitude 6: mean {six[0]:.1f} m, thesis "
        f"14.9 m; largest {six[1]:.0f} m, thesis 215 m ({VIEWS}; every single change counted, the mean is "
        f"{six[2]:.1f} m)."
    )
    columns = (
        Column("magnitude", MAGNITUDES, form="%.6g"),
        Column("stars", [star_count(one) for one in MAGNITUDES], "int64", form="%d"),
    )

    def draw(figure: Figure) -> None:
        for axes in _draw_panels(figure, MAGNITUDES, curves, MAGNITUDE, (700.0, 7000.0)):
            axes.set(xlabel="Minimum Detected Magnitude", xticks=np.arange(MAGNITUDES[0], MAGNITUDES[-1] + 0.01, 0.5))
            axes.legend(loc="upper right")

    return _artefact("fig3.7", "Effects of changing the star detection limit", detail, draw, columns, curves, six)


def fig3_9(context: Context) -> Artefact:
    """Figure 3.9: distance [m] between changes of the visible stars, against the crater's diameter over its depth."""
    curves = np.array([_gaps(context, MAGNITUDE, ratio) for ratio in ASPECT_RATIOS])
    ten, widest = (_gaps(context, MAGNITUDE, ratio).mean(axis=0) for ratio in (ASPECT_RATIO, 50.0))
    detail = (
        f", {context.size.traverses} starfields (line: mean, band: all; {VIEWS}; dashed: every change counted). At "
        f"10:1 mean {ten[0]:.1f} m and largest {ten[1]:.0f} m (thesis 14.9 and 215 m); at 50:1 largest "
        f"{widest[1]:.0f} m (thesis: approximately 1 km)."
    )
    columns, tops = (Column("aspect_ratio", ASPECT_RATIOS, form="%.6g"),), (250.0, 8000.0)

    def draw(figure: Figure) -> None:
        for axes, top in zip(_draw_panels(figure, ASPECT_RATIOS, curves, ASPECT_RATIO, tops), tops, strict=True):
            axes.set(xscale="log", xlim=ASPECT_RATIOS[[0, -1]], xlabel="Crater Aspect Ratio (Diameter:Depth)")
            for ratio, text in ((5.0, "5:1"), (10.0, "Shackleton 10:1"), (50.0, "50:1")):
                axes.axvline(ratio, color="0.75", linewidth=0.8, zorder=0)
                axes.text(ratio, 0.62 * top, f" {text}", fontsize=8, rotation=90, va="top", ha="right", color="0.35")
            axes.legend(loc="upper center")

    return _artefact("fig3.9", "Effects of changing the crater aspect ratio", detail, draw, columns, curves, ten)


def fig3_8(context: Context) -> Artefact:
    """Figure 3.8: distance [m] between changes of the visible stars along one traverse."""
    cylinder = crater()
    changes = change_steps_m(changes_m(Sky.draw(context.seed, 0), cylinder), cylinder)
    gaps, middles = gaps_m(changes, cylinder), (changes[1:] + changes[:-1]) / 2
    inner, outer = (float(gaps[part].mean()) for part in (np.abs(middles) < 2000, np.abs(middles) > 8000))

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.plot(middles / 1e3, gaps, ".", color=STAR, markersize=3)
        largest = THESIS["gaps"]["max_m"]
        axes.axhline(largest, color=PUBLISHED, linewidth=0.8, linestyle="--", label=f"thesis: largest {largest:g} m")
        axes.set(xlim=(-10, 10), ylim=(0, max(250.0, 1.1 * gaps.max())), xlabel="Distance from center (km)")
        axes.set(ylabel="Distance (m)", title="Distances between appearing/disappearing stars during a crater traverse")
        axes.legend()

    return Artefact.of_figure(
        "fig3.8", "Plot of the distance between starfield changes along a crater traverse",
        f", one starfield, {VIEWS}. Largest {gaps.max():.0f} m (thesis 215 m); mean {inner:.1f} m within 2 km of the "
        f"centre, {outer:.1f} m beyond 8 km.",
        f"largest {gaps.max():.0f} m (thesis 215), {inner:.0f} m near the centre, {outer:.0f} m near the wall",
        (7.0, 4.8), draw,
        {
            "thesis": {"max_m": THESIS["gaps"]["max_m"]},
            "reproduced": {"max_m": float(gaps.max()), "mean_inner_m": inner, "mean_outer_m": outer},
        },
        columns=(
            Column("from_centre", middles, unit="m", form="%.1f", description="middle between two changes"),
            Column("distance", gaps, unit="m", form="%.1f", description="between the two changes"),
        ),
    )  # fmt: skip


def _gaps(context: Context, magnitude: float, aspect_ratio: float) -> Array:
    """Mean and largest distance between noticed changes, mean between all (skies, 3) [m]."""
    cylinder, rows = crater(aspect_ratio), []
    for sky in range(context.size.traverses):
        every = changes_m(Sky.draw(context.seed, sky, magnitude), cylinder)
        noticed = change_steps_m(every, cylinder)
        rows.append([mean_gap_m(noticed, cylinder), gaps_m(noticed, cylinder).max(), mean_gap_m(every, cylinder)])
    return np.array(rows)


def _artefact(
    name: str, title: str, detail: str, draw: Any, columns: tuple[Column, ...], curves: Array, standard: Array
) -> Artefact:
    means = zip(("mean_distance", "max_distance", "mean_distance_every_change"), curves.mean(axis=1).T, strict=True)
    return Artefact.of_figure(
        name, title, detail,
        f"under standard conditions mean {standard[0]:.1f} m (thesis 14.9), largest {standard[1]:.0f} m (215)",
        (7.0, 8.6), draw,
        {
            "thesis": THESIS["gaps"],
            "reproduced": dict(zip(("mean_m", "max_m", "mean_every_change_m"), map(float, standard), strict=True)),
        },
        columns=(
            *columns,
            *(Column(key, mean, unit="m", form="%.3f", description="mean of the starfields") for key, mean in means),
        ),
    )  # fmt: skip


def _draw_panels(figure: Figure, x: Array, curves: Array, standard: float, tops: tuple[float, float]) -> Any:
    """The mean and the largest distance over `x`, with the thesis's at the `standard` one; the axes (2,)."""
    panels = figure.subplots(2, 1)
    for k, (word, value) in enumerate(zip(("Mean", "Maximum"), THESIS["gaps"].values(), strict=True)):
        axes, curve = panels[k], curves[..., k]
        axes.fill_between(x, curve.min(axis=1), curve.max(axis=1), color=STAR, alpha=0.15, lw=0)
        axes.plot(x, curve.mean(axis=1), color=STAR, marker=".", label="here")
        if k == 0:
            axes.plot(x, curves[..., 2].mean(axis=1), "--", color="0.5", linewidth=1, label="every change counted")
        axes.plot([standard], [value], "D", color=PUBLISHED, markersize=6, label=f"thesis: {value:g} m", zorder=5)
        axes.set(xlim=(x[0], x[-1]), ylim=(0, tops[k]), ylabel="Distance (m)")
        axes.set_title(f"({'ab'[k]}) {word} distance between changes in the viewed starfield")
    return panels


def fig_a2(context: Context) -> Artefact:
    """Figure A.2: aspect ratios of lunar craters by diameter."""
    simple, complex_ = np.linspace(0.5, 15, 59), np.linspace(12, 275, 264)
    # Depths: eq. 3.11 and 3.12 of Kua 2008, from the Lunar Sourcebook.
    ratios = simple / (0.196 * np.power(simple, 1.010)), complex_ / (1.044 * np.power(complex_, 0.301))
    shown = [f"{r.min():.2f} to {r.max():.2f}" for r in ratios]
    forms = ("simple", "complex")

    def draw(figure: Figure) -> None:
        limits = ((0, 15), (4.96, 5.14)), ((0, 300), (5, 50))
        for k, (axes, x) in enumerate(zip(figure.subplots(2, 1), (simple, complex_), strict=True)):
            axes.plot(x, ratios[k], color=STAR)
            axes.set(xlim=limits[k][0], ylim=limits[k][1], xlabel="Diameter (km)", ylabel="Aspect Ratio (X:1)")
            axes.set_title(f"({'ab'[k]}) Aspect ratios for {forms[k]} craterforms")

    return Artefact.of_figure(
        "figA.2", "Lunar crater aspect ratio ranges",
        f": simple craters {shown[0]} (thesis: approximately 5; axis 4.96 to 5.14), complex craters {shown[1]} "
        "(thesis: approximately 5 to 50).",
        f"simple craters {shown[0]} (thesis 5), complex {shown[1]} (thesis 5 to 50)", (7.0, 8.0), draw,
        {
            "thesis": {"aspect_ratios": THESIS["aspect_ratios"]},
            "reproduced": {form: [float(r.min()), float(r.max())] for form, r in zip(forms, ratios, strict=True)},
        },
        columns=(
            Column("diameter", np.concatenate([simple, complex_]), unit="km", form="%.3f"),
            Column("aspect_ratio", np.concatenate(ratios), form="%.4f", description="diameter over depth"),
            Column("craterform", np.repeat(forms, [len(simple), len(complex_)]).tolist(), "string"),
        ),
    )  # fmt: skip
