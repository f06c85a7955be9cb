"""Positions from evidence and terrain. Every method is one class and one line in LOCALIZERS."""

from typing import Any, Protocol

from startrack.core.types import Evidence, Fix
from startrack.localization.clock import clock_at, duration
from startrack.localization.conclusion import AMBIGUOUS_MASS, camera_at
from startrack.localization.importance_sampling import ENOUGH, Gaussian, WeightedPoints, moments, sample
from startrack.localization.integrity import RISK, clear_logs
from startrack.localization.likelihood.linear_errors import LinearErrors
from startrack.localization.likelihood.shared_errors import ErrorBasis, SharedErrors, is_noticeable
from startrack.localization.likelihood.skyline_model import SkylineModel
from startrack.localization.likelihood.skyline_profiles import HIGH_RAD, LOW_RAD, ROW_NATS, solve_linear
from startrack.localization.posterior import MIN_ROW_NATS, ExactPosterior, settle_steepness
from startrack.localization.skyline_points import SkylinePoints, locate_points
from startrack.localization.thesis_methods import Hull, PseudoGradient, descend, hull_position
from startrack.terrain import Terrain


class Localizer(Protocol):
    """A function of evidence and terrain that gives a fix, or raises NotLocated.

    Any function will do. A fix whose `search` is "approximate" has a larger error than the evidence allows: its
    position is reported without the check that it explains the evidence.
    """

    def __call__(self, evidence: Evidence, terrain: Terrain) -> Fix: ...


DEFAULT_LOCALIZER = "posterior"
LOCALIZERS: dict[str, type[Localizer]] = {
    DEFAULT_LOCALIZER: ExactPosterior,
    "pseudo-gradient": PseudoGradient,
    "hull": Hull,
}
WITHOUT_POSTERIOR = ("pseudo-gradient", "hull")


def localizer_name(localizer: Localizer) -> str:
    """The name of a `localizer` in LOCALIZERS; of one that is not listed, that of its class or function."""
    listed = [name for name, kind in LOCALIZERS.items() if kind is type(localizer)]
    return listed[0] if listed else getattr(localizer, "__name__", type(localizer).__name__)


def has_posterior(localizer: Localizer) -> bool:
    """Whether a `localizer` weighs a prior of the position: all do but those of the thesis."""
    return localizer_name(localizer) not in WITHOUT_POSTERIOR


def require_localizer(given: Any) -> Localizer:
    """The `given` localizer; where a name is given, that of LOCALIZERS, with its usual settings.

    Raises TypeError for a class instead of an object and for what cannot be called, ValueError for another name.
    """
    if isinstance(given, str):
        if given not in LOCALIZERS:
            raise ValueError(f"localizer={given!r}: known are {', '.join(LOCALIZERS)}")
        return LOCALIZERS[given]()
    if isinstance(given, type):
        raise TypeError(f"localizer={given.__name__} is a class: give an object of it, {given.__name__}()")
    if not callable(given):
        raise TypeError(
            f"localizer= is of type {type(given).__name__}: give a function of the evidence and the terrain"
        )
    return given  # type: ignore[no-any-return]


__all__ = [
    "AMBIGUOUS_MASS", "DEFAULT_LOCALIZER", "ENOUGH", "HIGH_RAD", "LOCALIZERS", "LOW_RAD", "MIN_ROW_NATS", "RISK",
    "ROW_NATS", "ErrorBasis", "ExactPosterior", "Gaussian", "Hull", "LinearErrors", "Localizer", "PseudoGradient",
    "SharedErrors", "SkylineModel", "SkylinePoints", "WeightedPoints", "camera_at", "clear_logs", "clock_at",
    "descend", "duration", "has_posterior", "hull_position", "is_noticeable", "localizer_name", "locate_points",
    "moments", "require_localizer", "sample", "settle_steepness", "solve_linear",
]  # fmt: skip
