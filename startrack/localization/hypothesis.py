"""Weighted points of the posterior where one fact, or none, has a gross error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from startrack.core.types import Array, Bools
from startrack.localization.importance_sampling import FEW, Gaussian, WeightedPoints, moments, normal_sequence, sample
from startrack.localization.likelihood.shared_errors import CLOCK_FACT
from startrack.localization.likelihood.skyline_model import SkylineModel

HIDDEN_COPIES = 6  # of each point, with values of the errors that the rows do not show
WIDER, LINEAR_PART = 2.0, 0.01  # variance of the first points, in that of the plain and of the linear solution
GROSS_ROUNDS = (120, 160, 200, 300, 400, 500)  # points; FEW effective ones end them
FEW_ROUNDS = GROSS_ROUNDS[:1]  # by which hypotheses are screened: of 34 refused with GROSS_ROUNDS it leaves 32


class Cell(NamedTuple):
    """Positions that are nearer to a reference than to any other one."""

    reference_m: Array  # (2,)
    others_m: Array  # (g, 2)

    @classmethod
    def of_each(cls, references_m: Sequence[Array], others_m: Array) -> list[Cell]:
        """Cells of several references (2,), beside `others_m` (n, 2) that have none."""
        whole = np.vstack([*references_m, others_m])
        return [cls(one, np.delete(whole, number, axis=0)) for number, one in enumerate(references_m)]

    def contains(self, positions_m: Array) -> Bools:
        """Whether each position (n, 2) is in the cell."""
        away = np.linalg.norm(positions_m[:, None] - self.others_m, axis=2).min(axis=1, initial=np.inf)
        return np.asarray(np.linalg.norm(positions_m - self.reference_m, axis=1) <= away)


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Points of the posterior where one fact, or none, has a gross error."""

    model: SkylineModel
    sampled: WeightedPoints  # the weights include the prior probability of the hypothesis

    def weighed(self, nats: float) -> Hypothesis:
        """Copy of this hypothesis whose logarithms of weights are greater by so many `nats`."""
        return replace(self, sampled=replace(self.sampled, log_weight=self.sampled.log_weight + nats))

    @property
    def log_evidence(self) -> float:
        """Logarithm of the probability of the rows, all positions together, times the prior of the hypothesis."""
        return self.sampled.log_evidence

    @property
    def gross(self) -> str:
        """Fact with the gross error, or OWN_EDGE; "": neither."""
        return self.model.gross

    @cached_property
    def copies(self) -> int:
        """Number of copies of each point, with other values of the errors that the rows do not show."""
        return HIDDEN_COPIES if self.model.basis.hidden.shape[1] else 1

    @cached_property
    def copies_log_weight(self) -> Array:
        """Logarithms (n,) of the weights of all copies."""
        return np.repeat(self.sampled.log_weight, self.copies) - np.log(self.copies)

    @cached_property
    def _hidden(self) -> Array:
        """Coordinates (n, b) of the errors that the rows do not show."""
        count, b = len(self.sampled.log_weight) * self.copies, self.model.basis.hidden.shape[1]
        return normal_sequence(b, 0, count)[0][:, :b] if b else np.zeros((count, 0))

    @cached_property
    def values(self) -> Array:
        """Values (n, k) of the shared errors, each in its unit."""
        return self.model.basis.values(np.repeat(self.sampled.points[:, 2:], self.copies, axis=0), self._hidden)

    @cached_property
    def unturned_m(self) -> Array:
        """Positions (n, 2) [m, enu] before the turn by the clock's error in a round crater."""
        return np.asarray(
            np.repeat(self.sampled.points[:, :2], self.copies, axis=0) + self._hidden @ self.model.basis.drift_m
        )

    @cached_property
    def positions_m(self) -> Array:
        """Positions (n, 2) [m, enu] of all copies."""
        return self.model.errors.true_positions(self.unturned_m, self.values)


