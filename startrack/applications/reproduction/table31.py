"""Table 3.1: ten starfields, the thesis's two steps, ours and the limit, on the same draws."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from startrack.applications.reproduction import published
from startrack.applications.reproduction.artefact import Artefact, Context, markdown_table
from startrack.applications.reproduction.methods import BOUND, KUA, OURS, Task, tasks_of
from startrack.applications.reproduction.simulator import MAGNITUDE, PERFECT, Mistakes, star_count
from startrack.applications.reproduction.statistics import MethodErrors, collect_errors, format_errors, statistics
from startrack.core.types import Array
from startrack.output.ecsv import Column

DEEP_MAGNITUDE, DEEP_MISTAKES = 8.0, Mistakes(missed=0.10, false=0.01)
WHOLE, HUNDREDTHS = "{:.0f} / {:.0f} / {:.0f}", "{:.2f} / {:.2f} / {:.1f}"


def table31(context: Context) -> Artefact:
    """Table 3.1 with the hull, ours and the limit beside the thesis's own figures."""
    size = context.size
    hull, descent = collect_errors(context, "table 3.1, the thesis's methods", _tasks(context, KUA, size.per_sky))
    (ours,) = collect_errors(context, "table 3.1, ours", _tasks(context, OURS, size.ours_per_sky))
    (limit,) = collect_errors(context, "table 3.1, the limit", _tasks(context, BOUND, size.bound_per_sky))
    deep_tasks = _tasks(context, OURS, size.deep_per_sky, DEEP_MAGNITUDE, DEEP_MISTAKES)
    (deep,) = collect_errors(context, "table 3.1, ours at magnitude 8", deep_tasks)
    ratio = _ratio_to_limit(ours, limit)
    line = (
        f"pseudo-gradient {descent.errors.mean():.1f} m (thesis 34.2), never settles "
        f"{100 * descent.refused_fraction:.2f} % (0.6), hull {hull.errors.mean():.0f} m (637); "
        f"ours {ours.errors.mean():.1f} m (limit {limit.errors.mean():.1f}), "
        f"at magnitude 8 {deep.errors.mean():.2f} m"
    )
    return Artefact(
        name="table3.1",
        title="Table 3.1: Results of ten simulation runs in a Shackleton-like crater",
        line=line,
        text=_text(context, hull, descent, ours, limit, deep, ratio),
        columns=_columns(hull, descent, ours, limit),
        values=_values(hull, descent, ours, limit, deep, ratio),
        timing_ms={"hull_and_descent": descent.ms_per_fix, "ours": ours.ms_per_fix, "ours_8": deep.ms_per_fix},
    )


def _tasks(
    context: Context, method: str, per_sky: int, magnitude: float = MAGNITUDE, mistakes: Mistakes = PERFECT
) -> list[list[Task]]:
    return [
        tasks_of(method, context.seed, sky, per_sky, magnitude=magnitude, mistakes=mistakes)
        for sky in range(context.size.skies)
    ]


def _ratio_to_limit(ours: MethodErrors, limit: MethodErrors) -> float:
    """Mean error of our method over that of the limit, on the positions computed for both."""
    pairs = [
        (fix[: len(best)], best[: len(fix)])
        for fix, best, located in zip(ours.errors_m, limit.errors_m, ours.answered, strict=True)
        if located.all()  # otherwise the positions of both differ
    ]
    return float(np.concatenate([fix for fix, _ in pairs]).mean() / np.concatenate([best for _, best in pairs]).mean())


def _values(
    hull: MethodErrors, descent: MethodErrors, ours: MethodErrors, limit: MethodErrors, deep: MethodErrors, ratio: float
) -> dict[str, object]:
    return {
        "thesis": {
            "descent": vars(published.OVERALL),
            "hull": vars(published.HULL),
            "never_settle": published.NEVER_SETTLE,
            "trials": [vars(trial) for trial in published.TRIALS],
        },
        "reproduced": {
            "descent": statistics(descent.errors),
            "hull": statistics(hull.errors),
            "never_settle": descent.refused_fraction,
            "trials": [statistics(errors) for errors in descent.errors_m],
        },
        "ours": {
            "same_lists": {**statistics(ours.errors), "refused": ours.refused_count},
            "limit": statistics(limit.errors),
            "over_limit": ratio,
            "magnitude_8": {**statistics(deep.errors), "refused": deep.refused_count},
        },
    }


