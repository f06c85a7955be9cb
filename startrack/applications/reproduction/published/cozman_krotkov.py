"""A posterior over a grid of positions by the full skyline, and its bounds under contaminated priors.

Built from the description in Kua 2008, section 2.2 (its reference [11], Cozman), not from the paper: the full skyline
instead of line segments, a quasi-Bayesian formulation, a position and a measure of its quality. The heading is known.
Published errors: hundreds of metres, which scaled with the resolution of the map.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.applications.reproduction.published.skylines import PROFILE_BLOCK, MapGrid, require_bearings
from startrack.core.statistics import shares
from startrack.core.types import Array, MeasuredSkyline

TAIL_SHARE = 0.05  # of a bearing's elevations that say nothing: they may be anywhere between horizontal and zenith
CONTAMINATION = 0.1  # share of the prior that may be any other distribution


@dataclass(frozen=True, eq=False)
class BoundedPosition:
    """A mean position (2,) [m] and the bounds (2,), (2,) of the means under all priors of the class."""

    mean_m: Array
    low_m: Array
    high_m: Array


def locate_by_posterior(skyline: MeasuredSkyline, grid: MapGrid) -> BoundedPosition:
    """Posterior mean over the `grid` with its bounds; every position is equally likely before.

    Raises NotLocated for a `skyline` at too few bearings.
    """
    require_bearings(skyline)
    weights = shares(log_likelihoods(skyline, grid))
    low, high = bound_means(grid.points_m, weights, CONTAMINATION)
    return BoundedPosition(weights @ grid.points_m, low, high)


def log_likelihoods(skyline: MeasuredSkyline, grid: MapGrid) -> Array:
    """Log-likelihood (n,) of the `skyline` at each position of the `grid`: per bearing normal, with heavy tails."""
    known = skyline.known
    seen, sigma = (one[known].astype(np.float32) for one in (skyline.elevation_rad, skyline.sigma_rad))
    height = ((1.0 - TAIL_SHARE) / (np.sqrt(2 * np.pi) * sigma)).astype(np.float32)
    tail, found = np.float32(TAIL_SHARE / (np.pi / 2)), np.empty(len(grid.points_m))
    for start in range(0, len(found), PROFILE_BLOCK):
        part = slice(start, start + PROFILE_BLOCK)
        z = (grid.horizon_rad[part][:, known] - seen) / sigma
        found[part] = np.log(height * np.exp(-0.5 * z * z) + tail).sum(axis=1, dtype=np.float64)
    return found


def bound_means(points_m: Array, weights: Array, contamination: float) -> tuple[Array, Array]:
    """Least and greatest posterior mean (2,), (2,) [m] over the priors (1 - c) uniform + c q, q any distribution.

    `weights` (n,) are the likelihoods at `points_m` (n, 2), in any unit; c = `contamination`. The mean is a ratio of
    two functions that are linear in q, hence extreme for a q at one point.
    """
    clean = (1.0 - contamination) / len(weights)
    above, below = clean * (weights @ points_m), clean * weights.sum()
    means = (above + contamination * weights[:, None] * points_m) / (below + contamination * weights[:, None])
    return means.min(axis=0), means.max(axis=0)
