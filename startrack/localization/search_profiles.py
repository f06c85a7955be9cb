"""The rows over boxes of positions: the most that a skyline between two bounds can explain of them, and on average.

The log-likelihood F of a sector of azimuth is that of the published model. In place of the chain of obstacles each
sector may lie below its best level skyline by a limited amount: F less its greatest value, M, counts as
log((1 - e) exp(min(F - M, 0)) + e). So an obstacle costs the true position some nats a sector, and boxes can be bounded
sector by sector. Sectors in which everything is hidden, up to the zenith, cost SLACK_NATS once. A box counts each
row that its skylines may meet as it suits best.
"""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
from dataclasses import dataclass, replace
from math import exp, floor, log

import numpy as np

from startrack.core.kernels import njit
from startrack.core.types import SECTORS, Array, Evidence, Ints, sector_of
from startrack.localization.obstacle_chain import STOP
from startrack.localization.skyline_profiles import EDGE_SIGMAS, ROW_NATS, profiles_of

SEARCH_EPSILON = 0.1  # e: an obstacle costs the true position 2.3 nats a sector
LOWEST_RAD, HIGHEST_RAD = np.radians(-20.0), np.radians(92.0)  # elevations of skylines
SLACK_NATS = 44.0  # by which the published model may favour a position over the search: 29 degrees of obstacles
HIDE = exp(-SLACK_NATS)  # that all is hidden from one sector to the next: beside a wall the rest must not count less
STEP_RAD = np.radians(0.04)  # between them: boxes of 12 m see a rim 10 km away in 0.14 degrees
COUNT = int((HIGHEST_RAD - LOWEST_RAD) / STEP_RAD) + 1


@dataclass(frozen=True, eq=False)
class SearchProfiles:
    """Sums over the rows of each sector, at elevations of its skyline (SECTORS, COUNT), as the kernels read them."""

    visible: Array  # of the llr of rows that stand above for certain
    open_from: Array  # of the greatest contributions of rows that may stand above
    open_above: Array  # and of those that stand above for certain
    integral: Array  # of exp (F - M) up to the elevation
    best: Array  # (SECTORS,) M
    hidden: Array  # (SECTORS,) exp(-M): likelihood if everything is hidden

    @classmethod
    def of(cls, rows: Evidence) -> SearchProfiles:
        """Of rows (n,)."""
        sector, margin = sector_of(rows.azimuth_rad), EDGE_SIGMAS * rows.edge_sigma_rad
        hard = replace(rows, edge_sigma_rad=np.where(rows.extended_nats > 0.0, rows.edge_sigma_rad, 0.0))
        profiles = profiles_of(hard, rows.elevation_rad, np.zeros(SECTORS), (LOWEST_RAD, HIGHEST_RAD))
        llr = _counted_llr(rows)
        most = _greatest_contributions(llr, rows.extended_nats)
        integral, best = np.empty((SECTORS, COUNT)), np.empty(SECTORS)
        _fill_integral(profiles, integral, best)
        return cls(
            _sum_above(sector, rows.elevation_rad - margin, llr),
            _sum_above(sector, rows.elevation_rad + margin, most),
            _sum_above(sector, rows.elevation_rad - margin, most), integral, best, np.exp(-best),
        )  # fmt: skip

    def bound(self, low_rad: Array, high_rad: Array) -> Array:
        """Upper bounds (n,) of the log-likelihood where skylines are between (n, SECTORS) and (n, SECTORS)."""
        found = np.empty(len(low_rad))
        _fill_bounds(
            self.visible, self.open_from, self.open_above, self.best, self.hidden, np.ascontiguousarray(low_rad),
            np.ascontiguousarray(high_rad), found,
        )  # fmt: skip
        return found

    def score(self, sums: Array) -> float:
        """Log-likelihood of sums (SECTORS,) of the contributions of rows."""
        clear = (1.0 - SEARCH_EPSILON) * np.exp(np.minimum(sums - self.best, 0.0)) + SEARCH_EPSILON
        return float(_log_circle(clear, self.hidden, 1))

    def average(self, low_rad: Array, high_rad: Array) -> Array:
        """Log-likelihoods (n,) where skylines are anywhere between (n, m) and (n, m), for m evenly spread sectors.

        Each sector's skyline is equally likely anywhere there, independently of the others.
        """
        found = np.empty(len(low_rad))
        _fill_averages(self.integral, self.hidden, np.ascontiguousarray(low_rad), np.ascontiguousarray(high_rad), found)
        return found


def sum_contributions(rows: Evidence, margin_rad: Array) -> Array:
    """Sums (SECTORS,) of the contributions of rows that stand `margin_rad` (n,) above the skyline.

    Of stars as far as one counts, with hard edges.
    """
    from scipy.special import ndtr

    soft = rows.extended_nats > 0.0
    visible = np.where(margin_rad > 0.0, 1.0, 0.0)
    visible[soft] = ndtr(margin_rad[soft] / np.maximum(rows.edge_sigma_rad[soft], 1e-9))
    value = visible * (_counted_llr(rows) + 0.5 * rows.extended_nats * (1.0 - visible))
    return np.bincount(sector_of(rows.azimuth_rad), weights=value, minlength=SECTORS).astype(np.float64)


