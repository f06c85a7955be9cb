"""Mean and variance of the skyline's height in each sector by the rows alone, and linear solutions from them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from startrack.core.types import Array
from startrack.kernels.library import kernel
from startrack.localization.profile_cells import HIGH_RAD, Profiles, declare, take

REACH_RAD = np.radians(1.2)  # of heights about the reference's skyline
LEAST_SIGMA_RAD, LEAST_SHOWN_PART = 1e-7, 1e-9
FREEDOM = 3.0  # degrees of freedom of the residuals: obstacles and wrong rows do not lead the solution
REWEIGHTINGS = 6


class SectorMoments(NamedTuple):
    """Heights above the reference's skyline; a sector that shows nothing has the window's own variance."""

    mean_rad: Array  # (SECTORS,)
    variance_rad2: Array  # (SECTORS,)

    @property
    def information(self) -> Array:
        """(SECTORS,) part of the window's variance that the rows take away; next to 0 where they show nothing."""
        return np.clip(1.0 - 3.0 * self.variance_rad2 / REACH_RAD**2, LEAST_SHOWN_PART, 1.0)


def measure_moments(profiles: Profiles) -> SectorMoments:
    """Moments of all sectors, every height within REACH_RAD equally likely before."""
    mean, variance = np.empty(len(profiles.free)), np.empty(len(profiles.free))
    _fill_moments(*take(profiles, _CELLS), HIGH_RAD, REACH_RAD, mean, variance)
    return SectorMoments(mean, np.maximum(variance, LEAST_SIGMA_RAD**2))


_CELLS = "first x left right bend guide"
_fill_moments = kernel(
    "fill_moments", *declare(_CELLS), "highest: float64", "reach: float64", "mean: out float64[sectors]",
    "variance: out float64[sectors]",
)  # fmt: skip


def heavy_log_likelihood(moments: SectorMoments, rise_rad: Array) -> float:
    """Log-likelihood of the heights where the skyline rises by `rise_rad` (SECTORS,), with far tails."""
    residual = np.square(moments.mean_rad - rise_rad) / moments.variance_rad2
    return -0.5 * (FREEDOM + 1.0) * float(np.log1p(residual / FREEDOM).sum())


def solve_linear(moments: SectorMoments, design: Array, mean: Array, prior: Array) -> tuple[Array, Array, Array]:
    """Parameters (d,) that explain the heights, their covariance (d, d), and weights (SECTORS,) of the sectors.

    The sectors are weighted as for residuals with far tails.

    Args:
        moments: the heights.
        design: (SECTORS, d) rise of the skyline by one unit of each parameter.
        mean: (d,) of the parameters before.
        prior: (d, d) inverse of their covariance before.
    """
    weight, left = np.ones(len(design)), moments.mean_rad - design @ mean
    for _ in range(REWEIGHTINGS):
        weighted = design * (weight / moments.variance_rad2)[:, None]
        covariance = np.linalg.inv(weighted.T @ design + prior)
        step = covariance @ (weighted.T @ left)
        residual = np.square(left - design @ step) / moments.variance_rad2
        weight = (FREEDOM + 1.0) / (FREEDOM + residual)
    return mean + step, np.asarray(covariance), np.asarray(weight)
