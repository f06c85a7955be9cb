"""How many matches chance alone would give: the odds against which an identification is accepted."""

from __future__ import annotations

import numpy as np

from startrack.types import Array, Ints

MOST_CENTRES = 64
WIDEST_NEIGHBOURHOOD_RAD = np.radians(10.0)


class ChanceModel:
    """Expected number of chance coincidences between predicted stars and detections.

    Detections cluster (walls, clouds and trees leave part of the field empty), so the density that counts is the one
    met where the detections are: the mean number of others in a cap about each of them.
    """

    def __init__(self, detection_rays: Array, within_rad: float = WIDEST_NEIGHBOURHOOD_RAD) -> None:
        """Of the rays (n, 3); caps of radius `within_rad`, small against the field."""
        n = len(detection_rays)
        centres = detection_rays[:: -(-n // MOST_CENTRES)] if n else detection_rays
        near = np.count_nonzero(centres @ detection_rays.T > np.cos(within_rad))
        others = near / len(centres) - 1.0 if n else 0.0
        cap_sr = 4 * np.pi * np.sin(within_rad / 2) ** 2
        self.density_per_sr = max(float(others / cap_sr), n / (4 * np.pi))

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
