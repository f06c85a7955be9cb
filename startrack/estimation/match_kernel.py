"""Kernels of matches: pairs of a detection and a star compared in position and brightness."""

from __future__ import annotations

import numpy as np

from startrack.core.kernels import njit

BRIGHTER_MAG = 0.8  # a detection is at most this much brighter than its star
DIMMED_MAG = 1.6  # and at most this much fainter: haze, branches, the edge of the lens
PX_PER_MAG = 0.6  # distance with the same cost as a difference of one magnitude


@njit(cache=True)
def pair_mutually(detection, star, cost, agrees):  # type: ignore[no-untyped-def]
    """Ascending indices of the pairs (k,) of least finite cost of their star and, where they agree, their detection.

    `detection` ascends.
    """
    slots = 4
    while slots < 2 * len(star):
        slots *= 2
    of_slot, is_best = np.empty(slots, np.int64), np.zeros(len(star), np.bool_)
    of_slot[:] = -1
    for i in range(len(star)):
        if cost[i] < np.inf:
            at = star[i] & (slots - 1)  # a hash table with open addressing
            while of_slot[at] >= 0 and star[of_slot[at]] != star[i]:
                at = (at + 1) & (slots - 1)
            if of_slot[at] < 0 or cost[i] < cost[of_slot[at]]:
                of_slot[at] = i
    for i in of_slot:
        if i >= 0:
            is_best[i] = agrees[i]
    kept, k = np.empty(len(star), np.int64), 0
    for i in range(len(star)):
        if is_best[i]:
            if k == 0 or detection[kept[k - 1]] != detection[i]:
                kept[k] = i
                k += 1
            elif cost[i] < cost[kept[k - 1]]:
                kept[k - 1] = i
    return kept[:k]


@njit(cache=True)
def compare_pairs(detection, star, distance, v_mag, v_sigma_mag, measured_mag, saturated):  # type: ignore[no-untyped-def]
    """`brightness_misfit` (k,) and `one_to_one_pairs` (m,) of CandidatePairs; all arguments are (k,)."""
    misfit, cost, agrees = np.empty(len(star)), np.empty(len(star)), np.empty(len(star), np.bool_)
    for i in range(len(star)):
        dimmed = measured_mag[i] - v_mag[i]
        beyond = max(abs(dimmed) - 2.0 * v_sigma_mag[i], 0.0)
        if saturated[i] and dimmed > 0.0:
            beyond = 0.0
        misfit[i] = beyond / (DIMMED_MAG if dimmed > 0.0 else BRIGHTER_MAG)
        cost[i], agrees[i] = distance[i] + PX_PER_MAG * beyond, misfit[i] < 1.0
    return misfit, pair_mutually(detection, star, cost, agrees)


@njit(cache=True)
def count_alike(v_mag, measured_mag, dimmed_mag):  # type: ignore[no-untyped-def]
    """Number of pairs of a star (n,) and an ascending measured magnitude (m,) that agree; fast where stars ascend."""
    count, first, last, m = 0, 0, 0, len(measured_mag)
    for v in v_mag:
        while first > 0 and measured_mag[first - 1] >= v - BRIGHTER_MAG:
            first -= 1
        while first < m and measured_mag[first] < v - BRIGHTER_MAG:
            first += 1
        while last > 0 and measured_mag[last - 1] >= v + dimmed_mag:
            last -= 1
        while last < m and measured_mag[last] < v + dimmed_mag:
            last += 1
        count += last - first
    return count