def _text(
    context: Context, hull: MethodErrors, descent: MethodErrors, ours: MethodErrors, limit: MethodErrors,
    deep: MethodErrors,
    ratio: float,
) -> str:  # fmt: skip
    size = context.size
    rows = [
        [k + 1, _trial_text(trial), format_errors(descent.errors_m[k]), f"{100 * np.mean(~descent.answered[k]):.2f} %",
         format_errors(hull.errors_m[k], WHOLE), format_errors(ours.errors_m[k]), format_errors(limit.errors_m[k])]
        for k, trial in enumerate(published.TRIALS[: size.skies])
    ]  # fmt: skip
    overall_never = f"{100 * descent.refused_fraction:.2f} % (thesis 0.6 %)"
    overall_hull = f"{format_errors(hull.errors, WHOLE)} (thesis 637 / 275 / 1735)"
    rows.append(
        ["Overall", _trial_text(published.OVERALL), format_errors(descent.errors), overall_never, overall_hull,
         format_errors(ours.errors), format_errors(limit.errors)]
    )  # fmt: skip
    head = ["Trial", "thesis", "its method, redone", "never settles", "its hull, redone", "ours", "limit"]
    return f"""Position error in metres: mean / standard deviation / largest. {star_count(MAGNITUDE)} stars (magnitude \
6), perfect lists; {size.per_sky:,} positions per starfield for the thesis's methods, the first {size.ours_per_sky:,} \
of them for ours, {size.bound_per_sky:,} for the limit. The limit is the middle of the cell of positions from which \
exactly the listed stars are in sight. Seed {context.seed}.

{markdown_table(head, rows)}

Ours over the limit, on the same positions: {ratio:.3f}. Refused by ours: {ours.refused_count}.

A camera two magnitudes deeper ({star_count(DEEP_MAGNITUDE):,} stars, {DEEP_MISTAKES.missed:.0%} of those in sight \
missed, {DEEP_MISTAKES.false:.0%} of the hidden ones on the list by mistake): ours \
{format_errors(deep.errors, HUNDREDTHS)} \
over {len(deep.errors):,} positions; refused: {deep.refused_count}."""


def _trial_text(trial: published.Errors) -> str:
    return f"{trial.mean_m:.1f} / {trial.sd_m:.1f} / {trial.max_m:.1f}"


def _columns(hull: MethodErrors, descent: MethodErrors, ours: MethodErrors, limit: MethodErrors) -> tuple[Column, ...]:
    skies = len(descent.errors_m)
    columns = [Column("trial", list(range(1, skies + 1)), "int64", form="%d", description="starfield")]
    measures: tuple[tuple[str, Callable[[Array], float]], ...] = (("mean", np.mean), ("sd", np.std), ("max", np.max))
    for name, _ in measures:
        values = [getattr(trial, f"{name}_m") for trial in published.TRIALS[:skies]]
        columns.append(Column(f"thesis_{name}", values, unit="m", form="%.1f", description="Kua 2008, table 3.1"))
    methods = (
        (descent, "descent", "hull and pseudo-gradient"),
        (hull, "hull", "hull alone"),
        (ours, "ours", "posterior mean"),
        (limit, "limit", "middle of the exact cell"),
    )
    for method, prefix, description in methods:
        for name, measure in measures:
            values = [float(measure(errors)) for errors in method.errors_m]
            columns.append(Column(f"{prefix}_{name}", values, unit="m", form="%.3f", description=description))
        columns.append(Column(f"{prefix}_count", [len(errors) for errors in method.errors_m], "int64", form="%d"))
    never = [float(np.mean(~settled)) for settled in descent.answered]
    columns.append(Column("never_settles", never, form="%.5f", description="fraction of the descents"))
    return tuple(columns)
