"""Weighted points of the posterior where one fact, or none, has a gross error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from startrack.core.types import Array, Clock
from startrack.localization.clock import TIME_ROUNDS, is_linear, turned_model, turned_models
from startrack.localization.free_skyline import free_log_likelihood
from startrack.localization.importance_sampling import FEW, Gaussian, WeightedPoints, moments, normal_sequence, sample
from startrack.localization.skyline_model import SkylineModel

HIDDEN_COPIES = 6  # of each point, with values of the errors that the rows do not show
DOUBTFUL_NATS = 8.0  # by which a map beats a free skyline, right ones by 11 to 16; below, other times are tried too
WIDER, LINEAR_PART = 2.0, 0.01  # variance of the first points, in that of the plain and of the linear solution
GROSS_ROUNDS = (120, 160, 200, 300, 400, 500)  # points; FEW effective ones end them


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Points of the posterior where one fact, or none, has a gross error."""

    model: SkylineModel
    found: WeightedPoints  # the weights include the prior probability of the hypothesis

    @property
    def gross(self) -> str:
        """The fact; "": none."""
        return self.model.gross

    @cached_property
    def copies(self) -> int:
        """Of each point, with other values of the errors that the rows do not show."""
        return HIDDEN_COPIES if self.model.basis.hidden.shape[1] else 1

    @cached_property
    def log_weight(self) -> Array:
        """(n,) of all copies."""
        return np.repeat(self.found.log_weight, self.copies) - np.log(self.copies)

    @cached_property
    def _hidden(self) -> Array:
        """(n, b) coordinates of the errors that the rows do not show."""
        count, b = len(self.found.log_weight) * self.copies, self.model.basis.hidden.shape[1]
        return normal_sequence(b, 0, count)[0][:, :b] if b else np.zeros((count, 0))

    @cached_property
    def values(self) -> Array:
        """(n, k) of the shared errors."""
        return self.model.basis.values(np.repeat(self.found.points[:, 2:], self.copies, axis=0), self._hidden)

    @cached_property
    def unturned_m(self) -> Array:
        """(n, 2) positions before the turn by the clock's error in a round crater."""
        return np.asarray(
            np.repeat(self.found.points[:, :2], self.copies, axis=0) + self._hidden @ self.model.basis.drift_m
        )

    @cached_property
    def positions_m(self) -> Array:
        """(n, 2)."""
        return self.model.errors.true_positions(self.unturned_m, self.values)

    @property
    def later_s(self) -> float:
        """How much later the true time is than the stated one, in the mean."""
        return float(self.found.share @ self.values[:: self.copies, -1]) + self.model.errors.later_s

    @cached_property
    def suits_map(self) -> bool:
        """Whether the map's skyline explains the rows far better than any other one does, so that no time does."""
        shift = self.model.shift_of(self.found.share @ self.found.points)
        by_map = float(self.model.log_likelihood_of(shift[None])[0])
        return free_log_likelihood(self.model.seen.profiles, shift) < by_map - DOUBTFUL_NATS

    @property
    def tries_times(self) -> bool:
        """Whether times are tried that are apart from each other, unless an earlier fix from the image tried them.

        That is on real ground, where the skyline is not linear in the clock's error, and where the map does not explain
        the rows so well that no time does better.
        """
        support = self.model.seen.rows.support
        has_tried = support is not None and support.has_tried_times
        return not (has_tried or self.model.terrain.axisymmetric or self.suits_map)


def sample_hypothesis(model: SkylineModel, references_m: Array, modes: Sequence[Gaussian], **how: Any) -> Hypothesis:
    """A hypothesis sampled, as `sample` is told `how`, where its reference is the nearest of all (g, 2)."""
    near, basis, reference_m = model.seen.rows.near, model.basis, model.around.reference_m
    area = float(np.log(np.pi * model.terrain.reach_m**2))

    def log_density(parameters: Array) -> Array:
        position = parameters[:, :2]
        inside = np.asarray(model.terrain.allowed(position))
        away = np.linalg.norm(position[:, None] - references_m, axis=2)
        inside &= away.min(axis=1) == np.linalg.norm(position - reference_m, axis=1)
        value = np.full(len(parameters), -np.inf)
        if inside.any():
            value[inside] = model.log_likelihood(parameters[inside]) + model.seen.log_offset - area
            value[inside] += basis.log_prior(parameters[inside, 2:])
            if near is not None:
                value[inside] += near.log_density(position[inside])
        return value

    return Hypothesis(model, sample(log_density, modes, **how))


