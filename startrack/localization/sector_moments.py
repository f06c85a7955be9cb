"""Mean and variance of the skyline's height in each sector by the rows alone, and linear solutions from them."""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
from math import exp
from typing import NamedTuple

import numpy as np

from startrack.core.kernels import njit
from startrack.core.types import Array
from startrack.localization.profile_cells import Profiles, cell_at

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
    _fill_moments(profiles, REACH_RAD, mean, variance)
    return SectorMoments(mean, np.maximum(variance, LEAST_SIGMA_RAD**2))


@njit(cache=True)
def _fill_moments(profiles, reach, mean, variance):
    for s in range(len(mean)):
        last = profiles.first[s + 1] - 1
        begin = cell_at(profiles.x, profiles.guide, s, -reach)
        top, k = -np.inf, begin
        while k < last and profiles.x[k] < reach:
            top = max(top, profiles.left[k], profiles.right[k])
            k += 1
        total, first, second, k = 0.0, 0.0, 0.0, begin
        while k < last and profiles.x[k] < reach:
            a, b = max(profiles.x[k], -reach), min(profiles.x[k + 1], reach)
            middle, width = 0.5 * (a + b), b - a
            u = (middle - profiles.x[k]) / (profiles.x[k + 1] - profiles.x[k])
            at = profiles.left[k] + u * (profiles.right[k] - profiles.left[k]) + u * (1.0 - u) * profiles.bend[k]
            weight = width * exp(min(at - top, 50.0))
            total += weight
            first += weight * middle
            second += weight * (middle * middle + width * width / 12.0)
            k += 1
        mean[s] = first / total
        variance[s] = second / total - mean[s] * mean[s]


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
