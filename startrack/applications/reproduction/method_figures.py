"""Figures of all methods: the share of the places below an error, and the answers at one place."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from startrack.applications.reproduction.artefact import EDGE_COLOUR, STAR, Picture
from startrack.applications.reproduction.comparison import COMPARED, ComparedErrors
from startrack.applications.reproduction.simulator import DIAMETER_M

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ERROR_RANGE_M = (0.1, 10_000.0)  # of the axis: from a tenth of the best mean to the crater's radius
PICTURED_PLACE = 0
INSET_M = 300.0  # half side of the enlarged part


def cumulative_picture(found: ComparedErrors) -> Picture:
    """Share of the places at which each method is right to an error, over the error."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for name in found.names:
            errors = np.sort(found.errors_m(name))
            share = np.arange(1, len(errors) + 1) / found.tried(name)
            axes.step(errors, share, where="post", label=label_of(name), **_style(name))
        axes.set(xscale="log", xlim=ERROR_RANGE_M, ylim=(0, 1), xlabel="position error (m)", ylabel="share of places")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))

    caption = (
        f"Share of {len(found.truth_m)} places (series: fewer) at which the error is at most that of the axis; a "
        "method that refuses places ends below 1. Dashed: the dark skyline; dotted: with the light of the sky."
    )
    return Picture((9.0, 5.2), draw, caption)


def answers_picture(found: ComparedErrors, edge: str) -> Picture:
    """The answers of all methods at one place, on the map; `edge` says what its circle is."""
    truth, answers = found.truth_m[PICTURED_PLACE], found.position_m[PICTURED_PLACE]

    def draw(figure: Figure) -> None:
        from matplotlib.patches import Circle

        whole, near = figure.subplots(1, 2)
        whole.add_patch(Circle((0, 0), DIAMETER_M / 2e3, fill=False, color=EDGE_COLOUR))
        for axes in (whole, near):
            for name, answer in zip(found.names, answers, strict=True):
                style = _style(name)
                axes.plot(*answer / 1e3, marker="s" if style["linestyle"] == "--" else "o", linestyle="", markersize=6,
                          color=style["color"], label=label_of(name))  # fmt: skip
            axes.plot(*truth / 1e3, "+", color=STAR, markersize=16, markeredgewidth=2, label="truth")
            axes.set(aspect="equal", xlabel="east (km)")
        whole.set(ylabel="north (km)", title="all")
        near.set(title=f"{2 * INSET_M:.0f} m about the truth")
        for set_limits, middle in zip((near.set_xlim, near.set_ylim), truth / 1e3, strict=True):
            set_limits(middle - INSET_M / 1e3, middle + INSET_M / 1e3)
        near.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))

    caption = f"The answers of all methods at one place; squares: from the dark skyline. Green: {edge}."
    return Picture((12.0, 4.8), draw, caption)


def label_of(name: str) -> str:
    """The name of a method with the skyline that it is given."""
    method = COMPARED[name]
    names = [one.name for one in COMPARED.values()]
    return method.name if names.count(method.name) == 1 else f"{method.name}, {method.sees}"


def _style(name: str) -> dict[str, Any]:
    """Colour and line of a method: all runs of one have the same colour."""
    from matplotlib import colormaps

    method, names = COMPARED[name], list(dict.fromkeys(method.name for method in COMPARED.values()))
    return {
        "color": colormaps["tab20"](names.index(method.name)),
        "linestyle": {"dark skyline": "--", "stars and sky": ":"}.get(method.sees, "-"),
    }