def heaviest_first(found: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The hypotheses that were `found`, the one of the greatest `log_evidence` first."""
    return sorted(found, key=lambda one: -one.log_evidence)


def first_group(found: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Hypotheses of those `found` that have the reference of the first one: all of a group share this array."""
    return [one for one in found if one.model.around.reference_m is found[0].model.around.reference_m]


def first_plain(found: Sequence[Hypothesis]) -> Hypothesis:
    """Hypothesis without a gross error among those with the reference of the first one."""
    return min(first_group(found), key=lambda one: one.gross != "")


def sample_hypothesis(model: SkylineModel, cell: Cell | None, modes: Sequence[Gaussian], **how: Any) -> Hypothesis:
    """Hypothesis that is sampled, as `sample` is told `how`, in a `cell`; None: anywhere."""
    near, basis = model.seen.rows.near, model.basis
    area = float(np.log(np.pi * model.terrain.reach_m**2))

    def log_density(parameters: Array) -> Array:
        position = parameters[:, :2]
        inside = np.asarray(model.terrain.allowed(position))
        if cell is not None:
            inside &= cell.contains(position)
        value = np.full(len(parameters), -np.inf)
        if inside.any():
            value[inside] = model.log_likelihood(parameters[inside]) + model.seen.log_offset - area
            value[inside] += basis.log_prior(parameters[inside, 2:])
            if near is not None:
                value[inside] += near.log_density(position[inside])
        return value

    return Hypothesis(model, sample(log_density, modes, **how))


def sample_gross_errors(plain: Hypothesis, cell: Cell) -> list[Hypothesis]:
    """The hypotheses of one gross error each; for the clock on real ground see `sample_other_times`."""
    model, found = plain.model, []
    for gross in model.errors.facts:
        if gross == CLOCK_FACT and not model.terrain.axisymmetric:
            continue
        other, slopes = model.with_gross(gross), model.error_slopes_rad[model.errors.is_of_fact(gross)]
        if not slopes.any() and not model.errors.are_waves(gross):  # nothing shows it: the points are the same
            less = other.basis.log_probability - model.basis.log_probability
            found.append(replace(plain, model=other).weighed(less))
        else:
            found.append(sample_gross_error(plain, other, cell))
    return found


def sample_gross_error(
    plain: Hypothesis, other: SkylineModel, cell: Cell | None, rounds: Sequence[int] = GROSS_ROUNDS
) -> Hypothesis:
    """Hypothesis of one gross error, that of the model `other`, sampled from the points of a `plain` one."""
    modes = _gross_modes(plain, other)
    return sample_hypothesis(other, cell, modes, rounds=[len(modes) * count for count in rounds], enough=FEW)


def _gross_modes(plain: Hypothesis, other: SkylineModel) -> list[Gaussian]:
    """Modes with which the sampling of a gross error begins: the plain points, drawn out along what it does.

    A second mode has the points moved by a Newton step from the prior of the plain hypothesis to the wider one, if it
    leads far; too far where the skyline is not linear. How position and other errors follow is told by the linear
    model, whose own solution may be far off.
    """
    linear = other.solve_linear().covariance
    points = plain.sampled.points
    off = points[:, 2:] @ plain.model.basis.shown.T  # errors that the rows do not show keep their prior: 0 in the mean
    errors = np.zeros((len(off), len(other.errors)))
    for number, one in enumerate(other.errors.listed):
        errors[:, number] = off[:, [known.name == one.name for known in plain.model.errors.listed]].sum(axis=1)
    mean, same = moments(other.basis.parameters(points[:, :2], errors), plain.sampled.share)
    own = other.errors.is_of_fact(other.gross)
    picked = np.pad(other.basis.shown[own], ((0, 0), (2, 0)))
    before, after = (other.errors.sigma(gross)[own] ** -2.0 for gross in ("", other.gross))
    follow = linear @ picked.T
    drawn_out = follow @ np.linalg.pinv(picked @ follow) @ follow.T
    spread = WIDER * same + drawn_out + (1.0 if other.errors.are_waves(other.gross) else LINEAR_PART) * linear
    moved = follow @ ((before - after) * (picked @ mean))
    is_far = moved @ np.linalg.solve(spread, moved) > 1.0
    return [(mean, spread), *([(mean + moved, spread)] if is_far else [])]
