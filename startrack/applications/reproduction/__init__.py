"""The thesis's tables and figures reproduced: `ARTEFACTS` by name, each a function of a context."""

from __future__ import annotations

from collections.abc import Callable

from startrack.applications.reproduction.artefact import FULL, QUICK, Artefact, Context, Size, write_artefact
from startrack.applications.reproduction.error_figures import (
    aspect_ratio_sweep,
    fig3_4,
    fig3_10,
    fig_b,
    magnitude_sweep,
)
from startrack.applications.reproduction.method_results import map_table, method_table, valley_table
from startrack.applications.reproduction.methods import fix_store
from startrack.applications.reproduction.proposals import proposals
from startrack.applications.reproduction.starfield_figures import (
    fig3_3,
    fig3_5,
    fig3_6,
    fig3_7,
    fig3_8,
    fig3_9,
    fig_a1,
    fig_a2,
)
from startrack.applications.reproduction.table31 import table31

ARTEFACTS: dict[str, Callable[[Context], Artefact]] = {
    "table3.1": table31, "fig3.3": fig3_3, "fig3.4": fig3_4, "fig3.5": fig3_5, "fig3.6": fig3_6, "fig3.7": fig3_7,
    "fig3.8": fig3_8, "fig3.9": fig3_9, "fig3.10": fig3_10, "figA.1": fig_a1, "figA.2": fig_a2, "figB": fig_b,
    "magnitude": magnitude_sweep, "aspect": aspect_ratio_sweep, "methods": method_table,
    "methods.shackleton": map_table, "methods.valley": valley_table,
    "proposals": proposals,
}  # fmt: skip

__all__ = ["ARTEFACTS", "FULL", "QUICK", "Artefact", "Context", "Size", "fix_store", "write_artefact"]
