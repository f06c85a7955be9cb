"""Figures 3.7 to 3.9: the distance between changes of the view of the starfield; figure A.2: aspect ratios."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from startrack.applications.reproduction import published
from startrack.applications.reproduction.artefact import Artefact, Context, Picture
from startrack.applications.reproduction.drawing import PUBLISHED, STAR, mark_published, new_figure
from startrack.applications.reproduction.simulator import (
    MAGNITUDE,
    STEP_M,
    Sky,
    change_steps_m,
    changes_m,
    crater,
    gaps_m,
    mean_gap_m,
    star_count,
)
from startrack.core.types import Array
from startrack.output import Column

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAGNITUDES = np.arange(2.0, 7.01, 0.25)
ASPECT_RATIOS = np.logspace(-1, 3, 33)
VIEWS = f"views compared at every {STEP_M:.0f} m"


def fig3_7(context: Context) -> Artefact:
    """Distance between changes against the faintest magnitude."""
    curves = np.array([_gaps(context, magnitude, 10.0) for magnitude in MAGNITUDES])
    six = curves[int(np.argmin(np.abs(MAGNITUDES - MAGNITUDE)))].mean(axis=0)
    caption = (
        f"Figure 3.7: Effects of changing the star detection limit, {context.size.traverses} starfields (line: mean, "
        f"band: all). At magnitude 6: mean {six[0]:.1f} m, thesis 14.9 m; largest {six[1]:.0f} m, thesis 215 m "
        f"({VIEWS}; every single change counted, the mean is {six[2]:.1f} m)."
    )
    draw = partial(_draw_panels, MAGNITUDES, curves, "Minimum Detected Magnitude", (700.0, 7000.0), False)
    columns = (
        Column("magnitude", MAGNITUDES, form="%.6g"),
        Column("stars", [star_count(one) for one in MAGNITUDES], "int64", form="%d"),
    )
    title = "Effects of changing the star detection limit"
    return _artefact("fig3.7", title, Picture(draw, caption), columns, curves, six)


def fig3_9(context: Context) -> Artefact:
    """Distance between changes against the crater's aspect ratio."""
    curves = np.array([_gaps(context, MAGNITUDE, ratio) for ratio in ASPECT_RATIOS])
    ten = _gaps(context, MAGNITUDE, 10.0).mean(axis=0)
    widest = _gaps(context, MAGNITUDE, 50.0).mean(axis=0)
    caption = (
        f"Figure 3.9: Effects of changing the crater aspect ratio, {context.size.traverses} starfields (line: mean, "
        f"band: all; {VIEWS}; dashed: every change counted). At 10:1 mean {ten[0]:.1f} m and largest {ten[1]:.0f} m "
        f"(thesis 14.9 and 215 m); at 50:1 largest {widest[1]:.0f} m (thesis: approximately 1 km)."
    )
    draw = partial(_draw_panels, ASPECT_RATIOS, curves, "Crater Aspect Ratio (Diameter:Depth)", (250.0, 8000.0), True)
    columns = (Column("aspect_ratio", ASPECT_RATIOS, form="%.6g"),)
    title = "Effects of changing the crater aspect ratio"
    return _artefact("fig3.9", title, Picture(draw, caption), columns, curves, ten)


