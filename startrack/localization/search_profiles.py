"""The rows over boxes of positions: the most that a skyline between two bounds can explain of them, and on average.

The log-likelihood F of a sector of azimuth is that of the published model. In place of the chain of obstacles each
sector may lie below its best level skyline by a limited amount: F less its greatest value, M, counts as
log((1 - e) exp(min(F - M, 0)) + e). So an obstacle costs the true position some nats a sector, and boxes can be bounded
sector by sector. Sectors in which everything is hidden, up to the zenith, cost SLACK_NATS once. A box counts each
row that its skylines may meet as it suits best.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import exp

import numpy as np

from startrack.core.types import SECTORS, Array, Evidence, Ints, sector_of
from startrack.kernels.library import kernel
from startrack.localization.likelihood.obstacle_chain import STOP
from startrack.localization.likelihood.skyline_profiles import EDGE_SIGMAS, ROW_NATS, declare, profiles_of, take

SEARCH_EPSILON = 0.1  # e: an obstacle costs the true position 2.3 nats a sector
LOWEST_RAD, HIGHEST_RAD = np.radians(-20.0), np.radians(92.0)  # elevations of skylines
SLACK_NATS = 44.0  # by which the published model may favour a position over the search: 29 degrees of obstacles
HIDE = exp(-SLACK_NATS)  # that all is hidden from one sector to the next: beside a wall the rest must not count less
STEP_RAD = np.radians(0.04)  # between them: boxes of 12 m see a rim 10 km away in 0.14 degrees
COUNT = int((HIGHEST_RAD - LOWEST_RAD) / STEP_RAD) + 1
TABLE = LOWEST_RAD, STEP_RAD, SEARCH_EPSILON, HIDE, STOP  # for the kernels


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
        """Profiles of the `rows` (n,) of an image."""
        sector, margin = sector_of(rows.azimuth_rad), EDGE_SIGMAS * rows.edge_sigma_rad
        hard = replace(rows, edge_sigma_rad=np.where(rows.extended_nats > 0.0, rows.edge_sigma_rad, 0.0))
        profiles = profiles_of(hard, rows.elevation_rad, np.zeros(SECTORS), (LOWEST_RAD, HIGHEST_RAD))
        llr = _counted_llr(rows)
        most = _greatest_contributions(llr, rows.extended_nats)
        integral, best = np.empty((SECTORS, COUNT)), np.empty(SECTORS)
        _fill_integral(*take(profiles, _CELLS), LOWEST_RAD, STEP_RAD, integral, best)
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
            np.ascontiguousarray(high_rad), *TABLE, np.empty(len(self.best)), found,
        )  # fmt: skip
        return found

    def score(self, sums: Array) -> float:
        """Log-likelihood of sums (SECTORS,) of the contributions of rows."""
        clear = (1.0 - SEARCH_EPSILON) * np.exp(np.minimum(sums - self.best, 0.0)) + SEARCH_EPSILON
        return float(_log_circle(clear, self.hidden, 1, HIDE, STOP))

    def average(self, low_rad: Array, high_rad: Array) -> Array:
        """Log-likelihoods (n,) where skylines are anywhere between (n, m) and (n, m), for m evenly spread sectors.

        Each sector's skyline is equally likely anywhere there, independently of the others.
        """
        found = np.empty(len(low_rad))
        low_rad, high_rad = np.ascontiguousarray(low_rad), np.ascontiguousarray(high_rad)
        _fill_averages(self.integral, self.hidden, low_rad, high_rad, *TABLE, np.empty(low_rad.shape[1]), found)
        return found


def sum_contributions(rows: Evidence, margin_rad: Array) -> Array:
    """Sums (SECTORS,) of the contributions of rows that stand `margin_rad` (n,) above the skyline.

    Stars have hard edges, and count for at most ROW_NATS.
    """
    from scipy.special import ndtr

    soft = rows.extended_nats > 0.0
    visible = np.where(margin_rad > 0.0, 1.0, 0.0)
    visible[soft] = ndtr(margin_rad[soft] / np.maximum(rows.edge_sigma_rad[soft], 1e-9))
    value = visible * (_counted_llr(rows) + 0.5 * rows.extended_nats * (1.0 - visible))
    return np.bincount(sector_of(rows.azimuth_rad), weights=value, minlength=SECTORS).astype(np.float64)


def _counted_llr(rows: Evidence) -> Array:
    """Log-likelihood ratios (n,) of rows; those of stars are cut off at ROW_NATS."""
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


# Adds to found (SECTORS, COUNT) the values of rows at their place in the table, and sums from the highest downwards.
_fill_sums = kernel(
    "sum_above", "sector: int64[n]", "at: float64[n]", "value: float64[n]", "found: out float64[sectors, count]"
)
_CELLS = "first x left right integral free"
_fill_integral = kernel(
    "fill_integral", *declare(_CELLS), "lowest: float64", "step: float64", "found: out float64[sectors, count]",
    "best: out float64[sectors]",
)  # fmt: skip
_CIRCLE = ("hide: float64", "stop: float64")
_TABLE = ("lowest: float64", "step: float64", "epsilon: float64", *_CIRCLE)
_fill_bounds = kernel(
    "fill_bounds", *(f"{name}: float64[sectors, count]" for name in ("visible", "open_from", "open_above")),
    "best: float64[sectors]", "hidden: float64[sectors]", "low: float64[n, sectors]", "high: float64[n, sectors]",
    *_TABLE, "scratch: out float64[sectors]", "found: out float64[n]",
)  # fmt: skip
_fill_averages = kernel(
    "fill_averages", "integral: float64[sectors, count]", "hidden: float64[sectors]", "low: float64[n, seen]",
    "high: float64[n, seen]", *_TABLE, "scratch: out float64[seen]", "found: out float64[n]",
)  # fmt: skip
# Logarithm of the trace around the circle: every so many sectors that are clear, or in which all is hidden.
_log_circle = kernel(
    "log_circle", "clear: float64[n]", "hidden: float64[sectors]", "every: int64", *_CIRCLE, result="float64"
)
