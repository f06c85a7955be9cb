"""Directions of the shared errors: those that the rows show are sampled, the others only move the position.

In standard deviations of their prior, the errors have information by the rows once the position is free. Along a
direction with next to none the errors keep their prior, and the position moves by what leaves the skyline as it is:
a turn or a larger size of a round crater, a tilt of its rim seen from the middle. These are integrated in closed form.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.core.types import Array
from startrack.localization.sector_moments import SectorMoments
from startrack.localization.shared_errors import SharedErrors

LEAST_INFORMATION = 0.03  # beside that of the prior, from which on a direction is sampled: a sigma smaller by 1.5 %


@dataclass(frozen=True, eq=False)
class ErrorBasis:
    """Values of the k shared errors: mean + shown z + hidden y, with z and y normal of unit variance."""

    gross: str  # fact with a gross error; "": none
    log_probability: float  # of that
    mean: Array  # (k,)
    shown: Array  # (k, a) directions that the rows show
    hidden: Array  # (k, b)
    drift_m: Array  # (b, 2) move of the position that leaves the skyline as it is, by one unit of each hidden one

    @classmethod
    def of(
        cls,
        errors: SharedErrors,
        gross: str,
        slopes_rad: Array,
        position_slopes: Array,
        moments: SectorMoments,
        reach_m: float,
    ) -> ErrorBasis:
        """Of errors that raise the skyline by `slopes_rad` (k, n), a position that does by `position_slopes` (2, n).

        The position is known to `reach_m` before.
        """
        sigma = errors.sigma(gross)
        weight = 1.0 / moments.variance_rad2
        rise, moved = sigma[:, None] * slopes_rad, position_slopes
        normal = (moved * weight) @ moved.T + reach_m**-2.0 * np.eye(2)
        to_move = np.linalg.solve(normal, (moved * weight) @ rise.T)  # (2, k) of the position, by each error
        left = rise - to_move.T @ moved
        information, axes = np.linalg.eigh((left * weight) @ left.T)
        is_shown = information > LEAST_INFORMATION
        hidden = axes[:, ~is_shown]
        return cls(
            gross, errors.log_probability(gross), errors.mean, sigma[:, None] * axes[:, is_shown],
            sigma[:, None] * hidden, -(to_move @ hidden).T,
        )  # fmt: skip

    @classmethod
    def whole(cls, errors: SharedErrors) -> ErrorBasis:
        """All `errors` in their own units, as directions of their own, about zero."""
        k = len(errors)
        return cls("", 0.0, np.zeros(k), np.eye(k), np.zeros((k, 0)), np.zeros((0, 2)))

    def __len__(self) -> int:
        return self.shown.shape[1]

    def values(self, shown: Array, hidden: Array) -> Array:
        """Values (n, k) of the errors at coordinates (n, a) and (n, b)."""
        return np.asarray(self.mean + shown @ self.shown.T + hidden @ self.hidden.T)

    def log_prior(self, shown: Array) -> Array:
        """Logarithm (n,) of the prior density of coordinates (n, a), with the probability of the hypothesis."""
        norm = 0.5 * shown.shape[1] * np.log(2 * np.pi)
        return np.asarray(self.log_probability - norm - 0.5 * np.square(shown).sum(axis=1))
