"""The light of the ground along a skyline: patches, each of any brightness, darker or brighter than the sky or as it.

From sector to sector the level drifts a little, or with a small probability it is that of another patch: anything. The
posterior of each sector's level, given all sectors, is the sum over where its patch begins and ends (a forward and a
backward pass around the circle); each term is that of a Kalman smoother.
"""

from __future__ import annotations

import numpy as np

from startrack.core.types import Array
from startrack.kernels.library import kernel

BORDER_PROBABILITY = 0.05  # of a patch's end between two sectors: patches of 30 degrees
DRIFT = 0.2  # from sector to sector, in the sigma of one sector's own level: then 20 sectors are averaged
LONGEST = 40  # sectors of a patch that are told apart; beyond, the drift has made them forget
LEAST_PATCH = 1e-12  # of a patch that is counted
ANY_SIGMAS = 20.0  # that levels of other patches may differ by beyond twice the range of what is seen


def patch_levels(own_e: Array, variance_e2: Array) -> Array:
    """Levels (n,) of the ground in sectors round the circle that show `own_e` (n,) with errors `variance_e2` (n,).

    The variance is infinite where a sector shows nothing.
    """
    shown = np.isfinite(variance_e2)
    if not shown.any():
        return own_e
    sigma_e = float(np.sqrt(np.median(variance_e2[shown])))
    width_e = 2.0 * float(np.ptp(own_e[shown])) + ANY_SIGMAS * sigma_e
    middle_e = float(np.median(own_e[shown]))
    measured = np.where(shown, own_e, middle_e), np.where(shown, variance_e2, width_e**2)
    drift_e2 = (DRIFT * sigma_e) ** 2
    ahead = _filter_patches(*measured, width_e, drift_e2)
    own, variance = (np.ascontiguousarray(one[::-1]) for one in measured)
    behind = [np.roll(part[::-1], -1, axis=0) for part in _filter_patches(own, variance, width_e, drift_e2)]
    states = (np.ascontiguousarray(part) for part in (*ahead, *behind))
    level = np.empty(len(own_e))
    _join(*states, width_e, drift_e2, BORDER_PROBABILITY, LEAST_PATCH, level)
    return level


def _filter_patches(own: Array, variance: Array, width: float, drift: float) -> tuple[Array, Array, Array]:
    """Weights, means and variances (n, LONGEST) of the level by this sector and those before it.

    One for each number of sectors since the patch began. Two laps: the first one is for the memory of the second.
    """
    shape = len(own), LONGEST
    weight, mean, spread = np.zeros(shape), np.zeros(shape), np.ones(shape)
    _filter(own, variance, width, drift, BORDER_PROBABILITY, weight, mean, spread, np.zeros((3, LONGEST + 1)))
    return weight, mean, spread


_STATES = [f"{name}: float64[n, longest]" for name in ("weight", "mean", "spread")]
_filter = kernel(
    "filter_patches", "own: float64[n]", "variance: float64[n]", "width: float64", "drift: float64", "border: float64",
    *(state.replace(": ", ": out ") for state in _STATES), "scratch: out float64[3, longest + 1]",
)  # fmt: skip
_join = kernel(
    "join_patches", *_STATES, *(f"later_{state}" for state in _STATES), "width: float64", "drift: float64",
    "border: float64", "least_weight: float64", "level: out float64[n]",
)  # fmt: skip
