"""The evidence of any smooth skyline near the map's: what a wrong map, time or camera file shows."""

from __future__ import annotations

from math import log

import numpy as np

from startrack.core.types import Array
from startrack.kernels.library import kernel
from startrack.localization.obstacle_chain import clear_emissions
from startrack.localization.profile_cells import LOW_RAD, Profiles

FREE_HEIGHTS, SPREAD = 121, 6.5  # of heights about the map's skyline, closer about it
ROUGHNESS_RAD = np.radians([0.003, 0.01, 0.03, 0.1])  # mean steps from sector to sector, equally likely
JUMP = 1e-4  # probability of a step to anywhere
HEIGHTS = np.sinh(SPREAD * np.linspace(-1, 1, FREE_HEIGHTS)) / np.sinh(SPREAD)  # in the farthest one


def free_log_likelihood(profiles: Profiles, shift: Array) -> float:
    """Log-likelihood of the rows if the skyline is the map's, higher by `shift` (SECTORS,), and any smooth curve."""
    logs = list_free_logs(profiles, shift, -LOW_RAD, ROUGHNESS_RAD).sum(axis=1)
    return float(np.logaddexp.reduce(logs)) - log(len(logs))


def list_free_logs(profiles: Profiles, shift: Array, reach_rad: float, roughness_rad: Array) -> Array:
    """Log-likelihoods (n, SECTORS) of each sector by the sectors before it, for each roughness (n,) of the curve.

    The skyline is the map's, higher by `shift` (SECTORS,), and a curve within `reach_rad` of zero.
    """
    heights = reach_rad * HEIGHTS
    likelihood, cells = clear_emissions(profiles, shift[:, None] + heights), np.gradient(heights)
    return np.array([_pass(likelihood, heights, cells, rough) for rough in roughness_rad])


def _pass(likelihood: Array, heights: Array, cells: Array, rough: float) -> Array:
    """Log-likelihoods (SECTORS,) by one pass around the circle, with steps of a mean size `rough` to either side."""
    found = np.empty(len(likelihood))
    _pass_curve(likelihood, heights, cells, rough, JUMP, np.empty((5, len(heights))), found)
    return found


_pass_curve = kernel(
    "pass_curve", "likelihood: float64[sectors, n >= 1]", "heights: float64[n]", "cells: float64[n]", "rough: float64",
    "jump: float64", "scratch: out float64[5, n]", "found: out float64[sectors]",
)  # fmt: skip
