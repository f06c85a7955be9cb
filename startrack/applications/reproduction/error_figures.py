"""Figures 3.4, 3.10 and B.1 to B.10: the error at many positions; and the error against magnitude and aspect ratio."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from startrack.applications.reproduction.artefact import (
    STAR,
    Artefact,
    Context,
    Picture,
    label_ends,
    markdown_table,
)
from startrack.applications.reproduction.methods import (
    BOUND,
    KUA,
    OURS,
    MethodErrors,
    collect_errors,
    error_statistics,
    format_errors,
)
from startrack.applications.reproduction.simulator import ASPECT_RATIO, DIAMETER_M, MAGNITUDE, THESIS, star_count
from startrack.output import Column

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RINGS_KM = np.linspace(0.0, DIAMETER_M / 2e3, 6)
CLASSES = (  # of the points by their errors, smallest first: share up to the class's end, words, colour, size [pt^2]
    (0.5, "half of the points", "#c3cdda", 4.0), (0.9, "next 40 %", "#56b4e9", 5.0), (0.99, "next 9 %", "#e69f00", 9.0),
    (1.0, "worst 1 %", "#d55e00", 18.0),
)  # fmt: skip
COLUMNS = 5  # of panels
SWEEP_METHODS = ("hull", "pseudo-gradient", "ours", "limit")
SWEEP_STYLES = (("s:", "#009e73"), ("^--", "#009e73"), ("o-", "#d55e00"), ("x", STAR))


def fig3_4(context: Context) -> Artefact:
    """Figure 3.4: error of the skyline estimate over the crater."""
    count = context.size.one_sky
    hull, _ = collect_errors(context, "fig 3.4", KUA, 1, count)
    caption = (
        f"Figure 3.4: Position error at {count:,} sampled points for the skyline estimate. "
        f"Mean / s.d. / largest: {format_errors(hull.errors, '{:.0f} / {:.0f} / {:.0f}')} m; thesis 637 / 275 / 1735 m."
    )
    return Artefact(
        name="fig3.4",
        title="Figure 3.4: Position error at sampled points for the skyline estimate",
        line=f"skyline estimate {hull.errors.mean():.0f} m (thesis 637)",
        text=f"{caption}\n\n{_ring_table({'skyline estimate': hull})}",
        columns=_ring_columns({"hull": hull}),
        pictures={"fig3.4": _error_map(hull, ["Skyline estimate"], caption)},
        values={"thesis": THESIS["hull"], "reproduced": hull.statistics},
        timing_ms={"hull_and_descent": hull.ms_per_fix},
    )


def fig3_10(context: Context) -> Artefact:
    """Figure 3.10: error of the pseudo-gradient over the crater, and ours."""
    size = context.size
    hull, descent = collect_errors(context, "fig 3.10", KUA, 1, size.one_sky)
    (ours,) = collect_errors(context, "fig 3.10, ours", OURS, 1, size.ours_one_sky)
    unsettled = descent.errors[~descent.answered[0]]
    caption = (
        f"Figure 3.10: Position error at {size.one_sky:,} sampled points. "
        f"Mean / s.d. / largest: {format_errors(descent.errors)} m (thesis, table 3.1: 34.2 / 31.1 / 358.4 m); "
        f"{100 * descent.refused_fraction:.2f} % never settle (thesis 0.6 %)."
    )
    of_ours = (
        f"Ours on the same starfield and positions (the first {size.ours_one_sky:,}): {format_errors(ours.errors)} m. "
        f"The pseudo-gradient: {format_errors(descent.errors)} m."
    )
    settling = (
        f"The descents that never settle end {unsettled.mean():.0f} m off on average (thesis: not significantly "
        "different from the overall mean)." if len(unsettled) else "Every descent settled."
    )  # fmt: skip
    rings = {"skyline estimate": hull, "pseudo-gradient": descent, "ours": ours}
    return Artefact(
        name="fig3.10",
        title="Figure 3.10: Position error at sampled points",
        line=f"pseudo-gradient {descent.errors.mean():.1f} m (thesis: 34.2), ours {ours.errors.mean():.1f} m",
        text=f"{caption} {settling}\n\n{of_ours}\n\n{_ring_table(rings)}",
        columns=_ring_columns({"hull": hull, "descent": descent, "ours": ours}),
        pictures={
            "fig3.10": _error_map(descent, ["Pseudo-gradient"], caption),
            "fig3.10.ours": _error_map(ours, ["Ours"], of_ours),
        },
        values={
            "thesis": {**THESIS["overall"], "never_settle": THESIS["never_settle"]},
            "reproduced": {**descent.statistics, "never_settle": descent.refused_fraction},
            "ours": {**ours.statistics, "refused": ours.refused_count},
        },
        timing_ms={"hull_and_descent": descent.ms_per_fix, "ours": ours.ms_per_fix},
    )


def fig_b(context: Context) -> Artefact:
    """Figures B.1 to B.10: the ten starfields of table 3.1."""
    size = context.size
    _, descent = collect_errors(context, "figures B.1 to B.10", KUA, size.skies, size.per_sky)
    caption = (
        f"Figures B.1 to B.{size.skies}: Position error at {size.per_sky:,} sampled points in a Shackleton-style "
        "crater under each of its starfields, above each the mean error here and in the thesis."
    )
    trials = [" / ".join(map(str, trial.values())) for trial in THESIS["trials"][: size.skies]]
    errors = map(format_errors, descent.errors_m)
    rows = [(f"B.{k}", *both) for k, both in enumerate(zip(errors, trials, strict=True), start=1)]
    titles = [f"{name}: {here.split()[0]} m ({thesis.split()[0]})" for name, here, thesis in rows]
    return Artefact(
        name="figB",
        title="Figures B.1 to B.10: Position error in a Shackleton-style crater",
        line=f"ten starfields, pseudo-gradient {descent.errors.mean():.1f} m (thesis 34.2)",
        text=f"{caption}\n\n{markdown_table(['figure', 'mean / s.d. / largest (m)', 'thesis (m)'], rows)}",
        pictures={"figB": _error_map(descent, titles, caption)},
        values={
            "thesis": {"trials": THESIS["trials"]},
            "reproduced": {"trials": [error_statistics(errors) for errors in descent.errors_m]},
        },
        timing_ms={"hull_and_descent": descent.ms_per_fix},
    )


def _error_map(method: MethodErrors, titles: Sequence[str], caption: str) -> Picture:
    """Position errors over the crater's floor: a panel with a title for each sky, in colours of common CLASSES."""
    ends_m = np.quantile(method.errors, [share for share, *_ in CLASSES])
    columns = min(len(titles), COLUMNS)
    rows = -(-len(titles) // columns)

    def draw(figure: Figure) -> None:
        from matplotlib.patches import Circle

        panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        shrunk, radius = min(2.0, (2e4 / len(method.errors_m[0])) ** 0.5) / columns**0.5, DIAMETER_M / 2e3
        limits = (-1.03 * radius, 1.03 * radius)
        for axes, title, points_m, errors_m in zip(
            panels.flat, titles, method.positions_m, method.errors_m, strict=False
        ):
            class_of = np.searchsorted(ends_m, errors_m)
            for k, ((_, words, colour, area), end_m) in enumerate(zip(CLASSES, ends_m, strict=True)):
                east, north = points_m[class_of == k].T / 1e3
                label = f"{words}: up to {end_m:.0f} m"
                axes.scatter(east, north, s=shrunk * area, color=colour, linewidths=0, label=label)
            axes.add_patch(Circle((0, 0), radius, fill=False, color="0.3", linewidth=0.8))
            axes.set(aspect="equal", xlim=limits, ylim=limits, title=title)
        for axes in panels[-1]:
            axes.set_xlabel("east (km)")
        for axes in panels[:, 0]:
            axes.set_ylabel("north (km)")
        entries = panels[0, 0].get_legend_handles_labels()
        figure.legend(*entries, loc="outside upper center", ncols=min(2 * columns, 4), markerscale=2.0)

    return Picture((7.0, 7.4) if columns == 1 else (10.0, 1.0 + 2.1 * rows), draw, caption)


def _ring_means(method: MethodErrors, form: str) -> list[str]:
    """Mean error [m] by distance from the centre; empty where there is no position."""
    distance = np.concatenate([np.hypot(*positions.T) for positions in method.positions_m]) / 1e3
    rings = [(distance >= a) & (distance < b) for a, b in pairwise(RINGS_KM)]
    return [format(method.errors[ring].mean(), form) if ring.any() else "" for ring in rings]


def _ring_table(methods: dict[str, MethodErrors]) -> str:
    means = [_ring_means(method, ".1f") for method in methods.values()]
    rows = [(f"{a:.0f} to {b:.0f} km", *cells) for (a, b), *cells in zip(pairwise(RINGS_KM), *means, strict=True)]
    return markdown_table(["from the centre", *(f"{name}: mean error (m)" for name in methods)], rows)


def _ring_columns(methods: dict[str, MethodErrors]) -> tuple[Column, ...]:
    return (
        Column("from_km", RINGS_KM[:-1], unit="km", form="%.0f", description="distance from the centre"),
        Column("to_km", RINGS_KM[1:], unit="km", form="%.0f"),
        *(
            Column(f"{name}_mean", _ring_means(method, ".3f"), unit="m", description="mean position error")
            for name, method in methods.items()
        ),
    )


def magnitude_sweep(context: Context) -> Artefact:
    """Position error against the faintest magnitude."""
    return _sweep(
        context, "magnitude", "magnitude", MAGNITUDE, (2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0),
        "Position error against the star detection limit (with figure 3.7)", "stars", lambda v: f"{star_count(v):,}",
    )  # fmt: skip


def aspect_ratio_sweep(context: Context) -> Artefact:
    """Position error against the crater's aspect ratio."""
    return _sweep(
        context, "aspect", "aspect_ratio", ASPECT_RATIO, (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0),
        "Position error against the crater aspect ratio (with figure 3.9)", "depth",
        lambda v: f"{DIAMETER_M / v:,.0f} m",
    )  # fmt: skip


def _sweep(
    context: Context, name: str, key: str, standard: float, x: Sequence[float], title: str, also: str,
    also_of: Callable[[float], str],
) -> Artefact:  # fmt: skip
    """The mean errors of all methods over the setting `key` of the tasks, which has the values `x`."""
    words, skies, per_sky = key.replace("_", " "), context.size.sweep_skies, context.size.sweep_per_sky

    def collect(value: float, method: str) -> list[MethodErrors]:
        return collect_errors(context, f"{words} {value:g}, {method}", method, skies, per_sky, **{key: value})

    rows = [[one for method in (KUA, OURS, BOUND) for one in collect(value, method)] for value in x]
    means = np.array([[one.errors.mean() for one in row] for row in rows])
    unsettled = [descent.refused_fraction for _, descent, _, _ in rows]
    refused = [ours.refused_count for _, _, ours, _ in rows]
    cells = [
        [f"{value:g}", also_of(value), *(f"{mean:.3g}" for mean in means[k]), f"{100 * unsettled[k]:.1f} %", refused[k]]
        for k, value in enumerate(x)
    ]
    head = [words, also, *(f"{n}: mean (m)" for n in SWEEP_METHODS), "never settles", "refused by ours"]
    caption = (
        f"Mean position error against {words}: {skies} starfields of {per_sky} "
        "positions each, perfect lists. The limit is the middle of the exact cell, at all positions; positions that "
        "ours refuses (the stars leave too much of the floor open) are not in its mean."
    )
    usual = means[list(x).index(standard)]

    def draw(figure: Figure) -> None:
        axes: Any = figure.subplots()
        if key == "aspect_ratio":
            axes.set_xscale("log")
        axes.set(yscale="log", xlabel=words, ylabel="mean position error (m)")
        ends = []
        for method, mean, (style, colour) in zip(SWEEP_METHODS, means.T, SWEEP_STYLES, strict=True):
            axes.plot(x, mean, style, color=colour)
            ends += [(method, (x[k], mean[k]), colour) for k in np.flatnonzero(np.isfinite(mean))[-1:]]
        label_ends(axes, ends)
        axes.grid(alpha=0.3)

    return Artefact(
        name=name,
        title=title,
        line=f"under standard conditions ours {usual[2]:.1f} m, pseudo-gradient {usual[1]:.1f} m",
        text=f"{caption}\n\n{markdown_table(head, cells)}",
        columns=(
            Column(key, x, form="%g"),
            *(
                Column(f"{method.replace('-', '_')}_mean", mean, unit="m", form="%.3f")
                for method, mean in zip(SWEEP_METHODS, means.T, strict=True)
            ),
            Column("never_settles", unsettled, form="%.5f"),
            Column("refused_by_ours", refused, "int64", form="%d"),
        ),
        pictures={name: Picture((7.0, 5.4), draw, caption)},
        values={
            "reproduced": {"hull_m": means[:, 0].tolist(), "descent_m": means[:, 1].tolist()},
            "ours": {key: list(x), "mean_m": means[:, 2].tolist(), "limit_m": means[:, 3].tolist(), "refused": refused},
        },
    )
