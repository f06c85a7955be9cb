"""Our error, the thesis's and the limit against magnitude and aspect ratio: what figures 3.7 and 3.9 stand for."""

from __future__ import annotations

from functools import partial

import numpy as np

from startrack.output.ecsv import Column
from startrack.reproduction.artefact import Context, Piece, markdown_table
from startrack.reproduction.methods import CELL, KUA, OURS, tasks
from startrack.reproduction.plots import STAR, new_figure, png
from startrack.reproduction.simulator import MAGNITUDE, star_count
from startrack.reproduction.statistics import Collected, collect

MAGNITUDES = (2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0)
ASPECT_RATIOS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
NAMES = ("hull", "pseudo-gradient", "ours", "limit")
Row = tuple[Collected, Collected, Collected, Collected]  # as NAMES


def by_magnitude(context: Context) -> Piece:
    """Position error against the faintest magnitude."""
    rows = [_row(context, f"magnitude {value:g}", value, 10.0) for value in MAGNITUDES]
    extra = [f"{star_count(value):,}" for value in MAGNITUDES]
    return _piece(
        context, "magnitude", "Position error against the star detection limit (with figure 3.7)", MAGNITUDES, rows,
        ("magnitude", "stars"), extra,
    )  # fmt: skip


def by_aspect_ratio(context: Context) -> Piece:
    """Position error against the crater's aspect ratio."""
    rows = [_row(context, f"aspect ratio {value:g}", MAGNITUDE, value) for value in ASPECT_RATIOS]
    extra = [f"{20_000 / value:,.0f} m" for value in ASPECT_RATIOS]
    return _piece(
        context, "aspect", "Position error against the crater aspect ratio (with figure 3.9)", ASPECT_RATIOS, rows,
        ("aspect ratio", "depth"), extra,
    )  # fmt: skip


def _row(context: Context, what: str, magnitude: float, aspect_ratio: float) -> Row:
    size, found = context.size, []
    for method in (KUA, OURS, CELL):
        by_sky = [
            tasks(method, context.seed, sky, size.sweep_per_sky, magnitude=magnitude, aspect_ratio=aspect_ratio)
            for sky in range(size.sweep_skies)
        ]
        found += collect(context, f"{what}, {method}", by_sky)
    hull, descent, ours, limit = found
    return hull, descent, ours, limit


def _piece(
    context: Context, name: str, title: str, x: tuple[float, ...], rows: list[Row], head: tuple[str, str],
    extra: list[str],
) -> Piece:  # fmt: skip
    means = np.array([[one.errors.mean() for one in row] for row in rows])
    cells = [
        [f"{value:g}", more, *(f"{mean:.3g}" for mean in means[k]), f"{100 * rows[k][1].refused_fraction:.1f} %",
         rows[k][2].refused]
        for k, (value, more) in enumerate(zip(x, extra, strict=True))
    ]  # fmt: skip
    table = markdown_table([*head, *(f"{n}: mean (m)" for n in NAMES), "never settles", "refused by ours"], cells)
    caption = (
        f"Mean position error against {head[0]}: {context.size.sweep_skies} starfields of {context.size.sweep_per_sky} "
        "places each, perfect lists. The limit is the middle of the exact cell, at all places; what ours refuses (the "
        "stars leave too much of the floor open) is not in its mean."
    )
    standard = means[x.index(6.0 if name == "magnitude" else 10.0)]
    columns = [Column(head[0].replace(" ", "_"), x, form="%g")]
    for k, method in enumerate(NAMES):
        columns.append(Column(f"{method.replace('-', '_')}_mean", means[:, k], unit="m", form="%.3f"))
    columns.append(Column("never_settles", [row[1].refused_fraction for row in rows], form="%.5f"))
    columns.append(Column("refused_by_ours", [row[2].refused for row in rows], "int64", form="%d"))
    return Piece(
        name=name,
        title=title,
        line=f"under standard conditions ours {standard[2]:.1f} m, pseudo-gradient {standard[1]:.1f} m",
        text=f"{caption}\n\n{table}",
        columns=tuple(columns),
        pictures={name: partial(_draw, x, means, head[0], caption)},
        values={
            "reproduced": {"hull_m": means[:, 0].tolist(), "descent_m": means[:, 1].tolist()},
            "ours": {
                head[0].replace(" ", "_"): list(x),
                "mean_m": means[:, 2].tolist(),
                "limit_m": means[:, 3].tolist(),
                "refused": [row[2].refused for row in rows],
            },
        },
    )


def _draw(x: tuple[float, ...], means: np.ndarray, label: str, caption: str) -> bytes:
    figure = new_figure(7.0, 5.4)
    axes = figure.subplots()
    styles = (("s:", "0.6"), ("^--", "#2166ac"), ("o-", STAR), ("x", "#d7191c"))
    for k, (style, colour) in enumerate(styles):
        axes.plot(x, means[:, k], style, color=colour, label=NAMES[k])
    axes.set_yscale("log")
    if label != "magnitude":
        axes.set_xscale("log")
    axes.set(xlabel=label, ylabel="mean position error (m)")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    return png(figure, caption)