def sample_gross_errors(plain: Hypothesis, references_m: Array) -> list[Hypothesis]:
    """The hypotheses of one gross error each."""
    model, found = plain.model, []
    for gross in model.errors.facts:
        other, slopes = model.with_gross(gross), model.error_slopes_rad[model.errors.is_of_fact(gross)]
        if not slopes.any() and not model.errors.are_waves(gross):  # nothing shows it: the points are the same
            less = other.basis.log_probability - model.basis.log_probability
            found.append(Hypothesis(other, replace(plain.found, log_weight=plain.found.log_weight + less)))
        else:
            found.extend(sample_gross_error(plain, other, references_m))
    return found


def sample_gross_error(
    plain: Hypothesis, other: SkylineModel, references_m: Array, rounds: Sequence[int] = GROSS_ROUNDS
) -> list[Hypothesis]:
    """The hypothesis `other` of one gross error; of the clock on real ground there may be several times.

    Those are sampled in rounds of their own; see `clock_of_other_times`.
    """
    clock = clock_of_other_times(plain, other)
    if clock is not None:
        return _sample_other_times(plain, other, clock, references_m)
    modes = _gross_modes(plain, other)
    rounds = [len(modes) * count for count in rounds]
    return [sample_hypothesis(other, references_m, modes, rounds=rounds, enough=FEW)]


def _sample_other_times(plain: Hypothesis, model: SkylineModel, clock: Clock, references_m: Array) -> list[Hypothesis]:
    """The hypotheses of a gross error of the clock at times that are apart from each other."""
    found: list[Hypothesis] = []
    for turned in turned_models(model, clock):
        one = _sample_settled_time(plain, turned, clock, references_m)
        at_s, others_s = one.later_s, [other.later_s for other in found]
        if not any(is_linear(clock, at_s - other_s) for other_s in others_s):
            found.append(one)
    return found


def clock_of_other_times(plain: Hypothesis, other: SkylineModel) -> Clock | None:
    """The clock where the gross error of `other` is its, and times are tried that are apart from each other."""
    clock, listed = other.errors.clock, other.errors.listed
    return clock if listed[-1].fact == other.gross and plain.tries_times else None


def _sample_settled_time(plain: Hypothesis, model: SkylineModel, clock: Clock, references_m: Array) -> Hypothesis:
    """The hypothesis of a gross error of the clock, with the rows turned to the time that it shows."""
    for _ in range(TIME_ROUNDS):
        found = sample_hypothesis(model, references_m, _gross_modes(plain, model))
        off_s = found.later_s - model.errors.later_s
        if is_linear(clock, off_s):
            break
        model = turned_model(model, off_s)
    return found


def _gross_modes(plain: Hypothesis, other: SkylineModel) -> list[Gaussian]:
    """Modes with which the sampling of a gross error begins: the plain points, drawn out along what it does.

    Of a second one the points are moved besides, by a Newton step from the prior of the plain hypothesis to the wider
    one, if it leads far; too far where the skyline is not linear. How position and other errors follow is told by the
    linear model, whose own solution may be far off.
    """
    _, linear, _ = other.solve()
    points = plain.found.points
    off = points[:, 2:] @ plain.model.basis.shown.T  # errors that the rows do not show keep their prior: 0 in the mean
    errors = np.zeros((len(off), len(other.errors)))
    for number, one in enumerate(other.errors.listed):
        errors[:, number] = off[:, [known.name == one.name for known in plain.model.errors.listed]].sum(axis=1)
    mean, same = moments(other.basis.parameters(points[:, :2], errors), plain.found.share)
    own = other.errors.is_of_fact(other.gross)
    picked = np.pad(other.basis.shown[own], ((0, 0), (2, 0)))
    before, after = (other.errors.sigma(gross)[own] ** -2.0 for gross in ("", other.gross))
    follow = linear @ picked.T
    drawn_out = follow @ np.linalg.pinv(picked @ follow) @ follow.T
    spread = WIDER * same + drawn_out + (1.0 if other.errors.are_waves(other.gross) else LINEAR_PART) * linear
    moved = follow @ ((before - after) * (picked @ mean))
    is_far = moved @ np.linalg.solve(spread, moved) > 1.0
    return [(mean, spread), *([(mean + moved, spread)] if is_far else [])]
