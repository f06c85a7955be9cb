"""The evidence of any smooth skyline near the map's: what a wrong map, time or camera file shows."""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
from math import exp, log

import numpy as np

from startrack.core.kernels import njit
from startrack.core.types import Array
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


@njit(cache=True)
def _pass(likelihood, heights, cells, rough):
    """Log-likelihoods (SECTORS,) by one pass around the circle, with steps of a mean size `rough` to either side.

    The sums over exp(-|x - x'| / rough) are two recursions, up and down.
    """
    n, whole, found = len(heights), 0.0, np.empty(len(likelihood))
    for i in range(n):
        whole += cells[i]
    a, fall, norm = np.empty(n), np.empty(n), _spread(cells, heights, rough)
    for i in range(n):
        a[i] = cells[i] / whole
    for s in range(len(likelihood)):
        if s > 0:
            for i in range(n):
                fall[i] = a[i] / norm[i]
            moved = _spread(fall, heights, rough)
            for i in range(n):
                a[i] = cells[i] * ((1.0 - JUMP) * moved[i] + JUMP / whole)
        total = 0.0
        for i in range(n):
            a[i] *= likelihood[s, i]
            total += a[i]
        for i in range(n):
            a[i] /= total
        found[s] = log(total)
    return found


@njit(cache=True)
def _spread(values, heights, rough):
    """Sums (n,) over j of values[j] exp(-|heights[i] - heights[j]| / rough)."""
    n = len(values)
    found = values.copy()
    up, down = values[0], 0.0
    for i in range(1, n):
        up = up * exp((heights[i - 1] - heights[i]) / rough) + values[i]
        found[i] = up
    for i in range(n - 2, -1, -1):
        down = (down + values[i + 1]) * exp((heights[i] - heights[i + 1]) / rough)
        found[i] += down
    return found
