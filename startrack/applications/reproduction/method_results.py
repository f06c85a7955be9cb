"""Every method that the thesis names, on the same places: one table, and the error that a share of the places keeps."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from startrack.applications.reproduction.artefact import Artefact, Context, Picture, label_ends, markdown_table
from startrack.applications.reproduction.comparison import COMPARED, ComparedErrors, ComparedMethod, methods_on
from startrack.applications.reproduction.methods import ALL_METHODS, Task, tasks_of
from startrack.applications.reproduction.scene import VALLEY_GROUND
from startrack.output import Column

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ERROR_RANGE_M = (0.1, 10_000.0)  # of the axis: from a tenth of the best mean to the crater's radius
KINDS = {  # of methods: what they are, and their colour (Okabe and Ito's)
    "startrack": "#d55e00", "Kua": "#009e73", "lit skyline": "#56b4e9", "dark skyline": "#0072b2",
    "stars and a measured vertical": "#cc79a7",
}  # fmt: skip
MAP_GROUND = "shackleton-rendered"  # the map itself is the ground: its errors are those of rounding
HEAD = ("method", "sees", "heading", "clock", "vertical", "prior", "mean (m)", "median (m)", "95 % (m)", "largest (m)",
        "refused", "published")  # fmt: skip


def cumulative_picture(found: ComparedErrors) -> Picture:
    """Error that a share of the places does not exceed, over the share, of each method, named at its curve's end."""
    silent = [name for name in found.names if not len(found.errors_m(name))]

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.set(yscale="log", ylim=ERROR_RANGE_M, xlim=(0, 1), xlabel="share of places", ylabel="position error (m)")
        ends = []
        for name in found.names:
            if name not in silent:
                errors, colour = np.sort(found.errors_m(name)), KINDS[kind_of(name)]
                share = np.arange(len(errors) + 1) / found.tried(name)
                axes.step(share, [errors[0], *errors], color=colour, linewidth=1.6)
                ends.append((label_of(name), (share[-1], errors[-1]), colour))
        label_ends(axes, ends)
        for kind, colour in KINDS.items():
            if any(kind_of(name) == kind for name in found.names):
                axes.plot([], [], color=colour, label=kind)
        axes.grid(alpha=0.3)
        figure.legend(loc="outside upper center", ncols=len(KINDS))

    refusing = f" No answer at any place: {'; '.join(map(label_of, silent))}." if silent else ""
    caption = (
        f"Position error that a share of {len(found.truth_m)} places (series: fewer) does not exceed; a method that "
        f"refuses places ends left of 1.{refusing}"
    )
    return Picture((9.0, 6.4), draw, caption)


def kind_of(name: str) -> str:
    """The kind, of KINDS, of the method `name`."""
    maker, sees = name.partition("-")[0], COMPARED[name].sees
    own = {"startrack": "startrack", "kua": "Kua"}.get(maker)
    return own or (sees if sees in KINDS else "stars and a measured vertical")


def label_of(name: str) -> str:
    """The name of a method with the skyline that it is given."""
    method = COMPARED[name]
    names = [one.name for one in COMPARED.values()]
    return method.name if names.count(method.name) == 1 else f"{method.name}, {method.sees}"


def method_table(context: Context) -> Artefact:
    """The errors of every method that the thesis names, with what each is given and its published figure."""
    size = context.size
    every = _series_every(context, size.skies * size.compared_per_sky)
    tasks = [
        task
        for sky in range(size.skies)
        for task in tasks_of(ALL_METHODS, context.seed, sky, size.compared_per_sky, series_every=every)
    ]
    title, places = "Every method that the thesis names, at the same places", "places of the thesis's crater"
    return _compare(context, "methods", tasks, title, places)


def map_table(context: Context) -> Artefact:
    """Errors of the methods that do not need a round crater, on the map of Shackleton."""
    title, places = "Methods that the thesis names on the map of Shackleton", "places of the map of Shackleton"
    tasks = _tasks_on(context, MAP_GROUND, context.size.compared_on_map)
    return _compare(context, "methods.shackleton", tasks, title, places)


def valley_table(context: Context) -> Artefact:
    """Errors of the methods that need neither a round crater nor the Moon, in valleys of the Earth."""
    title, places = "Methods that the thesis names in valleys of the Earth", "places in valleys near Jacksboro"
    tasks = _tasks_on(context, VALLEY_GROUND, context.size.compared_in_valley)
    return _compare(context, "methods.valley", tasks, title, places)


def _tasks_on(context: Context, ground: str, places: int) -> list[Task]:
    """Tasks of one place of a `ground` under each of as many skies as `places`."""
    more = {"ground": ground, "series_every": _series_every(context, places)}
    return [task for sky in range(places) for task in tasks_of(ALL_METHODS, context.seed, sky, 1, **more)]


