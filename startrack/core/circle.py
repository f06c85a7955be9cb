"""Values at even steps around the horizon, interpolated over azimuth."""

from __future__ import annotations

import numpy as np

from startrack.core.types import Array
from startrack.kernels.library import kernel


def interpolate_circle(values: Array, azimuth_rad: Array) -> Array:
    """Linear interpolation at `azimuth_rad` (...) [rad] of `values` (m,), which stand at even steps from azimuth 0."""
    found = np.array(azimuth_rad, dtype=np.float64, order="C")
    _interpolate(np.ascontiguousarray(values, dtype=np.float64), found.reshape(-1))
    return found


_interpolate = kernel("interpolate_circle", "values: float64[m]", "found: out float64[n]")
