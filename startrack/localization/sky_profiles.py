"""Rows of extended light at one azimuth as one function of the horizon's elevation there: a spline for each azimuth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.core.statistics import NORMAL_CDF
from startrack.core.types import Array, Evidence, Ints
from startrack.kernels.library import kernel

EDGE_SIGMAS = 8.0  # beyond this the edge of a single row is not computed, and splines of rows are constant
KNOT_SIGMAS = 0.2  # of the edge: distance of the knots; a cubic errs by 0.03 nats in a sector of 2e4 nats


@dataclass(frozen=True, eq=False)
class SkyProfiles:
    """Log-likelihoods of the horizon's elevation at each of m azimuths, from rows of extended light.

    Rows of one azimuth stand or fall with the same horizon.
    """

    row: Ints  # (m,) one row of each azimuth
    low_rad: Array  # (m,) elevation of the first knot
    step_rad: Array  # (m,) between knots
    values: Array  # (m, knots)

    @classmethod
    def from_rows(cls, evidence: Evidence, rows: Ints) -> SkyProfiles:
        """From those `rows` (k,) of the evidence that hold extended light."""
        rows = rows[np.lexsort((evidence.elevation_rad[rows], evidence.azimuth_rad[rows]))]
        azimuth, elevation = evidence.azimuth_rad[rows], evidence.elevation_rad[rows]
        first = np.flatnonzero(np.diff(azimuth, prepend=-1.0) > 0)
        last = np.append(first[1:], len(rows)) - 1
        edge = evidence.edge_sigma_rad[rows[first]]
        around = EDGE_SIGMAS * edge
        low = elevation[first] - around
        span = elevation[last] - elevation[first] + 2 * around
        knots = max(int(np.ceil(np.max(span / (KNOT_SIGMAS * edge)))) + 1, 4)
        step = span / (knots - 1)
        values = np.empty((len(first), knots))
        _fill_profiles(
            elevation, evidence.llr[rows], evidence.extended_nats[rows], evidence.edge_sigma_rad[rows], first, last,
            low, step, NORMAL_CDF, values,
        )  # fmt: skip
        return cls(rows[first], low, step, values)


# Fills values (m, knots) with sums of l V + c V (1 - V) / 2 over the rows from first to last (m,).
_fill_profiles = kernel(
    "fill_profiles", "elevation: float64[n]", "llr: float64[n]", "extended: float64[n]", "sigma: float64[n]",
    "first: int64[m]", "last: int64[m]", "low: float64[m]", "step: float64[m]", f"cdf: float64[{len(NORMAL_CDF)}]",
    "values: out float64[m, knots]",
)  # fmt: skip
