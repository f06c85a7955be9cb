"""Figures 3.4, 3.10 and B.1 to B.10: the error at many positions; and the error against magnitude and aspect ratio."""

from __future__ import annotations

from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from startrack.applications.reproduction import published
from startrack.applications.reproduction.artefact import Artefact, Context, Picture, markdown_table
from startrack.applications.reproduction.drawing import PUBLISHED, STAR, error_map, new_figure
from startrack.applications.reproduction.methods import (
    BOUND,
    KUA,
    OURS,
    MethodErrors,
    collect_errors,
    error_statistics,
    format_errors,
)
from startrack.applications.reproduction.simulator import DIAMETER_M, star_count
from startrack.output import Column

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RINGS_KM = np.linspace(0.0, DIAMETER_M / 2e3, 6)
SCALED = "Point size and colour scaled to position error."
SWEEP_MAGNITUDES = (2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0)
SWEEP_ASPECT_RATIOS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
SWEEP_METHODS = ("hull", "pseudo-gradient", "ours", "limit")
SweepRow = tuple[MethodErrors, MethodErrors, MethodErrors, MethodErrors]  # as SWEEP_METHODS


def fig3_4(context: Context) -> Artefact:
    """Error of the skyline estimate over the crater."""
    count = context.size.one_sky
    hull, _ = collect_errors(context, "fig 3.4", KUA, 1, count)
    caption = (
        f"Figure 3.4: Position error at {count:,} sampled points for the skyline estimate. {SCALED} "
        f"Mean / s.d. / largest: {format_errors(hull.errors, '{:.0f} / {:.0f} / {:.0f}')} m; thesis 637 / 275 / 1735 m."
    )
    return Artefact.of_figure(
        "fig3.4", "Position error at sampled points for the skyline estimate",
        f"skyline estimate {hull.errors.mean():.0f} m (thesis 637)",
        Picture(partial(error_map, hull.positions_m[0], hull.errors, "Skyline estimate"), caption),
        {"thesis": vars(published.HULL), "reproduced": hull.statistics},
        f"{caption}\n\n{_ring_table({'skyline estimate': hull})}", columns=_ring_columns({"hull": hull}),
        timing_ms={"hull_and_descent": hull.ms_per_fix},
    )  # fmt: skip


def fig3_10(context: Context) -> Artefact:
    """Error of the pseudo-gradient over the crater, and ours."""
    size = context.size
    hull, descent = collect_errors(context, "fig 3.10", KUA, 1, size.one_sky)
    (ours,) = collect_errors(context, "fig 3.10, ours", OURS, 1, size.ours_one_sky)
    unsettled = descent.errors[~descent.answered[0]]
    caption = (
        f"Figure 3.10: Position error at {size.one_sky:,} sampled points. {SCALED} "
        f"Mean / s.d. / largest: {format_errors(descent.errors)} m (thesis, table 3.1: 34.2 / 31.1 / 358.4 m); "
        f"{100 * descent.refused_fraction:.2f} % never settle (thesis 0.6 %)."
    )
    of_ours = (
        f"Ours on the same starfield and positions (the first {size.ours_one_sky:,}): {format_errors(ours.errors)} m. "
        f"{SCALED} "
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
            "fig3.10": Picture(partial(error_map, descent.positions_m[0], descent.errors, "Pseudo-gradient"), caption),
            "fig3.10.ours": Picture(partial(error_map, ours.positions_m[0], ours.errors, "Ours"), of_ours),
        },
        values={
            "thesis": {**vars(published.OVERALL), "never_settle": published.NEVER_SETTLE},
            "reproduced": {**descent.statistics, "never_settle": descent.refused_fraction},
            "ours": {**ours.statistics, "refused": ours.refused_count},
        },
        timing_ms={"hull_and_descent": descent.ms_per_fix, "ours": ours.ms_per_fix},
    )


def fig_b(context: Context) -> Artefact:
    """Figures B.1 to B.10: the ten starfields of table 3.1."""
    size = context.size
    _, descent = collect_errors(context, "figures B.1 to B.10", KUA, size.skies, size.per_sky)
    pictures = {}
    for k, trial in enumerate(published.TRIALS[: size.skies]):
        caption = (
            f"Figure B.{k + 1}: Position error at {size.per_sky:,} sampled points in a Shackleton-style crater, "
            f"starfield {k + 1}. {SCALED} Mean / s.d. / largest: {format_errors(descent.errors_m[k])} m; "
            f"thesis {trial.mean_m} / {trial.sd_m} / {trial.max_m} m."
        )
        draw = partial(error_map, descent.positions_m[k], descent.errors_m[k], f"Starfield {k + 1}")
        pictures[f"figB.{k + 1}"] = Picture(draw, caption)
    return Artefact(
        name="figB",
        title="Figures B.1 to B.10: Position error in a Shackleton-style crater",
        line=f"ten starfields, pseudo-gradient {descent.errors.mean():.1f} m (thesis 34.2)",
        text="\n\n".join(picture.caption for picture in pictures.values()),
        pictures=pictures,
        values={
            "thesis": {"trials": [vars(trial) for trial in published.TRIALS]},
            "reproduced": {"trials": [error_statistics(errors) for errors in descent.errors_m]},
        },
        timing_ms={"hull_and_descent": descent.ms_per_fix},
    )


def _ring_means(method: MethodErrors) -> list[float | None]:
    """Mean error [m] by distance from the centre; None where there is no position."""
    distance = np.concatenate([np.hypot(*positions.T) for positions in method.positions_m]) / 1e3
    rings = [(distance >= a) & (distance < b) for a, b in pairwise(RINGS_KM)]
    return [float(method.errors[ring].mean()) if ring.any() else None for ring in rings]


