"""Table 3.1: ten starfields, the thesis's two steps, ours and the limit, on the same draws."""

from __future__ import annotations

import numpy as np

from startrack.applications.reproduction.artefact import Artefact, Context, markdown_table
from startrack.applications.reproduction.methods import (
    BOUND,
    KUA,
    OURS,
    MethodErrors,
    collect_errors,
    error_statistics,
    format_errors,
)
from startrack.applications.reproduction.simulator import MAGNITUDE, THESIS, Mistakes, star_count
from startrack.output import Column

DEEP_MAGNITUDE, DEEP_MISTAKES = 8.0, Mistakes(missed=0.10, false=0.01)
WHOLE, HUNDREDTHS = "{:.0f} / {:.0f} / {:.0f}", "{:.2f} / {:.2f} / {:.1f}"


def table31(context: Context) -> Artefact:
    """Table 3.1 with the hull, ours and the limit beside the thesis's own figures."""
    size, deep_settings = context.size, {"magnitude": DEEP_MAGNITUDE, "mistakes": DEEP_MISTAKES}
    hull, descent = collect_errors(context, "table 3.1, the thesis's methods", KUA, size.skies, size.per_sky)
    (ours,) = collect_errors(context, "table 3.1, ours", OURS, size.skies, size.ours_per_sky)
    (limit,) = collect_errors(context, "table 3.1, the limit", BOUND, size.skies, size.bound_per_sky)
    (deep,) = collect_errors(
        context, "table 3.1, ours at magnitude 8", OURS, size.skies, size.deep_per_sky, **deep_settings
    )
    ratio = _ratio_to_limit(ours, limit)
    line = (
        f"pseudo-gradient {descent.errors.mean():.1f} m (thesis 34.2), never settles "
        f"{100 * descent.refused_fraction:.2f} % (0.6), hull {hull.errors.mean():.0f} m (637); "
        f"ours {ours.errors.mean():.1f} m (limit {limit.errors.mean():.1f}), "
        f"at magnitude 8 {deep.errors.mean():.2f} m"
    )
    values = {
        "thesis": {
            "descent": THESIS["overall"],
            "hull": THESIS["hull"],
            "never_settle": THESIS["never_settle"],
            "trials": THESIS["trials"],
        },
        "reproduced": {
            "descent": descent.statistics,
            "hull": hull.statistics,
            "never_settle": descent.refused_fraction,
            "trials": [error_statistics(errors) for errors in descent.errors_m],
        },
        "ours": {
            "same_lists": {**ours.statistics, "refused": ours.refused_count},
            "limit": limit.statistics,
            "over_limit": ratio,
            "magnitude_8": {**deep.statistics, "refused": deep.refused_count},
        },
    }
    text = f"""Position error in metres: mean / standard deviation / largest. {star_count(MAGNITUDE)} stars (magnitude \
6), perfect lists; {size.per_sky:,} positions per starfield for the thesis's methods, the first {size.ours_per_sky:,} \
of them for ours, {size.bound_per_sky:,} for the limit. The limit is the middle of the cell of positions from which \
exactly the listed stars are in sight. Seed {context.seed}.

{_trial_table(hull, descent, ours, limit)}

Ours over the limit, on the same positions: {ratio:.3f}. Refused by ours: {ours.refused_count}.

A camera two magnitudes deeper ({star_count(DEEP_MAGNITUDE):,} stars, {DEEP_MISTAKES.missed:.0%} of those in sight \
missed, {DEEP_MISTAKES.false:.0%} of the hidden ones on the list by mistake): ours \
{format_errors(deep.errors, HUNDREDTHS)} \
over {len(deep.errors):,} positions; refused: {deep.refused_count}."""
    return Artefact(
        name="table3.1",
        title="Table 3.1: Results of ten simulation runs in a Shackleton-like crater",
        line=line,
        text=text,
        columns=_columns(hull, descent, ours, limit),
        values=values,
        timing_ms={"hull_and_descent": descent.ms_per_fix, "ours": ours.ms_per_fix, "ours_8": deep.ms_per_fix},
    )


def _ratio_to_limit(ours: MethodErrors, limit: MethodErrors) -> float:
    """Mean error of our method over that of the limit, on the positions computed for both."""
    pairs = [
        (fix[: len(best)], best[: len(fix)])
        for fix, best, located in zip(ours.errors_m, limit.errors_m, ours.answered, strict=True)
        if located.all()  # otherwise the positions of both differ
    ]
    return float(np.concatenate([fix for fix, _ in pairs]).mean() / np.concatenate([best for _, best in pairs]).mean())


def _trial_table(hull: MethodErrors, descent: MethodErrors, ours: MethodErrors, limit: MethodErrors) -> str:
    rows = [
        [k + 1, _trial_text(THESIS["trials"][k]), format_errors(errors),
         f"{100 * np.mean(~descent.answered[k]):.2f} %", format_errors(hull.errors_m[k], WHOLE),
         format_errors(ours.errors_m[k]), format_errors(limit.errors_m[k])]
        for k, errors in enumerate(descent.errors_m)
    ]  # fmt: skip
    overall = [
        "Overall", _trial_text(THESIS["overall"]), format_errors(descent.errors),
        f"{100 * descent.refused_fraction:.2f} % (thesis 0.6 %)",
        f"{format_errors(hull.errors, WHOLE)} (thesis 637 / 275 / 1735)", format_errors(ours.errors),
        format_errors(limit.errors),
    ]  # fmt: skip
    head = ["Trial", "thesis", "its method, redone", "never settles", "its hull, redone", "ours", "limit"]
    return markdown_table(head, [*rows, overall])


def _trial_text(trial: dict[str, float]) -> str:
    return " / ".join(f"{value:.1f}" for value in trial.values())


def _columns(hull: MethodErrors, descent: MethodErrors, ours: MethodErrors, limit: MethodErrors) -> tuple[Column, ...]:
    skies = len(descent.errors_m)
    columns = [Column("trial", list(range(1, skies + 1)), "int64", form="%d", description="starfield")]
    for name in ("mean", "sd", "max"):
        values = [trial[f"{name}_m"] for trial in THESIS["trials"][:skies]]
        columns.append(Column(f"thesis_{name}", values, unit="m", form="%.1f", description="Kua 2008, table 3.1"))
    methods = (
        (descent, "descent", "hull and pseudo-gradient"),
        (hull, "hull", "hull alone"),
        (ours, "ours", "posterior mean"),
        (limit, "limit", "middle of the exact cell"),
    )
    for method, prefix, description in methods:
        found = [error_statistics(errors) for errors in method.errors_m]
        for name in ("mean", "sd", "max"):
            values = [one[f"{name}_m"] for one in found]
            columns.append(Column(f"{prefix}_{name}", values, unit="m", form="%.3f", description=description))
        columns.append(Column(f"{prefix}_count", [one["count"] for one in found], "int64", form="%d"))
    never = [float(np.mean(~settled)) for settled in descent.answered]
    columns.append(Column("never_settles", never, form="%.5f", description="fraction of the descents"))
    return tuple(columns)
