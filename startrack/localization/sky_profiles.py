"""Rows of extended light at one azimuth as one function of the horizon's elevation there: a spline for each azimuth."""

from __future__ import annotations

from dataclasses import dataclass

# mypy: disable-error-code="no-untyped-def"
import numpy as np

from startrack.core.kernels import njit, normal_cdf
from startrack.core.types import Array, Evidence, Ints

EDGE_SIGMAS = 8.0  # beyond this the edge of a single row is not computed, and splines of rows are constant
CERTAIN_SIGMAS = 6.0  # to the ends of a normal distribution: a ray beyond is visible or hidden, to 1e-9
KNOT_SIGMAS = 0.2  # of the edge: distance of the knots; a cubic errs by 0.03 nats in a sector of 2e4 nats
MAP_STEPS = 3.0  # points of the average in a standard deviation, of the map's error or of the sector's likelihood
LEAST_LIKELIHOOD = np.finfo(np.float64).tiny  # the floor of a sector is far above it


@dataclass(frozen=True, eq=False)
class SkyProfiles:
    """Log-likelihoods of the horizon's elevation at each of m azimuths, from rows of extended light.

    Rows of one azimuth stand or fall with the same horizon. An error of the map moves it below all of them together;
    its normal distribution is averaged over.
    """

    row: Ints  # (m,) one row of each azimuth
    low_rad: Array  # (m,) elevation of the first knot
    step_rad: Array  # (m,) between knots
    values: Array  # (m, knots)

    @classmethod
    def from_rows(cls, evidence: Evidence, rows: Ints, map_sigma_rad: Array) -> SkyProfiles:
        """From those `rows` (k,) of the evidence that hold extended light; `map_sigma_rad` (n,) is that of each row."""
        rows = rows[np.lexsort((evidence.elevation_rad[rows], evidence.azimuth_rad[rows]))]
        azimuth, elevation = evidence.azimuth_rad[rows], evidence.elevation_rad[rows]
        first = np.flatnonzero(np.diff(azimuth, prepend=-1.0) > 0)
        last = np.append(first[1:], len(rows)) - 1
        edge, map_sigma = evidence.edge_sigma_rad[rows[first]], map_sigma_rad[rows[first]]
        around = EDGE_SIGMAS * edge + CERTAIN_SIGMAS * map_sigma
        low = elevation[first] - around
        span = elevation[last] - elevation[first] + 2 * around
        knots = max(int(np.ceil(np.max(span / (KNOT_SIGMAS * edge)))) + 1, 4)
        step = span / (knots - 1)
        values = np.empty((len(first), knots))
        _fill_profiles(
            elevation, evidence.llr[rows], evidence.extended_nats[rows], evidence.edge_sigma_rad[rows], first, last,
            low, step, values,
        )  # fmt: skip
        moved = np.flatnonzero(map_sigma > 0.0)
        if len(moved):
            values[moved] = _average_over_map(values[moved], map_sigma[moved] / step[moved])
        return cls(rows[first], low, step, values)


def _average_over_map(values: Array, sigma_knots: Array) -> Array:
    """Logarithms (m, knots) of the means of exp(values) over normal shifts of the horizon by `sigma_knots` (m,).

    A bright sky determines the horizon to a part of a knot: the mean is taken over points between the knots.
    """
    from scipy.interpolate import CubicSpline

    sharpest = 1.0 / np.sqrt(np.maximum(-np.diff(values, 2, axis=1).min(axis=1), 1e-12))
    fine = np.maximum(np.ceil(MAP_STEPS / np.minimum(sharpest, sigma_knots)), 1.0).astype(np.int64)
    cubics = CubicSpline(np.arange(values.shape[1]), values, axis=1).c
    averaged = np.empty_like(values)
    _fill_averages(values, np.ascontiguousarray(np.moveaxis(cubics, -1, 0)), fine, sigma_knots, averaged)
    return averaged


@njit(cache=True)
def _fill_averages(values, cubics, fine, sigma_knots, averaged):
    """Fill averaged (m, knots) from cubics (m, 4, knots - 1) taken at `fine` (m,) points between two knots."""
    knots = values.shape[1]
    for m in range(len(values)):
        last = (knots - 1) * fine[m]
        between = np.empty(last + 1)
        for j in range(knots - 1):
            a, b, c, d = cubics[m, 0, j], cubics[m, 1, j], cubics[m, 2, j], cubics[m, 3, j]
            for i in range(fine[m]):
                u = i / fine[m]
                between[j * fine[m] + i] = ((a * u + b) * u + c) * u + d
        between[last] = values[m, knots - 1]
        top = between.max()
        likelihood = np.exp(between - top)
        reach = max(int(np.ceil(CERTAIN_SIGMAS * sigma_knots[m] * fine[m])), 1)
        weight = np.exp(-0.5 * (np.arange(-reach, reach + 1) / (sigma_knots[m] * fine[m])) ** 2)
        weight /= weight.sum()
        for j in range(knots):
            mean = 0.0
            for i in range(-reach, reach + 1):
                mean += weight[i + reach] * likelihood[min(max(j * fine[m] + i, 0), last)]
            averaged[m, j] = top + np.log(max(mean, LEAST_LIKELIHOOD))


@njit(cache=True)
def _fill_profiles(elevation, llr, extended, sigma, first, last, low, step, values):
    """Fill values (m, knots) with sums of l V + c V (1 - V) / 2 over the rows from first to last (m,)."""
    for m in range(len(first)):
        for j in range(values.shape[1]):
            horizon, total = low[m] + j * step[m], 0.0
            for k in range(first[m], last[m] + 1):
                visible = normal_cdf((elevation[k] - horizon) / sigma[k])
                total += visible * (llr[k] + 0.5 * extended[k] * (1.0 - visible))
            values[m, j] = total
