"""numba's compiler, its cache in a folder and without kernels of other sources, and Phi for kernels."""

from __future__ import annotations

from math import erfc, sqrt

import numpy as np

from startrack.core.compilation import choose_cache_folder, discard_stale_kernels

choose_cache_folder()
discard_stale_kernels()

from numba import njit  # noqa: E402 - numba reads where its cache lies when it loads

REORDERED_SUMS = {"reassoc", "contract", "nsz"}  # as `fastmath`: lets the compiler sum several pixels at a time
REACH, CDF_STEPS = 8.0, 4096  # of `normal_cdf`: standard deviations on either side, and steps of the table
TABLE = np.array([0.5 * erfc(-x / sqrt(2.0)) for x in np.linspace(-REACH, REACH, CDF_STEPS + 1)])


@njit(cache=True, nogil=True, inline="always")
def normal_cdf(x):  # type: ignore[no-untyped-def]
    """The normal distribution function Phi(x) by linear interpolation of a table, to 5e-7."""
    at = (min(max(x, -REACH), REACH) + REACH) * (CDF_STEPS / (2 * REACH))
    i = min(int(at), CDF_STEPS - 1)
    return TABLE[i] + (at - i) * (TABLE[i + 1] - TABLE[i])
