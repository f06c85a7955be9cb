"""The light of the ground along a skyline: patches, each of any brightness, darker or brighter than the sky or as it.

From sector to sector the level drifts a little, or with a small probability it is that of another patch: anything. The
posterior of each sector's level, given all sectors, is the sum over where its patch begins and ends (a forward and a
backward pass around the circle); each term is that of a Kalman smoother.
"""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
import numpy as np

from startrack.core.kernels import njit
from startrack.core.types import Array

BORDER_PROBABILITY = 0.05  # of a patch's end between two sectors: patches of 30 degrees
DRIFT = 0.2  # from sector to sector, in the sigma of one sector's own level: then 20 sectors are averaged
LONGEST = 40  # sectors of a patch that are told apart; beyond, the drift has made them forget
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
    behind = [part[::-1] for part in _filter_patches(*(one[::-1] for one in measured), width_e, drift_e2)]
    return _join(*ahead, *(np.roll(part, -1, axis=0) for part in behind), width_e, drift_e2)


@njit(cache=True)
def _filter_patches(own, variance, width, drift):
    """Weights, means and variances (n, LONGEST) of the level by this sector and those before it.

    One for each number of sectors since the patch began. Two laps: the first one is for the memory of the second.
    """
    n = len(own)
    weight, mean, spread = np.zeros((n, LONGEST)), np.zeros((n, LONGEST)), np.ones((n, LONGEST))
    w, m, s = np.zeros(LONGEST + 1), np.zeros(LONGEST + 1), np.ones(LONGEST + 1)
    count = 0
    for k in range(2 * n):
        i = k % n
        y, v = own[i], variance[i]
        for r in range(count, 0, -1):  # one sector longer
            before = s[r - 1] + drift
            both = before + v
            off = y - m[r - 1]
            w[r] = w[r - 1] * (1.0 - BORDER_PROBABILITY) * np.exp(-0.5 * off * off / both) / np.sqrt(2.0 * np.pi * both)
            m[r] = m[r - 1] + before / both * off
            s[r] = before * v / both
        w[0], m[0], s[0] = BORDER_PROBABILITY / width if count else 1.0, y, v
        if count == LONGEST:
            total = w[LONGEST] + w[LONGEST - 1]
            if total > 0.0:
                part = w[LONGEST] / total
                m[LONGEST - 1] += part * (m[LONGEST] - m[LONGEST - 1])
                s[LONGEST - 1] += part * (s[LONGEST] - s[LONGEST - 1])
            w[LONGEST - 1] = total
        count = min(count + 1, LONGEST)
        total = w[:count].sum()
        w[:count] /= total
        weight[i, :count], mean[i, :count], spread[i, :count] = w[:count], m[:count], s[:count]
    return weight, mean, spread


@njit(cache=True)
def _join(weight, mean, spread, later_weight, later_mean, later_spread, width, drift):
    """Means (n,) of the level by the sectors up to each one, and by the patches of those after it."""
    level = np.empty(len(weight))
    for i in range(len(weight)):
        total, first = 0.0, 0.0
        for r in range(LONGEST):
            if weight[i, r] < 1e-12:
                continue
            alone = weight[i, r] * BORDER_PROBABILITY
            total += alone
            first += alone * mean[i, r]
            for q in range(LONGEST):
                if later_weight[i, q] < 1e-12:
                    continue
                after = later_spread[i, q] + drift
                both = spread[i, r] + after
                off = later_mean[i, q] - mean[i, r]
                agree = np.exp(-0.5 * off * off / both) / np.sqrt(2.0 * np.pi * both)
                part = weight[i, r] * later_weight[i, q] * (1.0 - BORDER_PROBABILITY) * width * agree
                total += part
                first += part * (mean[i, r] + spread[i, r] / both * off)
        level[i] = first / total
    return level