def _counted_llr(rows: Evidence) -> Array:
    """The llr (n,) of rows; of a star as far as one counts."""
    return np.where(rows.extended_nats > 0.0, rows.llr, np.clip(rows.llr, -ROW_NATS, ROW_NATS))


def _greatest_contributions(llr: Array, extended: Array) -> Array:
    """Greatest contribution (n,) of each row over all visible fractions from 0 to 1."""
    most = np.maximum(llr, 0.0)
    inner = np.abs(llr) < 0.5 * extended  # the parabola has its top inside
    most[inner] = np.maximum(most[inner], np.square(llr[inner] + 0.5 * extended[inner]) / (2 * extended[inner]))
    return most


def _sum_above(sector: Ints, elevation_rad: Array, value: Array) -> Array:
    """Sums (SECTORS, COUNT) of the values of rows at or above each elevation."""
    found = np.zeros((SECTORS, COUNT))
    _fill_sums(sector, (elevation_rad - LOWEST_RAD) / STEP_RAD, value, found)
    return found


@njit(cache=True)
def _fill_sums(sector, at, value, found):
    for k in range(len(sector)):
        if at[k] >= 0.0:
            found[sector[k], min(int(at[k]), COUNT - 1)] += value[k]
    for s in range(len(found)):
        for i in range(COUNT - 2, -1, -1):
            found[s, i] += found[s, i + 1]


@njit(cache=True)
def _fill_integral(profiles, integral, best):
    for s in range(len(best)):
        k, last = profiles.first[s], profiles.first[s + 1] - 1
        best[s] = -np.inf
        for j in range(k, last):
            best[s] = max(best[s], profiles.left[j], profiles.right[j])
        scale = exp(profiles.free[s] - best[s])
        for i in range(integral.shape[1]):
            at = LOWEST_RAD + i * STEP_RAD
            while k < last - 1 and profiles.x[k + 1] <= at:
                k += 1
            u = (at - profiles.x[k]) / (profiles.x[k + 1] - profiles.x[k])
            integral[s, i] = scale * (profiles.integral[k] + u * (profiles.integral[k + 1] - profiles.integral[k]))


@njit(cache=True)
def _fill_bounds(visible, open_from, open_above, best, hidden, low, high, found):
    clear = np.empty(len(best))
    for n in range(len(found)):
        for s in range(len(best)):
            a = min(max(floor((low[n, s] - LOWEST_RAD) / STEP_RAD), 0), COUNT - 2)
            b = min(max(floor((high[n, s] - LOWEST_RAD) / STEP_RAD), 0), COUNT - 2) + 1
            value = visible[s, b] + open_from[s, a] - open_above[s, b] - best[s]
            clear[s] = 1.0  # within a sector a real skyline hardly beats the best level one
            if value < 0.0:
                clear[s] = (1.0 - SEARCH_EPSILON) * exp(value) + SEARCH_EPSILON
        found[n] = _log_circle(clear, hidden, 1)


@njit(cache=True)
def _fill_averages(integral, hidden, low, high, found):
    every, clear = len(integral) // low.shape[1], np.empty(low.shape[1])
    for n in range(len(found)):
        for k in range(low.shape[1]):
            rise = _integral_to(integral[k * every], high[n, k]) - _integral_to(integral[k * every], low[n, k])
            mean = min(max(rise / (high[n, k] - low[n, k]), 0.0), 1.0)
            clear[k] = (1.0 - SEARCH_EPSILON) * mean + SEARCH_EPSILON
        found[n] = _log_circle(clear, hidden, every)


@njit(cache=True)
def _log_circle(clear, hidden, every):
    """Logarithm of the trace around the circle: every so many sectors that are clear, or in which all is hidden."""
    total, a, b, c, d = 0.0, 1.0, 0.0, 0.0, 1.0  # rows of the product: begun clear, begun hidden
    for k in range(len(clear)):
        e, h = clear[k], hidden[k * every]
        a, b = (a * (1.0 - HIDE) + b * STOP) * e, (a * HIDE + b * (1.0 - STOP)) * h
        c, d = (c * (1.0 - HIDE) + d * STOP) * e, (c * HIDE + d * (1.0 - STOP)) * h
        if k % 16 == 15:
            size = a + b + c + d
            a, b, c, d = a / size, b / size, c / size, d / size
            total += log(size)
    return total + log(a + d)


@njit(cache=True, inner=True)
def _integral_to(integral, elevation):
    """The integral of a sector up to an elevation, linear between those of the table."""
    at = (elevation - LOWEST_RAD) / STEP_RAD
    i = min(max(floor(at), 0), COUNT - 2)
    return integral[i] + (at - i) * (integral[i + 1] - integral[i])
