"""The evidence as a box of ground sees it on average: each sector's horizon anywhere between its bounds there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.localization.prefix_sums import Profile
from startrack.localization.sector_likelihood import SECTOR_STEP, Sectors
from startrack.terrain import Terrain
from startrack.types import Array

NARROWEST_RAD = 1e-6


@dataclass(frozen=True)
class Blurred:
    """Likelihood of boxes if each sector's horizon were equally likely anywhere between its bounds, on its own.

    Neither a bound nor exact, but no worse for large boxes than for small ones: among boxes of one size it tells which
    are worth a look. A sector's likelihood is a step function of the elevation of its horizon, so that its mean is a
    difference of a running integral.
    """

    key: Array  # (m,) sector and elevation in one ascending number, as in the profile
    integral: Array  # (m,) of the likelihood, up to there
    sectors: Sectors

    @classmethod
    def of(cls, sectors: Sectors, profile: Profile) -> Blurred:
        """From a profile of one part a sector."""
        visible = profile.total[profile.ends[profile.sector]] - profile.total[:-1]  # with a horizon below the ray
        below = np.exp(np.minimum(visible - sectors.ceiling[profile.sector], 0.0))
        hidden = np.exp(-sectors.ceiling)  # the whole sector
        middle = SECTOR_STEP * np.arange(sectors.count)
        key = np.concatenate([profile.key, middle - 0.5 * SECTOR_STEP, middle + 0.5 * SECTOR_STEP])
        value = np.concatenate([below, np.zeros(sectors.count), hidden])  # from the key before up to this one
        order = np.argsort(key, kind="stable")
        steps = value[order[1:]] * np.diff(key[order])
        return cls(key[order], np.concatenate([[0.0], np.cumsum(steps)]), sectors)

    def score(self, terrain: Terrain, centres_m: Array, half_m: float) -> Array:
        """Log-likelihood (n,) of boxes (n, 2)."""
        count = self.sectors.count
        azimuth, within = (2 * np.arange(count) + 1) * np.pi / count, np.pi / count
        boxes = centres_m[:, None, :]
        low, high = terrain.horizon_bounds_rad(boxes, np.array(half_m), azimuth, within)
        wider = terrain.max_horizon_sigma_rad(boxes, half_m, azimuth, within) + NARROWEST_RAD
        low, high = low - wider, high + wider
        start = SECTOR_STEP * np.arange(count)
        below = np.interp(high + start, self.key, self.integral) - np.interp(low + start, self.key, self.integral)
        mean = np.clip(below / (high - low), 0.0, 1.0)
        epsilon = self.sectors.epsilon
        return np.asarray(np.log((1.0 - epsilon) * mean + max(epsilon, 1e-300)).sum(axis=-1))
