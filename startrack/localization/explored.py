"""What the search gives: the posterior on boxes, or the boxes that were left when its budget was spent."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from startrack.types import Array


class Explored(NamedTuple):
    """The posterior on equal boxes."""

    centres_m: Array  # (n, 2)
    half_m: float
    log_likelihood: Array  # (n,) at the centres
    log_dropped: float  # logarithm of a bound of the mass [m2] that was dropped
    search: str  # "proven" or "beam"
    dropped_probability: float | None = None  # of an earlier fix with these points; None: by `log_dropped`
    horizon_bias_rad: float = 0.0  # how much higher than the terrain's the horizon was taken


class BudgetSpent(Exception):
    """The search has traced as many horizons as it may, and boxes may still matter."""

    def __init__(self, centres_m: Array, upper: Array, half_m: float) -> None:
        super().__init__(len(upper), half_m)
        self.centres_m = centres_m[np.argsort(-upper, kind="stable")]  # (n, 2) of the boxes, the best bounded first
        self.half_m = half_m
        self.log_open = log_sum(upper) + float(np.log(4 * half_m**2))  # bound of their mass [m2]


def log_sum(values: Array) -> float:
    """Logarithm of the sum of exponentials; -inf of none."""
    top = float(np.max(values, initial=-np.inf))
    return top + float(np.log(np.sum(np.exp(values - top)))) if np.isfinite(top) else -np.inf
