"""Figure of all methods: the error that a share of the places does not exceed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from startrack.applications.reproduction.artefact import Picture, label_ends
from startrack.applications.reproduction.comparison import COMPARED, ComparedErrors

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ERROR_RANGE_M = (0.1, 10_000.0)  # of the axis: from a tenth of the best mean to the crater's radius
KINDS = {  # of methods: what they are, and their colour (Okabe and Ito's)
    "startrack": "#d55e00", "Kua": "#009e73", "lit skyline": "#56b4e9", "dark skyline": "#0072b2",
    "stars and a measured vertical": "#cc79a7",
}  # fmt: skip


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
