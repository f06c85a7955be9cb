"""Figures 3.7 to 3.9: the distance between changes of the view of the starfield; figure A.2: aspect ratios."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from startrack.applications.reproduction.artefact import PUBLISHED, STAR, Artefact, Context
from startrack.applications.reproduction.simulator import (
    ASPECT_RATIO,
    MAGNITUDE,
    STEP_M,
    THESIS,
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
