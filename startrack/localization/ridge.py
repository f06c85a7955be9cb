"""A low ridge on no map: a rise of the skyline over a range of azimuths, found beside a fix that it has displaced.

Such a ridge leaves no patch of missing stars once the position has moved to meet it. But a wrong position raises the
skyline on one side and lowers it on the other as no ridge does, so that what is left still has the form of a rise.
"""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
import numpy as np

from startrack.kernels import njit
from startrack.localization.likelihood import SECTOR_EPSILON
from startrack.localization.sector_likelihood import Sectors, row_contribution
from startrack.types import Array, Bools, Evidence

LEVELS_RAD = np.radians(np.arange(-1.0, 4.0, 0.05))  # above the map's skyline
MOST_RISE_RAD = np.radians(5.0)  # rows farther from a coarse skyline are not needed
HALF_WIDTHS = np.array([5, 10, 17, 28, 47])  # sectors, of a triangular rise: 15 to 141 degrees wide
HEIGHTS_RAD = np.radians([0.1, 0.2, 0.35, 0.6, 1.0, 1.6])
CENTRE_STEP = 4  # sectors, between the rises that are tried
FLANK_PART = 0.15  # of the half width, left out beyond it: a ridge is no triangle
MIN_GAIN_NATS = 7.5  # of 120 true positions in a crater two gain 7, the others at most 6.3; 14 on a map at most 5


def find_ridge(rows: Evidence, above_rad: Array, sigma_rad: Array, count: int) -> Bools:
    """Which of `count` sectors of azimuth show a rise of the skyline; none where it fits as it is.

    `above_rad` (n,): how far the `rows` stand above the skyline of the fix, which has errors `sigma_rad` (n,).
    """
    gains = rise_gains(level_table(rows, above_rad, sigma_rad, count))
    centre, width, height = np.unravel_index(int(np.argmax(gains)), gains.shape)
    reach = 0.0
    if gains[centre, width, height] > MIN_GAIN_NATS:
        reach = HALF_WIDTHS[width] * (1.0 + FLANK_PART)
    away = np.abs((np.arange(count) - centre * CENTRE_STEP + count // 2) % count - count // 2)
    return np.asarray(away < reach)


def rise_gains(table: Array) -> Array:
    """Gains [nats] (centres, widths, heights) of rises over none; `table` (sectors, levels): log-likelihoods."""
    centres = np.arange(0, len(table), CENTRE_STEP)
    gains = np.empty((len(centres), len(HALF_WIDTHS), len(HEIGHTS_RAD)))
    _fill_gains(table, LEVELS_RAD[0], LEVELS_RAD[1] - LEVELS_RAD[0], centres, HALF_WIDTHS, HEIGHTS_RAD, gains)
    return gains


def level_table(rows: Evidence, above_rad: Array, sigma_rad: Array, count: int) -> Array:
    """Log-likelihoods (sectors, levels) where the skyline of a sector stands so much above that of the fix."""
    near = np.flatnonzero((above_rad > LEVELS_RAD[0]) & (above_rad < LEVELS_RAD[-1]))
    sectors = Sectors.from_evidence(rows.take(near), 2 * np.pi / count, SECTOR_EPSILON)
    sums, e = np.zeros((count, len(LEVELS_RAD))), sectors.evidence
    sigma = np.hypot(e.edge_sigma_rad, sigma_rad[near])
    _add_levels(above_rad[near], e.llr, e.extended_nats, sigma, sectors.sector, LEVELS_RAD, sums)
    return np.ascontiguousarray(sectors.by_sector(sums.T).T)


@njit(cache=True, nogil=True)
def _add_levels(above, llr, extended, sigma, sector, levels, sums):
    """Add to sums (sectors, levels) the rows' contributions where the skyline stands at the levels."""
    for k in range(len(llr)):
        for j in range(len(levels)):
            margin = above[k] - levels[j]
            if sigma[k] > 0.0:
                sums[sector[k], j] += row_contribution(llr[k], extended[k], margin / sigma[k], 0)
            elif margin > 0.0:
                sums[sector[k], j] += llr[k]


@njit(cache=True, nogil=True)
def _fill_gains(table, first, step, centres, half_widths, heights, gains):
    """Fill gains (centres, widths, heights) of triangular rises."""
    n, last = table.shape[0], table.shape[1] - 2
    zero = round(-first / step)
    for i in range(len(centres)):
        for j in range(len(half_widths)):
            for h in range(len(heights)):
                total = 0.0
                for d in range(1 - half_widths[j], half_widths[j]):
                    s = (centres[i] + d) % n
                    level = (heights[h] * (1.0 - abs(d) / half_widths[j]) - first) / step
                    k = min(int(level), last)
                    total += table[s, k] + (level - k) * (table[s, k + 1] - table[s, k]) - table[s, zero]
                gains[i, j, h] = total
