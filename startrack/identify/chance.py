"""How many matches chance alone would give: the odds against which an identification is accepted."""

from __future__ import annotations

from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from startrack.types import Array, Ints

MOST_WITHOUT_TREE = 800
GRID_POINTS = 600
NEIGHBOURHOOD_RAD = np.radians(10.0)


class ChanceModel:
    """Expected number of chance coincidences between predicted stars and detections.

    Detections cluster (walls, clouds and trees leave part of the field empty), so the density that counts is the one
    met where the detections are: of counts c on a grid of overlapping caps, sum c (c - 1) over sum c.
    """

    def __init__(self, detection_rays: Array) -> None:
        self.rays = detection_rays
        counts = self._counts(_fibonacci_sphere(GRID_POINTS))
        cap_sr = 2 * np.pi * (1 - np.cos(NEIGHBOURHOOD_RAD))
        occupied = float(np.sum(counts))
        typical = float(np.sum(counts * (counts - 1.0))) / occupied if occupied else 0.0
        self.density_per_sr = max(typical / cap_sr, len(detection_rays) / (4 * np.pi))

    @cached_property
    def tree(self) -> Any:
        """scipy.spatial.cKDTree over the detections' rays."""
        from scipy.spatial import cKDTree

        return cKDTree(self.rays)

    def _counts(self, centres: Array) -> Array:
        """Detections in the cap about each of the centres (m, 3)."""
        if len(self.rays) <= MOST_WITHOUT_TREE:  # all against all is quicker than a tree
            near = centres @ self.rays.T > np.cos(NEIGHBOURHOOD_RAD)
            return (near.astype(np.float32) @ np.ones(len(self.rays), dtype=np.float32)).astype(np.float64)
        chord = 2 * np.sin(NEIGHBOURHOOD_RAD / 2)
        found: Array = self.tree.query_ball_point(centres, chord, return_length=True)
        return found.astype(np.float64)

    def probability(self, radius_rad: Array | float) -> Array:
        """Probability that at least one detection lies within the radius of a random direction among the detections."""
        return -np.expm1(-self.density_per_sr * np.pi * np.square(radius_rad))

    def log_odds(self, matched: Ints, predicted: Ints, radius_rad: float, given: int = 3, alike: float = 1.0) -> Array:
        """log P(at least `matched` of `predicted` stars coincide by chance), the `given` of the pattern not counted.

        `alike`: probability that a chance coincidence is accepted as equally bright.
        """
        from scipy.special import betainc

        n = np.maximum(predicted - given, 0)
        k = np.maximum(matched - given, 0)
        # The binomial tail as an incomplete beta function: P(X >= k) = I_p(k, n - k + 1).
        tail = betainc(np.maximum(k, 1), np.maximum(n - k, 0) + 1, alike * self.probability(radius_rad))
        return np.where(k > 0, np.log(np.maximum(tail, 1e-300)), 0.0)


@lru_cache(maxsize=1)
def _fibonacci_sphere(n: int) -> Array:
    """Nearly even unit vectors (n, 3)."""
    i = np.arange(n) + 0.5
    z = 1 - 2 * i / n
    azimuth = np.pi * (1 + np.sqrt(5.0)) * i
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(azimuth), r * np.sin(azimuth), z], axis=1)
