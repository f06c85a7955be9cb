"""Weighted points of the posterior where one fact, or none, has a gross error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from startrack.core.types import Array
from startrack.localization.distributions import normal_sequence
from startrack.localization.free_skyline import free_log_likelihood
from startrack.localization.importance_sampling import Gaussian, WeightedPoints, sample
from startrack.localization.sector_moments import solve_linear
from startrack.localization.skyline_model import SkylineModel

HIDDEN_COPIES = 6  # of each point, with values of the errors that the rows do not show
DOUBTFUL_NATS = 5.0  # by which a map beats a free skyline, below which other times are tried too


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
        return self.model.errors.turned(self.unturned_m, self.values)

    @property
    def later_s(self) -> float:
        """How much later the true time is than the stated one, in the mean."""
        return float(self.found.share @ self.values[:: self.copies, -1]) + self.model.later_s

    @property
    def suits_map(self) -> bool:
        """Whether the map's skyline explains the rows far better than any other one does, so that no time does."""
        shift = self.model.shift_of(self.found.share @ self.found.points)
        by_map = float(self.model.log_likelihood_of(shift[None])[0])
        return free_log_likelihood(self.model.profiles, shift) < by_map - DOUBTFUL_NATS


def solve_model(model: SkylineModel) -> tuple[Array, Array, Array]:
    """Parameters (2 + a,) by the linear model of the sectors, their covariance, and weights (SECTORS,)."""
    k = 2 + len(model.basis)
    mean, prior = np.zeros(k), np.diag(np.r_[np.full(2, model.terrain.reach_m**-2.0), np.ones(k - 2)])
    design = np.vstack([model.position_slopes, model.slopes_rad]).T
    if model.image_errors is not None:
        j = len(model.image_errors.mean)
        design, mean = np.hstack([design, model.image_rise]), np.append(mean, model.image_errors.mean)
        whole = np.zeros((k + j, k + j))
        whole[:k, :k], whole[k:, k:] = prior, np.linalg.inv(model.image_errors.covariance)
        prior = whole
    parameters, covariance, weight = solve_linear(model.moments, design, mean, prior)
    parameters[:2] += model.reference_m
    return parameters[:k], covariance[:k, :k], weight


def sample_hypothesis(model: SkylineModel, references_m: Array, modes: Sequence[Gaussian], **how: Any) -> Hypothesis:
    """A hypothesis sampled, as `sample` is told `how`, where its reference is the nearest of all (g, 2)."""
    near, basis = model.rows.near, model.basis
    area = float(np.log(np.pi * model.terrain.reach_m**2))

    def log_density(parameters: Array) -> Array:
        position = parameters[:, :2]
        inside = np.asarray(model.terrain.allowed(position))
        away = np.linalg.norm(position[:, None] - references_m, axis=2)
        inside &= away.min(axis=1) == np.linalg.norm(position - model.reference_m, axis=1)
        value = np.full(len(parameters), -np.inf)
        if inside.any():
            value[inside] = model.log_likelihood(parameters[inside]) + model.log_offset - area
            value[inside] += basis.log_prior(parameters[inside, 2:])
            if near is not None:
                value[inside] += near.log_density(position[inside])
        return value

    return Hypothesis(model, sample(log_density, modes, **how))
