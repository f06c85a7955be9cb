"""Probability that chance produces as many matches: the p-value of an identification.

A predicted star coincides by chance with a detection of its brightness with some probability p. Of n predicted stars
k or more then coincide with the probability of a binomial tail. The detections are clustered (walls, clouds and trees
leave parts of the field empty), so p follows from the density at the detections themselves. The probability is
multiplied by the number of hypotheses tried. All logarithms are natural.
"""

from __future__ import annotations

import numpy as np

from startrack.core.types import Array, Ints

PATTERN_MATCHES = 3  # the stars of a triangle coincide at any attitude that the triangle proposed
SMALLEST_PROBABILITY = 1e-300
SMALLEST_LOG_PROBABILITY = -690.0  # below this an exponential underflows
CAP_CENTRES = 64  # detections about which the density is measured
CAP_RADIUS_RAD = np.radians(10.0)
CELLS_ACROSS = 12  # of the frame's longer side, for the density in the image plane
MIN_EXPECTED = 1e-6


def probability(log_probability: float) -> float:
    """Probability from its logarithm, at least exp(-690)."""
    return float(np.exp(max(log_probability, SMALLEST_LOG_PROBABILITY)))


def log_trials(tried: int, part: float = 1.0) -> float:
    """Logarithm of the number of hypotheses tried: it is added to the log p-value of the accepted one.

    `tried` counts those of the whole sky. Where only a `part` of it is searched, chance proposes that part of them.
    """
    return float(np.log(max(tried, 1)) + np.log(part))


def coincidence_probability(expected: Array | float) -> Array:
    """Probability of at least one of a Poisson number of coincidences with this expectation."""
    return np.asarray(-np.expm1(-np.asarray(expected)))


def binomial_tail(at_least: Ints | int, trials: Ints | int, each: Array | float) -> Array:
    """Probability that a binomial variable is k or more, k >= 1: the incomplete beta function I_p(k, n - k + 1)."""
    from scipy.special import betainc

    return np.asarray(betainc(at_least, np.maximum(trials - at_least, 0) + 1, each))


def log_p_value(matched: Ints | int, predicted: Ints | int, each: Array | float, free: int = PATTERN_MATCHES) -> Array:
    """Logarithm of P(at least `matched` of `predicted` stars coincide by chance).

    `each`: probability that one star does. `free`: matches that the hypothesis itself produces (the stars of
    its pattern, the parameters of a fit); they are taken from both numbers.
    """
    k = matched - free
    tail = binomial_tail(np.maximum(k, 1), predicted - free, each)
    return np.where(k > 0, np.log(np.maximum(tail, SMALLEST_PROBABILITY)), 0.0)


def log_p_value_poisson(found: int, expected: float) -> float:
    """Logarithm of P(at least `found` coincidences) where `expected` are expected, from the Poisson distribution."""
    from scipy.special import gammainc

    tail = float(gammainc(max(found, 1), expected))
    return max(float(np.log(max(tail, SMALLEST_PROBABILITY))), SMALLEST_LOG_PROBABILITY)


def log_p_value_bound(distance_px: Array, gate_px: float, predicted: int, density_px2: float) -> float:
    """Chernoff bound of the Poisson tail for the matches closer than half the gate: cheap, for the pruning of a search.

    `distance_px` (n,): distances of the matches. `density_px2`: detections per pixel.
    """
    each = min(density_px2 * np.pi * (0.5 * gate_px) ** 2, 1.0)
    expected = max(predicted * each, MIN_EXPECTED)
    hits = int(np.count_nonzero(distance_px < 0.5 * gate_px))
    return 0.0 if hits <= expected else float(hits - expected - hits * np.log(hits / expected))


def expected_false_alarms(tried: float, matched: Ints | int, rays: int, each: float) -> Array:
    """Expected number of the `tried` hypotheses at which chance makes `matched` or more rays coincide with stars.

    `matched` (k,) is without the three of the pattern, `rays` of all detections with them. `each` is the probability
    that one ray coincides.
    """
    return tried * binomial_tail(matched, rays - PATTERN_MATCHES, each)


def density_per_sr(rays: Array, cap_rad: float = CAP_RADIUS_RAD) -> float:
    """Detections per steradian where the detections (n, 3) are: the mean number of others in caps about them.

    `cap_rad`: radius of the caps, small against the field of view. At least the density of n on the whole sphere.
    """
    n = len(rays)
    centres = rays[:: -(-n // CAP_CENTRES)] if n else rays
    near = np.count_nonzero(centres @ rays.T > np.cos(cap_rad))
    others = near / len(centres) - 1.0 if n else 0.0
    return max(float(others / (4 * np.pi * np.sin(cap_rad / 2) ** 2)), n / (4 * np.pi))


def density_per_px2(xy_px: Array, size_px: tuple[int, int]) -> float:
    """Detections per square pixel where the detections (n, 2) are: of counts c in cells, sum c (c - 1) / sum c."""
    cell = max(size_px) / CELLS_ACROSS
    column, row = (np.maximum(xy_px, 0.0) / cell).astype(np.int64).T
    counts = np.bincount(row * CELLS_ACROSS + column).astype(np.float64)
    typical = float(np.sum(counts * (counts - 1.0)) / max(np.sum(counts), 1.0))
    return max(typical / cell**2, len(xy_px) / (size_px[0] * size_px[1]))
