"""Localization: evidence and terrain to a position. Every method is one file and one line in LOCALIZERS."""

from typing import Protocol

from startrack.localization.consistency import check_consistency
from startrack.localization.convex_hull import Hull
from startrack.localization.posterior import ExactPosterior
from startrack.localization.pseudo_gradient import PseudoGradient
from startrack.terrain import Terrain
from startrack.types import Evidence, Fix


class Localizer(Protocol):
    """Evidence and terrain to a fix; raises NotLocated.

    Any function will do. A fix whose `search` is "approximate" has a larger error than the evidence allows: its
    position is reported without the check that it explains the evidence.
    """

    def __call__(self, evidence: Evidence, terrain: Terrain) -> Fix: ...


LOCALIZERS: dict[str, type[Localizer]] = {
    "posterior": ExactPosterior,
    "pseudo-gradient": PseudoGradient,
    "hull": Hull,
}


def localizer_name(localizer: Localizer) -> str:
    """The name of a `localizer` in LOCALIZERS; of one that is not listed, that of its class or function."""
    listed = [name for name, kind in LOCALIZERS.items() if kind is type(localizer)]
    return listed[0] if listed else getattr(localizer, "__name__", type(localizer).__name__)


__all__ = ["LOCALIZERS", "ExactPosterior", "Hull", "Localizer", "PseudoGradient", "check_consistency", "localizer_name"]
