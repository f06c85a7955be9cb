"""Log-likelihood ratio of a measured flux: the star shines, against the wall hides it."""

from __future__ import annotations

import numpy as np

from startrack.types import Array

STRANGE_WHEN_SHINING = 2e-3  # a visible star is not measured as it should be: variable, wrong entry, small obstacle
STRANGE_WHEN_HIDDEN = 1e-3  # light where the wall is: track, reflection, defect
CAP = 9.0  # nothing that one star says is worth more


def visibility_llr(
    flux_e: Array, expected_e: Array, sigma_hidden_e: Array, sigma_shining_e: Array, cap: float = CAP
) -> Array:
    """ln p(flux | shines) - ln p(flux | hidden) (n,), capped.

    Shining: Gaussian about the expected flux, or with a small probability about nothing. Hidden: Gaussian about
    nothing, or with a small probability any flux up to twice the expected one.
    """
    at_star = _log_normal(flux_e - expected_e, sigma_shining_e)
    at_zero = _log_normal(flux_e, sigma_hidden_e)
    anything = -np.log(2.0 * expected_e + 10.0 * sigma_hidden_e)
    # Whatever the hypothesis, something else may have happened; that floor keeps one oddity from ruling the fix.
    shines = np.logaddexp(np.log1p(-STRANGE_WHEN_SHINING) + at_star, np.log(STRANGE_WHEN_SHINING) + at_zero)
    shines = np.logaddexp(shines, np.log(STRANGE_WHEN_HIDDEN) + anything)
    hidden = np.logaddexp(np.log1p(-STRANGE_WHEN_HIDDEN) + at_zero, np.log(STRANGE_WHEN_HIDDEN) + anything)
    return np.clip(shines - hidden, -cap, cap)


def gaussian_llr(flux_e: Array, expected_e: Array, sigma_hidden_e: Array, sigma_shining_e: Array) -> Array:
    """The same without any cap, as if nothing strange ever happened: to compare with, not to rely on."""
    return _log_normal(flux_e - expected_e, sigma_shining_e) - _log_normal(flux_e, sigma_hidden_e)


def _log_normal(x: Array, sigma: Array) -> Array:
    return -0.5 * np.square(x / sigma) - np.log(sigma) - 0.5 * np.log(2 * np.pi)
