"""Figures 3.4, 3.10 and B.1 to B.10: the error at many places of the crater."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise

import numpy as np

from startrack.output.ecsv import Column
from startrack.reproduction import published
from startrack.reproduction.artefact import Context, Piece, markdown_table
from startrack.reproduction.methods import KUA, OURS, tasks
from startrack.reproduction.plots import error_map
from startrack.reproduction.statistics import Collected, collect, shown, statistics

RINGS_KM = (0.0, 2.0, 4.0, 6.0, 8.0, 10.0)
SCALED = "Point size and colour scaled to position error."


def fig3_4(context: Context) -> Piece:
    """Error of the skyline estimate over the crater."""
    count = context.size.one_sky
    hull, _ = collect(context, "fig 3.4", [tasks(KUA, context.seed, 0, count)])
    caption = (
        f"Figure 3.4: Position error at {count:,} sampled points for the skyline estimate. {SCALED} "
        f"Mean / s.d. / largest: {shown(hull.errors, '{:.0f} / {:.0f} / {:.0f}')} m; thesis 637 / 275 / 1735 m."
    )
    return Piece(
        name="fig3.4",
        title="Figure 3.4: Position error at sampled points for the skyline estimate",
        line=f"skyline estimate {hull.errors.mean():.0f} m (thesis 637)",
        text=f"{caption}\n\n{_ring_table({'skyline estimate': hull})}",
        columns=_ring_columns({"hull": hull}),
        pictures={"fig3.4": partial(error_map, hull.places_m[0], hull.errors, "Skyline estimate", caption)},
        values={"thesis": vars(published.HULL), "reproduced": statistics(hull.errors)},
        timing_ms={"hull_and_descent": hull.ms_per_fix},
    )


def fig3_10(context: Context) -> Piece:
    """Error of the pseudo-gradient over the crater, and ours."""
    size = context.size
    hull, descent = collect(context, "fig 3.10", [tasks(KUA, context.seed, 0, size.one_sky)])
    (ours,) = collect(context, "fig 3.10, ours", [tasks(OURS, context.seed, 0, size.ours_one_sky)])
    unsettled = descent.errors[~descent.told[0]]
    caption = (
        f"Figure 3.10: Position error at {size.one_sky:,} sampled points. {SCALED} "
        f"Mean / s.d. / largest: {shown(descent.errors)} m (thesis, table 3.1: 34.2 / 31.1 / 358.4 m); "
        f"{100 * descent.refused_fraction:.2f} % never settle (thesis 0.6 %)."
    )
    of_ours = (
        f"Ours on the same starfield and places (the first {size.ours_one_sky:,}): {shown(ours.errors)} m. {SCALED} "
        f"The pseudo-gradient: {shown(descent.errors)} m."
    )
    settling = (
        f"The descents that never settle end {unsettled.mean():.0f} m off on average (thesis: not significantly "
        "different from the overall mean)." if len(unsettled) else "Every descent settled."
    )  # fmt: skip
    rings = {"skyline estimate": hull, "pseudo-gradient": descent, "ours": ours}
    return Piece(
        name="fig3.10",
        title="Figure 3.10: Position error at sampled points",
        line=f"pseudo-gradient {descent.errors.mean():.1f} m (thesis: 34.2), ours {ours.errors.mean():.1f} m",
        text=f"{caption} {settling}\n\n{of_ours}\n\n{_ring_table(rings)}",
        columns=_ring_columns({"hull": hull, "descent": descent, "ours": ours}),
        pictures={
            "fig3.10": partial(error_map, descent.places_m[0], descent.errors, "Pseudo-gradient", caption),
            "fig3.10.ours": partial(error_map, ours.places_m[0], ours.errors, "Ours", of_ours),
        },
        values={
            "thesis": {**vars(published.OVERALL), "never_settle": published.NEVER_SETTLE},
            "reproduced": {**statistics(descent.errors), "never_settle": descent.refused_fraction},
            "ours": {**statistics(ours.errors), "refused": ours.refused},
        },
        timing_ms={"hull_and_descent": descent.ms_per_fix, "ours": ours.ms_per_fix},
    )


def fig_b(context: Context) -> Piece:
    """Figures B.1 to B.10: the ten starfields of table 3.1."""
    size = context.size
    by_sky = [tasks(KUA, context.seed, sky, size.per_sky) for sky in range(size.skies)]
    _, descent = collect(context, "figures B.1 to B.10", by_sky)
    pictures: dict[str, Callable[[], bytes]] = {}
    captions = []
    for k, trial in enumerate(published.TRIALS[: size.skies]):
        captions.append(
            f"Figure B.{k + 1}: Position error at {size.per_sky:,} sampled points in a Shackleton-style crater, "
            f"starfield {k + 1}. {SCALED} Mean / s.d. / largest: {shown(descent.errors_m[k])} m; "
            f"thesis {trial.mean_m} / {trial.sd_m} / {trial.max_m} m."
        )
        pictures[f"figB.{k + 1}"] = partial(
            error_map, descent.places_m[k], descent.errors_m[k], f"Starfield {k + 1}", captions[-1]
        )
    return Piece(
        name="figB",
        title="Figures B.1 to B.10: Position error in a Shackleton-style crater",
        line=f"ten starfields, pseudo-gradient {descent.errors.mean():.1f} m (thesis 34.2)",
        text="\n\n".join(captions),
        pictures=pictures,
        values={
            "thesis": {"trials": [vars(trial) for trial in published.TRIALS]},
            "reproduced": {"trials": [statistics(errors) for errors in descent.errors_m]},
        },
        timing_ms={"hull_and_descent": descent.ms_per_fix},
    )


def _ring_means(method: Collected) -> list[float | None]:
    """Mean error [m] by distance from the centre; None where there is no place."""
    distance = np.concatenate([np.hypot(*places.T) for places in method.places_m]) / 1e3
    rings = [(distance >= a) & (distance < b) for a, b in pairwise(RINGS_KM)]
    return [float(method.errors[ring].mean()) if ring.any() else None for ring in rings]


def _ring_table(methods: dict[str, Collected]) -> str:
    means = {name: _ring_means(method) for name, method in methods.items()}
    rows = [
        [
            f"{low:.0f} to {low + 2:.0f} km",
            *("" if means[name][k] is None else f"{means[name][k]:.1f}" for name in means),
        ]
        for k, low in enumerate(RINGS_KM[:-1])
    ]
    return markdown_table(["from the centre", *(f"{name}: mean error (m)" for name in means)], rows)


def _ring_columns(methods: dict[str, Collected]) -> tuple[Column, ...]:
    columns = [
        Column("from_km", list(RINGS_KM[:-1]), unit="km", form="%.0f", description="distance from the centre"),
        Column("to_km", list(RINGS_KM[1:]), unit="km", form="%.0f"),
    ]
    for name, method in methods.items():
        values = ["" if mean is None else f"{mean:.3f}" for mean in _ring_means(method)]
        columns.append(Column(f"{name}_mean", values, unit="m", description="mean position error"))
    return tuple(columns)
