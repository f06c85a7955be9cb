"""The normal distribution function, from a table: compiled code that needs it for every pixel or every knot."""

from __future__ import annotations

from math import erfc, sqrt

import numpy as np

from startrack.core.kernels import njit

REACH, STEPS = 8.0, 4096  # standard deviations on either side, and steps of the table: linear, to 5e-7
TABLE = np.array([0.5 * erfc(-x / sqrt(2.0)) for x in np.linspace(-REACH, REACH, STEPS + 1)])


@njit(cache=True, nogil=True, inline="always")
def normal_cdf(x):  # type: ignore[no-untyped-def]
    """Phi(x), to 5e-7."""
    at = (min(max(x, -REACH), REACH) + REACH) * (STEPS / (2 * REACH))
    i = min(int(at), STEPS - 1)
    return TABLE[i] + (at - i) * (TABLE[i + 1] - TABLE[i])