def fig3_8(context: Context) -> Artefact:
    """Distance between changes along one traverse."""
    cylinder = crater()
    changes = change_steps_m(changes_m(Sky.draw(context.seed, 0), cylinder), cylinder)
    gaps, middles = gaps_m(changes, cylinder), (changes[1:] + changes[:-1]) / 2
    inner, outer = (float(gaps[part].mean()) for part in (np.abs(middles) < 2000, np.abs(middles) > 8000))
    caption = (
        f"Figure 3.8: Plot of the distance between starfield changes along a crater traverse, one starfield, {VIEWS}. "
        f"Largest {gaps.max():.0f} m (thesis 215 m); mean {inner:.1f} m within 2 km of the centre, {outer:.1f} m "
        "beyond 8 km."
    )
    return Artefact.of_figure(
        "fig3.8", "Plot of the distance between starfield changes along a crater traverse",
        f"largest {gaps.max():.0f} m (thesis 215), {inner:.0f} m near the centre, {outer:.0f} m near the wall",
        Picture(partial(_draw_traverse, middles, gaps), caption),
        {
            "thesis": {"max_m": published.MAX_GAP_M},
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
    name: str, title: str, picture: Picture, columns: tuple[Column, ...], curves: Array, standard: Array
) -> Artefact:
    means = zip(("mean_distance", "max_distance", "mean_distance_every_change"), curves.mean(axis=1).T, strict=True)
    return Artefact.of_figure(
        name, title,
        f"under standard conditions mean {standard[0]:.1f} m (thesis 14.9), largest {standard[1]:.0f} m (215)",
        picture,
        {
            "thesis": {"mean_m": published.MEAN_GAP_M, "max_m": published.MAX_GAP_M},
            "reproduced": dict(zip(("mean_m", "max_m", "mean_every_change_m"), map(float, standard), strict=True)),
        },
        columns=(
            *columns,
            *(Column(key, mean, unit="m", form="%.3f", description="mean of the starfields") for key, mean in means),
        ),
    )  # fmt: skip


def _draw_panels(x: Array, curves: Array, axis: str, tops: tuple[float, float], log: bool) -> Figure:
    figure = new_figure(7.0, 8.6)
    for k, (axes, top, word) in enumerate(zip(figure.subplots(2, 1), tops, ("Mean", "Maximum"), strict=True)):
        axes.fill_between(x, curves[..., k].min(axis=1), curves[..., k].max(axis=1), color=STAR, alpha=0.15, lw=0)
        axes.plot(x, curves[..., k].mean(axis=1), color=STAR, marker=".", label="here")
        if k == 0:
            axes.plot(x, curves[..., 2].mean(axis=1), "--", color="0.5", linewidth=1, label="every change counted")
        value = (published.MEAN_GAP_M, published.MAX_GAP_M)[k]
        mark_published(axes, 10.0 if log else 6.0, value, f"thesis: {value:g} m")
        if log:
            axes.set_xscale("log")
            for ratio, text in ((5.0, "5:1"), (10.0, "Shackleton 10:1"), (50.0, "50:1")):
                axes.axvline(ratio, color="0.75", linewidth=0.8, zorder=0)
                axes.text(ratio, 0.62 * top, f" {text}", fontsize=8, rotation=90, va="top", ha="right", color="0.35")
        else:
            axes.set_xticks(np.arange(x[0], x[-1] + 0.01, 0.5))
        axes.set(xlim=(x[0], x[-1]), ylim=(0, top), xlabel=axis, ylabel="Distance (m)")
        axes.set_title(f"({'ab'[k]}) {word} distance between changes in the viewed starfield", fontsize=10)
        axes.legend(loc="upper center" if log else "upper right", frameon=False)
    return figure


def _draw_traverse(middles_m: Array, gaps: Array) -> Figure:
    figure = new_figure(7.0, 4.8)
    axes = figure.subplots()
    axes.plot(middles_m / 1e3, gaps, ".", color=STAR, markersize=3)
    axes.axhline(published.MAX_GAP_M, color=PUBLISHED, linewidth=0.8, linestyle="--", label="thesis: largest 215 m")
    axes.set(xlim=(-10, 10), ylim=(0, max(250.0, 1.1 * gaps.max())), xlabel="Distance from center (km)")
    axes.set_ylabel("Distance (m)")
    axes.set_title("Distances between appearing/disappearing stars during a crater traverse", fontsize=10)
    axes.legend(frameon=False)
    return figure


def fig_a2(context: Context) -> Artefact:
    """Aspect ratios of lunar craters by diameter."""
    simple, complex_ = np.linspace(0.5, 15, 59), np.linspace(12, 275, 264)
    ratios = simple / published.simple_depth_km(simple), complex_ / published.complex_depth_km(complex_)
    shown = [f"{r.min():.2f} to {r.max():.2f}" for r in ratios]
    caption = (
        f"Figure A.2: Lunar crater aspect ratio ranges: simple craters {shown[0]} (thesis: approximately 5; axis 4.96 "
        f"to 5.14), complex craters {shown[1]} (thesis: approximately 5 to 50)."
    )
    return Artefact.of_figure(
        "figA.2", "Lunar crater aspect ratio ranges",
        f"simple craters {shown[0]} (thesis 5), complex {shown[1]} (thesis 5 to 50)",
        Picture(partial(_draw_ratios, (simple, complex_), ratios), caption),
        {
            "thesis": {"aspect_ratios": list(published.LUNAR_ASPECT_RATIOS)},
            "reproduced": {
                form: [float(r.min()), float(r.max())] for form, r in zip(("simple", "complex"), ratios, strict=True)
            },
        },
        columns=(
            Column("diameter", np.concatenate([simple, complex_]), unit="km", form="%.3f"),
            Column("aspect_ratio", np.concatenate(ratios), form="%.4f", description="diameter over depth"),
            Column("craterform", ["simple"] * len(simple) + ["complex"] * len(complex_), "string"),
        ),
    )  # fmt: skip


def _draw_ratios(diameters: tuple[Array, Array], ratios: tuple[Array, Array]) -> Figure:
    figure = new_figure(7.0, 8.0)
    titles = "(a) Aspect ratios for simple craterforms", "(b) Aspect ratios for complex craterforms"
    limits = ((0, 15), (4.96, 5.14)), ((0, 300), (5, 50))
    for axes, x, y, title, (xlim, ylim) in zip(figure.subplots(2, 1), diameters, ratios, titles, limits, strict=True):
        axes.plot(x, y, color=STAR)
        axes.set(xlim=xlim, ylim=ylim, xlabel="Diameter (km)", ylabel="Aspect Ratio (X:1)")
        axes.set_title(title, fontsize=10)
    return figure
