"""Values at even steps around the horizon, interpolated over azimuth."""

from __future__ import annotations

import numpy as np

from startrack.core.kernels import njit
from startrack.core.types import Array


def interpolate_circle(values: Array, azimuth_rad: Array) -> Array:
    """Linear interpolation at `azimuth_rad` (...) [rad] of `values` (m,), which stand at even steps from azimuth 0."""
    found = np.array(azimuth_rad, dtype=np.float64, order="C")
    _interpolate(np.ascontiguousarray(values, dtype=np.float64), found.reshape(-1))
    return found


@njit(cache=True)
def _interpolate(values, found):  # type: ignore[no-untyped-def]
    """Replace the azimuths (n,) [rad] in `found` by values (m,), given at even steps from azimuth 0 on."""
    m = len(values)
    for k in range(len(found)):
        at = found[k] * (m / (2 * np.pi))
        if at < 0.0 or at >= m:
            at %= m
        low = min(int(at), m - 1)
        part = at - low
        found[k] = (1.0 - part) * values[low] + part * values[low + 1 if low + 1 < m else 0]
