"""The grid on which the skyline is estimated: columns of azimuth, and elevations."""

from __future__ import annotations

import numpy as np

from startrack.core.types import Array, Ints

BINS = 360  # of the result, one degree each
COLUMNS_PER_BIN = 4
COLUMNS = BINS * COLUMNS_PER_BIN
LOWEST_RAD, HIGHEST_RAD = np.radians(-5.0), np.radians(90.0)
STEP_RAD = np.radians(0.02)


def elevations_rad() -> Array:
    """Elevations (n,) of the grid, ascending."""
    return np.asarray(np.arange(LOWEST_RAD, HIGHEST_RAD + STEP_RAD / 2, STEP_RAD))


def column_azimuths_rad() -> Array:
    """Azimuths (COLUMNS,) of the columns' middles; the columns of bin k lie evenly about its azimuth of k degrees."""
    return np.asarray((np.arange(COLUMNS) + 0.5 - COLUMNS_PER_BIN / 2) * (2 * np.pi / COLUMNS))


def column_of(azimuth_rad: Array) -> Ints:
    """The column (n,) that each azimuth (n,) lies in."""
    return np.asarray(np.floor(azimuth_rad * (COLUMNS / (2 * np.pi)) + COLUMNS_PER_BIN / 2), dtype=np.int64) % COLUMNS