def _ring_table(methods: dict[str, MethodErrors]) -> str:
    means = [["" if mean is None else f"{mean:.1f}" for mean in _ring_means(method)] for method in methods.values()]
    rows = [(f"{a:.0f} to {b:.0f} km", *cells) for (a, b), *cells in zip(pairwise(RINGS_KM), *means, strict=True)]
    return markdown_table(["from the centre", *(f"{name}: mean error (m)" for name in methods)], rows)


def _ring_columns(methods: dict[str, MethodErrors]) -> tuple[Column, ...]:
    columns = [
        Column("from_km", RINGS_KM[:-1], unit="km", form="%.0f", description="distance from the centre"),
        Column("to_km", RINGS_KM[1:], unit="km", form="%.0f"),
    ]
    for name, method in methods.items():
        values = ["" if mean is None else f"{mean:.3f}" for mean in _ring_means(method)]
        columns.append(Column(f"{name}_mean", values, unit="m", description="mean position error"))
    return tuple(columns)


def magnitude_sweep(context: Context) -> Artefact:
    """Position error against the faintest magnitude."""
    rows = [_sweep_row(context, f"magnitude {value:g}", magnitude=value) for value in SWEEP_MAGNITUDES]
    more = [f"{star_count(value):,}" for value in SWEEP_MAGNITUDES]
    title = "Position error against the star detection limit (with figure 3.7)"
    return _sweep_artefact(context, "magnitude", title, SWEEP_MAGNITUDES, rows, ("magnitude", "stars"), more)


def aspect_ratio_sweep(context: Context) -> Artefact:
    """Position error against the crater's aspect ratio."""
    rows = [_sweep_row(context, f"aspect ratio {value:g}", aspect_ratio=value) for value in SWEEP_ASPECT_RATIOS]
    more = [f"{DIAMETER_M / value:,.0f} m" for value in SWEEP_ASPECT_RATIOS]
    title = "Position error against the crater aspect ratio (with figure 3.9)"
    return _sweep_artefact(context, "aspect", title, SWEEP_ASPECT_RATIOS, rows, ("aspect ratio", "depth"), more)


def _sweep_row(context: Context, what: str, **settings: float) -> SweepRow:
    skies, per_sky = context.size.sweep_skies, context.size.sweep_per_sky
    hull, descent = collect_errors(context, f"{what}, {KUA}", KUA, skies, per_sky, **settings)
    (ours,), (limit,) = (
        collect_errors(context, f"{what}, {method}", method, skies, per_sky, **settings) for method in (OURS, BOUND)
    )
    return hull, descent, ours, limit


def _sweep_artefact(
    context: Context, name: str, title: str, x: tuple[float, ...], rows: list[SweepRow], head: tuple[str, str],
    more: list[str],
) -> Artefact:  # fmt: skip
    means = np.array([[one.errors.mean() for one in row] for row in rows])
    cells = [
        [f"{value:g}", one, *(f"{mean:.3g}" for mean in means[k]), f"{100 * rows[k][1].refused_fraction:.1f} %",
         rows[k][2].refused_count]
        for k, (value, one) in enumerate(zip(x, more, strict=True))
    ]  # fmt: skip
    table = markdown_table(
        [*head, *(f"{n}: mean (m)" for n in SWEEP_METHODS), "never settles", "refused by ours"], cells
    )
    caption = (
        f"Mean position error against {head[0]}: {context.size.sweep_skies} starfields of {context.size.sweep_per_sky} "
        "positions each, perfect lists. The limit is the middle of the exact cell, at all positions; positions that "
        "ours refuses (the stars leave too much of the floor open) are not in its mean."
    )
    standard = means[x.index(6.0 if name == "magnitude" else 10.0)]
    columns = [Column(head[0].replace(" ", "_"), x, form="%g")]
    for k, method in enumerate(SWEEP_METHODS):
        columns.append(Column(f"{method.replace('-', '_')}_mean", means[:, k], unit="m", form="%.3f"))
    columns.append(Column("never_settles", [row[1].refused_fraction for row in rows], form="%.5f"))
    columns.append(Column("refused_by_ours", [row[2].refused_count for row in rows], "int64", form="%d"))
    return Artefact(
        name=name,
        title=title,
        line=f"under standard conditions ours {standard[2]:.1f} m, pseudo-gradient {standard[1]:.1f} m",
        text=f"{caption}\n\n{table}",
        columns=tuple(columns),
        pictures={name: Picture(partial(_draw_sweep, x, means, head[0]), caption)},
        values={
            "reproduced": {"hull_m": means[:, 0].tolist(), "descent_m": means[:, 1].tolist()},
            "ours": {
                head[0].replace(" ", "_"): list(x),
                "mean_m": means[:, 2].tolist(),
                "limit_m": means[:, 3].tolist(),
                "refused": [row[2].refused_count for row in rows],
            },
        },
    )


def _draw_sweep(x: tuple[float, ...], means: np.ndarray, label: str) -> Figure:
    figure = new_figure(7.0, 5.4)
    axes = figure.subplots()
    styles = (("s:", "0.6"), ("^--", "#2166ac"), ("o-", STAR), ("x", PUBLISHED))
    for k, (style, colour) in enumerate(styles):
        axes.plot(x, means[:, k], style, color=colour, label=SWEEP_METHODS[k])
    axes.set_yscale("log")
    if label != "magnitude":
        axes.set_xscale("log")
    axes.set(xlabel=label, ylabel="mean position error (m)")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    return figure
