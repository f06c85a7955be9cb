"""A fit near a position compared with that of changed rows, both traced closely."""

from __future__ import annotations

from startrack.localization.likelihood import PositionLikelihood
from startrack.types import Array, Evidence

STEPS_M = (16.0, 2.0)  # first and last step of a climb
REFITS = ((40.0, 16.0, 5), (12.0, 4.0, 3))  # neighbourhood [m], first step [m], points across where horizons are traced
REFIT_LLR, REFIT_ROWS, LAST_REFIT_M = 1.0, 2000, 1.0  # of many rows only the strong ones decide where to climb


def refitted_gain(likelihood: PositionLikelihood, position_m: Array, changed: Evidence, at_m: Array) -> float:
    """How much better [nats] the changed rows fit near a position (2,) than the rows themselves near theirs (2,).

    Beside crests the horizon is not linear over the neighbourhoods searched before: it is traced closer here.
    """
    scores = []
    for evidence, start_m in ((changed, at_m), (likelihood.evidence, position_m)):
        one = PositionLikelihood.from_evidence(evidence, likelihood.terrain)
        way, _ = one.strong(REFIT_LLR, REFIT_ROWS).climb(start_m, REFITS, LAST_REFIT_M)
        scores.append(one.exact_scores(way).max())
    return float(scores[0] - scores[1])
