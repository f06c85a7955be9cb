"""Statistics that several packages need: a robust estimate of spread, and weights of log-likelihoods."""

from __future__ import annotations

from typing import Any

import numpy as np

from startrack.core.values import Array

NORMAL_BY_MEDIAN = 1.4826  # standard deviation of a normal variable over the median of its absolute value


def robust_sigma(values: Any, centre: Any = None, axis: Any = None) -> Any:
    """Standard deviation of normal `values` (...) by the median of their absolute deviations; outliers hardly matter.

    `centre`: from where the deviations count; None: from the median. With `axis` an array, along that axis; else a
    float.
    """
    if centre is None:
        centre = np.median(values, axis=axis, keepdims=axis is not None)
    middle = np.median(np.abs(values - centre), axis=axis)
    return NORMAL_BY_MEDIAN * (float(middle) if axis is None else middle)


def relative_weights(log_weights: Array, axis: int | None = None) -> Array:
    """Exponentials (...) of `log_weights` (...), the largest of them, or of those along `axis`, scaled to 1."""
    return np.asarray(np.exp(log_weights - log_weights.max(axis=axis, keepdims=True)))


def shares(log_weights: Array) -> Array:
    """Exponentials (n,) of `log_weights` (n,), scaled so that their sum is 1."""
    return np.asarray(np.exp(log_weights - np.logaddexp.reduce(log_weights)))
