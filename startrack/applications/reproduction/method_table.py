"""Every method that the thesis names, on the same places: one table."""

from __future__ import annotations

from typing import Any

import numpy as np

from startrack.applications.reproduction.artefact import Artefact, Context, markdown_table
from startrack.applications.reproduction.comparison import COMPARED, ComparedErrors, ComparedMethod
from startrack.applications.reproduction.method_figures import answers_picture, cumulative_picture
from startrack.applications.reproduction.methods import ALL_METHODS, tasks_of
from startrack.output import Column

HEAD = ("method", "sees", "heading", "clock", "vertical", "prior", "mean (m)", "median (m)", "95 % (m)", "largest (m)",
        "refused", "published")  # fmt: skip


def collect_compared(context: Context) -> ComparedErrors:
    """The errors of every method at the places of a context's size."""
    size = context.size
    tasks = [
        task for sky in range(size.skies) for task in tasks_of(ALL_METHODS, context.seed, sky, size.compared_per_sky)
    ]
    chunks = list(context.store.chunks("all methods", tasks))
    keys = ("truth_m", "position_m", "seconds")
    truth, position, seconds = (np.concatenate([one[key] for one in chunks]) for key in keys)
    return ComparedErrors(truth, position, 1e3 * seconds.sum(axis=0) / len(truth))


def method_table(context: Context) -> Artefact:
    """The errors of every method that the thesis names, with what each is given and its published figure."""
    found = collect_compared(context)
    statistics = {name: found.statistics(name) for name in COMPARED}
    rows = [_cells(method, statistics[name]) for name, method in COMPARED.items()]
    places = len(found.truth_m)
    text = f"""Position error in metres at {places} places of the thesis's crater ({context.size.skies} starfields of \
{context.size.compared_per_sky}), with the standard error of the mean. Seed {context.seed}. The table of numbers has \
the processor time of no method, since a file must not depend on the machine: `--json` prints it.

{markdown_table(HEAD, rows)}"""
    best = min((one["mean_m"], name) for name, one in statistics.items() if one["mean_m"] is not None)
    return Artefact(
        name="methods",
        title="Every method that the thesis names, at the same places",
        line=f"startrack {_number(statistics['startrack']['mean_m'])} m, best {COMPARED[best[1]].name} {best[0]:.1f} m",
        text=text,
        columns=_columns(statistics),
        pictures={"methods": cumulative_picture(found), "methods.map": answers_picture(found)},
        values={
            "thesis": {name: method.published for name, method in COMPARED.items()},
            "reproduced": {name: one for name, one in statistics.items() if name != "startrack"},
            "ours": statistics["startrack"],
        },
        timing_ms={name: float(one) for name, one in zip(COMPARED, found.ms_per_fix, strict=True)},
    )


def _cells(method: ComparedMethod, one: dict[str, Any]) -> list[str]:
    given = [method.name, method.sees, method.heading, method.clock, method.vertical, method.prior]
    mean = f"{_number(one['mean_m'])} ± {_number(one['mean_sigma_m'])}"
    errors = [mean, *(_number(one[key]) for key in ("median_m", "p95_m", "max_m"))]
    return [*given, *errors, str(one["refused"]), method.published or "-"]


def _number(value: float | None) -> str:
    """Three digits; a dash for what is not known."""
    return "-" if value is None else f"{value:.1f}" if value < 100 else f"{value:.0f}"


def _columns(statistics: dict[str, dict[str, Any]]) -> tuple[Column, ...]:
    keys = {
        "mean_m": "mean error", "mean_sigma_m": "standard error of the mean", "median_m": "median error",
        "p95_m": "error that 95 % of the answers do not exceed", "max_m": "largest error",
    }  # fmt: skip
    rows = statistics.values()
    return (
        Column("method", list(COMPARED), "string"),
        *(
            Column(key.removesuffix("_m"), [one[key] for one in rows], unit="m", form="%.3f", description=text)
            for key, text in keys.items()
        ),
        Column("answers", [one["count"] for one in rows], "int64", form="%d"),
        Column("refused", [one["refused"] for one in rows], "int64", form="%d"),
    )
