"""Log-likelihood ratio of a measured flux: the star is visible, against the ground hides it."""

from __future__ import annotations

import numpy as np

from startrack.core.types import Array

MISSING_PROBABILITY = 2e-3  # a visible star is not measured: variable, wrong entry, small obstacle
ANOMALY_PROBABILITY = 1e-3  # light where the ground is: track, reflection, defect
CAP = 9.0  # natural logarithm; largest evidence of one star


def visibility_llr(
    flux_e: Array, expected_e: Array, sigma_hidden_e: Array, sigma_shining_e: Array, cap: float = CAP
) -> Array:
    """ln p(flux | visible) - ln p(flux | hidden) (n,), capped.

    Visible: Gaussian about the expected flux, or with a small probability about nothing. Hidden: Gaussian about
    nothing, or with a small probability any flux up to twice the expected one.
    """
    at_star = _log_normal(flux_e - expected_e, sigma_shining_e)
    at_zero = _log_normal(flux_e, sigma_hidden_e)
    anything = -np.log(2.0 * expected_e + 10.0 * sigma_hidden_e)
    # Under either hypothesis the measurement may be an outlier; this floor limits the weight of one outlier.
    shines = np.logaddexp(np.log1p(-MISSING_PROBABILITY) + at_star, np.log(MISSING_PROBABILITY) + at_zero)
    shines = np.logaddexp(shines, np.log(ANOMALY_PROBABILITY) + anything)
    hidden = np.logaddexp(np.log1p(-ANOMALY_PROBABILITY) + at_zero, np.log(ANOMALY_PROBABILITY) + anything)
    return np.clip(shines - hidden, -cap, cap)


def gaussian_llr(flux_e: Array, expected_e: Array, sigma_hidden_e: Array, sigma_shining_e: Array) -> Array:
    """The ratio without outliers and without a cap, for comparisons only."""
    return _log_normal(flux_e - expected_e, sigma_shining_e) - _log_normal(flux_e, sigma_hidden_e)


def _log_normal(x: Array, sigma: Array) -> Array:
    return -0.5 * np.square(x / sigma) - np.log(sigma) - 0.5 * np.log(2 * np.pi)
