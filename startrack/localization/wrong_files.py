"""Contradiction of an image's files: a stated fact that is grossly wrong, or any other smooth skyline, fits better."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from startrack.core.statistics import shares
from startrack.core.types import Array, NotLocated, Sectors
from startrack.localization.hypothesis import (
    FEW_ROUNDS,
    GROSS_ROUNDS,
    Hypothesis,
    first_group,
    first_plain,
    sample_gross_error,
)
from startrack.localization.likelihood.shared_errors import CLOCK_FACT, OWN_EDGE, OWN_EDGE_PROBABILITY, SharedErrors
from startrack.localization.likelihood.skyline_model import SkylineModel
from startrack.localization.likelihood.smooth_skyline import free_log_likelihood

WRONG_FACT_NATS = 3.0  # by which a gross error of a stated fact must explain the rows better: 1 of 100 clean skies
MOST_BLOCKED = 0.5  # of the skyline that the rows show: where more is on no map, another place may explain them as well
WIDE_SHAPE = 0.4  # relative range of a wrong map's steepness: a free skyline is compared with a map of any of them


def require_map_in_view(model: SkylineModel, clear: Array) -> None:
    """Raise NotLocated (inconsistent_evidence) where most of the skyline of a `model` is on no map.

    `clear` (SECTORS,) is the probability that the map's skyline shows.
    """
    hidden = Sectors(1.0 - clear).likely
    if np.average(hidden, weights=model.seen.moments.information) > MOST_BLOCKED:
        raise NotLocated(
            f"over {360.0 * hidden.mean():.0f} degrees the skyline is not the map's: something on no map "
            "stands there, or terrain, time or camera file are wrong",
            reason="inconsistent_evidence",
        )


def require_files(found: Sequence[Hypothesis], parameters: Array) -> None:
    """Raise NotLocated (inconsistent_evidence) where something else explains the rows better than the files.

    Args:
        found: the hypotheses, the heaviest first.
        parameters: (2 + a,) of the likeliest position and errors.
    """
    model, whole = found[0].model, first_plain(found).model
    shift, lift_rad = model.shift_of(parameters)
    free = free_log_likelihood(whole.seen, shift, lift_rad)
    better = free + whole.seen.log_offset - _log_map(found[0], parameters) - model.seen.log_offset
    if better > 0.0:
        wrong = Sectors(1.0 - model.states(parameters)[:, 0])
        where = f", most at azimuths {wrong.text}" if wrong else ""
        raise NotLocated(
            f"a skyline unlike the map's explains the image better, by {better:.0f} nats{where}: wrong terrain, time "
            "or camera file, or something on no map?",
            reason="inconsistent_evidence",
        )
    share = shares(np.array([one.log_evidence for one in found]))
    wrong_time = float(share @ [_is_wrong_time(one) for one in found])
    if wrong_time > 0.5:
        raise NotLocated(
            f"an error of the time beyond what {CLOCK_FACT} states is likelier than the stated time, with "
            f"{100.0 * wrong_time:.0f} %: is it right?",
            reason="inconsistent_evidence",
        )
    better, fact = max(((nats, fact) for fact, nats in weigh_wrong_facts(found)), default=(0.0, ""))
    if better > WRONG_FACT_NATS:
        raise NotLocated(
            f"an error beyond what {fact} states explains the image better, by {better:.0f} nats: is it right?",
            reason="inconsistent_evidence",
        )


def _log_map(best: Hypothesis, parameters: Array) -> float:
    """Log-likelihood of the best point; with a gross error, as of a wrong map that may have any shape in a range."""
    model = best.model
    shifts, lifts, integral = model.with_linear_errors(model.shifts(parameters[None]))
    value = float(model.log_likelihood_of(shifts, lifts)[0])
    if not best.gross:
        return value
    if model.errors.are_waves(best.gross):
        seams = model.linear.seams_rad.shape[1]  # a free skyline steps anywhere too
        return value + float(integral[0] + np.log(seams))
    own = model.errors.is_of_fact(best.gross)
    sigma, z = model.errors.sigma(best.gross)[own], parameters[2:] @ model.basis.shown[own].T
    return value - float(np.sum(0.5 * np.square(z / sigma) + np.log(sigma * np.sqrt(2 * np.pi) / WIDE_SHAPE)))


def weigh_wrong_facts(found: Sequence[Hypothesis]) -> Iterator[tuple[str, float]]:
    """Stated facts of the terrain, each with the nats by which its gross error explains the rows better.

    Both are integrals over position and errors. Facts that are certainly right are left out.
    """
    best = found[0].model
    near, plain = first_group([one for one in found if not _is_wrong_time(one)]), first_plain(found)
    by_files = _log_evidence(near)
    for fact in SharedErrors.doubtable(best.terrain):
        other = plain.model.with_gross(fact)
        better = -np.inf
        for rounds in FEW_ROUNDS, GROSS_ROUNDS:
            if len(other.basis):
                doubted = sample_gross_error(plain, other, None, rounds)
                better = _log_evidence([doubted]) - by_files
            if better < 0.0:
                break
        yield fact, better


def _is_wrong_time(one: Hypothesis) -> bool:
    """Whether a stated time is wrong by a hypothesis."""
    clock = one.model.errors.clock
    return one.gross == CLOCK_FACT and clock is not None and clock.gross_probability == 0.0


def _log_evidence(found: Sequence[Hypothesis]) -> float:
    """Logarithm of the evidence, whatever the prior probabilities of the gross errors are.

    That the light has an edge of its own is no statement of a file: it keeps its probability, so that it does not
    stand for a fact that is wrong.
    """
    kept = {OWN_EDGE: float(np.log(OWN_EDGE_PROBABILITY))}
    return float(
        np.logaddexp.reduce(
            [one.log_evidence - one.model.basis.log_probability + kept.get(one.gross, 0.0) for one in found]
        )
    )