def _series_every(context: Context, places: int) -> int:
    """Number of places of which one has series of exposures."""
    return -(-places // context.size.compared_series)


def _compare(context: Context, name: str, tasks: list[Task], title: str, places: str) -> Artefact:
    """The table and figure `name` of the places of `tasks`."""
    found = _collect(context, name, tasks)
    statistics = {one: found.statistics(one) for one in found.names}
    skies = len({task.sky for task in tasks})
    rows = [_cells(COMPARED[one], of_method, found.tried(one)) for one, of_method in statistics.items()]
    text = f"""Position error in metres at {len(found.truth_m)} {places}, under {skies} starfields, with the standard \
error of the mean; thesis: chapter 2 for the published figures. Seed {context.seed}. The table of numbers has the \
processor time of no method, since a file must not depend on the machine: `--json` prints it.

{markdown_table(HEAD, rows)}

{_order_text(statistics)}

{_bounds_text(found)}"""
    best = min((one["mean_m"], key) for key, one in statistics.items() if one["mean_m"] is not None)
    return Artefact(
        name=name,
        title=title,
        line=f"startrack {_number(statistics['startrack']['mean_m'])} m, best {label_of(best[1])} {best[0]:.2f} m",
        text=text,
        columns=_columns(statistics),
        pictures={name: cumulative_picture(found)},
        values={
            "thesis": {one: COMPARED[one].published for one in found.names},
            "reproduced": {key: one for key, one in statistics.items() if not key.startswith("startrack")},
            "ours": {key: one for key, one in statistics.items() if key.startswith("startrack")},
        },
        timing_ms={one: float(ms) for one, ms in zip(found.names, found.ms_per_fix, strict=True)},
    )


def _collect(context: Context, what: str, tasks: list[Task]) -> ComparedErrors:
    """The errors of every method at the places of `tasks`, which have the same ground."""
    chunks = list(context.store.chunks(what, tasks))
    keys = ("truth_m", "position_m", "is_tried", "bounds_m", "seconds")
    return ComparedErrors(
        tuple(methods_on(tasks[0].ground)), *(np.concatenate([one[key] for one in chunks]) for key in keys)
    )


def _order_text(statistics: dict[str, dict[str, Any]]) -> str:
    """The methods in the order of their mean errors, with standard errors."""
    known = [(one["mean_m"], name, one) for name, one in statistics.items() if one["mean_m"] is not None]
    ranked = [f"{label_of(name)} {_mean(one)}" for _, name, one in sorted(known, key=lambda row: row[:2])]
    return f"By the mean error, in metres: {'; '.join(ranked)}."


def _bounds_text(found: ComparedErrors) -> str:
    """Cozman's bounds under contaminated priors."""
    texts = []
    for number, name in enumerate(("lit", "dark")):
        if (bounds := found.bound_statistics(number)) is not None:
            half_m, share = bounds
            texts.append(
                f"{name} {_number(half_m)} m to either side, the truth inside on {100 * share:.0f} % of the axes"
            )
    return f"Cozman's bounds of the mean, under priors of which a tenth is anything: {'; '.join(texts)}."


def _cells(method: ComparedMethod, one: dict[str, Any], tried: int) -> list[str]:
    given = [method.name, method.sees, method.heading, method.clock, method.vertical, method.prior]
    errors = [_mean(one), *(_number(one[key]) for key in ("median_m", "p95_m", "max_m"))]
    return [*given, *errors, f"{one['refused']} of {tried}", method.published or "-"]


def _mean(one: dict[str, Any]) -> str:
    """Text of a mean with its standard error; a dash without an answer."""
    return "-" if not one["count"] else f"{_number(one['mean_m'])} ± {_number(one['mean_sigma_m'])}"


def _number(value: float | None) -> str:
    """Text of a value with about three digits; a dash for what is not known."""
    return "-" if value is None else f"{value:.{0 if value >= 100 else 1 if value >= 10 else 2}f}"


def _columns(statistics: dict[str, dict[str, Any]]) -> tuple[Column, ...]:
    keys = {
        "mean_m": "mean error", "mean_sigma_m": "standard error of the mean", "median_m": "median error",
        "p95_m": "error that 95 % of the answers do not exceed", "max_m": "largest error",
    }  # fmt: skip
    rows = statistics.values()
    return (
        Column("method", list(statistics), "string"),
        *(
            Column(key.removesuffix("_m"), [one[key] for one in rows], unit="m", form="%.3f", description=text)
            for key, text in keys.items()
        ),
        Column("answers", [one["count"] for one in rows], "int64", form="%d"),
        Column("refused", [one["refused"] for one in rows], "int64", form="%d"),
    )
