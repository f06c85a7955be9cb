"""The hypotheses that one fact which nobody states has a gross error, each sampled by itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from startrack.core.types import Array, Clock
from startrack.localization.hypothesis import Hypothesis, sample_hypothesis, solve_model
from startrack.localization.importance_sampling import Gaussian, moments
from startrack.localization.other_times import is_linear, turned_model, turned_models
from startrack.localization.skyline_model import SkylineModel

WIDER, LINEAR_PART = 2.0, 0.01  # variance of the first points, in that of the plain and of the linear solution
GROSS_ROUNDS = (120, 160, 200)
TIME_ROUNDS = 6  # in which the rows are turned to the time that a gross error of the clock shows


def sample_gross_errors(plain: Hypothesis, references_m: Array) -> list[Hypothesis]:
    """The hypotheses of one gross error each."""
    model, found = plain.model, []
    for gross in model.errors.facts:
        own = np.array([one.fact == gross for one in model.errors.listed])
        other = model.with_gross(gross)
        if not model.error_slopes_rad[own].any():  # nothing shows it: the points are the same
            less = other.basis.log_probability - model.basis.log_probability
            found.append(Hypothesis(other, replace(plain.found, log_weight=plain.found.log_weight + less)))
        else:
            found.extend(sample_gross_error(plain, other, references_m))
    return found


def sample_gross_error(
    plain: Hypothesis, other: SkylineModel, references_m: Array, rounds: Sequence[int] = GROSS_ROUNDS
) -> list[Hypothesis]:
    """The hypothesis `other` of one gross error; of the clock on real ground there may be several times."""
    clock = _gross_clock(other)
    if clock is not None and not plain.suits_map:
        return _at_other_times(plain, other, clock, references_m)
    return [sample_hypothesis(other, references_m, _gross_modes(plain, other), rounds=rounds)]


def _at_other_times(plain: Hypothesis, model: SkylineModel, clock: Clock, references_m: Array) -> list[Hypothesis]:
    """The hypotheses of a gross error of the clock at times that are apart from each other."""
    found: list[Hypothesis] = []
    for turned in turned_models(model, clock):
        one = _at_settled_time(plain, turned, clock, references_m)
        at_s, others_s = one.later_s, [other.later_s for other in found]
        if not any(is_linear(clock, at_s - other_s) for other_s in others_s):
            found.append(one)
    return found


def _gross_clock(model: SkylineModel) -> Clock | None:
    """The clock where the gross error is its, on real ground: there the skyline is not linear in it."""
    clock, listed = model.errors.clock, model.errors.listed
    return clock if listed[-1].fact == model.gross and not model.terrain.axisymmetric else None


def _at_settled_time(plain: Hypothesis, model: SkylineModel, clock: Clock, references_m: Array) -> Hypothesis:
    """The hypothesis of a gross error of the clock, with the rows turned to the time that it shows."""
    for _ in range(TIME_ROUNDS):
        found = sample_hypothesis(model, references_m, _gross_modes(plain, model))
        off_s = found.later_s - model.later_s
        if is_linear(clock, off_s):
            break
        model = turned_model(model, off_s)
    return found


def _gross_modes(plain: Hypothesis, other: SkylineModel) -> list[Gaussian]:
    """The mode with which the sampling of a gross error begins: the plain points, drawn out along what it does.

    The linear model tells how position and other errors follow a gross one, though its own solution may be far off.
    """
    _, linear, _ = solve_model(other)
    known = {one.name: number for number, one in enumerate(plain.model.errors.listed)}
    place = [known.get(one.name, -1) for one in other.errors.listed]
    errors = np.pad(plain.found.points[:, 2:] @ plain.model.basis.shown.T, ((0, 0), (0, 1)))[:, place]
    points = np.hstack([plain.found.points[:, :2], errors @ np.linalg.pinv(other.basis.shown).T])
    mean, same = moments(points, plain.found.share)
    gross = [one.fact == other.gross for one in other.errors.listed]
    picked = np.pad(other.basis.shown[gross], ((0, 0), (2, 0)))
    follow = linear @ picked.T
    drawn_out = follow @ np.linalg.pinv(picked @ follow) @ follow.T
    return [(mean, WIDER * same + drawn_out + LINEAR_PART * linear)]
