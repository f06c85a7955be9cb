"""The hypotheses that one fact which nobody states has a gross error, each sampled by itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from startrack.localization.hypothesis import Hypothesis, sample_hypothesis, solve_model
from startrack.localization.importance_sampling import Gaussian
from startrack.localization.other_times import is_linear, turned_model, turned_models
from startrack.localization.skyline_model import SkylineModel
from startrack.types import Array, Clock

SMALLER = 0.3  # variance of a gross error that is none, beside that by the linear model
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
            continue
        clock = _gross_clock(other)
        if clock is not None and not plain.suits_map:
            found.extend(_at_other_times(plain, other, clock, references_m))
        else:
            found.append(sample_hypothesis(other, references_m, _gross_modes(plain, other), rounds=GROSS_ROUNDS))
    return found


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
    """Modes with which the sampling of a gross error begins: by the linear model, and where it is none."""
    start, covariance, _ = solve_model(other)
    mean = plain.found.share @ plain.found.points
    same = np.linalg.pinv(other.basis.shown) @ (plain.model.basis.shown @ mean[2:])
    return [(start, 2.0 * covariance), (np.append(mean[:2], same), SMALLER * covariance)]
