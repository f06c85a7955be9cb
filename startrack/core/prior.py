"""What the user knows about the position before an image is used."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.core.values import Array


@dataclass(frozen=True)
class PositionPrior:
    """A round normal distribution of the camera's position: mean and standard deviation [m] in enu.

    Raises ValueError for numbers that are not finite and a sigma that is not above 0.
    """

    east_m: float
    north_m: float
    sigma_m: float

    def __post_init__(self) -> None:
        if not np.isfinite([self.east_m, self.north_m, self.sigma_m]).all() or self.sigma_m <= 0:
            raise ValueError(f"prior {self}: three finite numbers are needed, and a sigma above 0")

    def __str__(self) -> str:
        return f"{self.east_m:g},{self.north_m:g},{self.sigma_m:g}"

    @property
    def mean_m(self) -> Array:
        """East and north (2,) [m]."""
        return np.array([self.east_m, self.north_m])

    def log_density(self, points_m: Array) -> Array:
        """Logarithm (n,) of the density at positions (n, 2) [m], less its maximum."""
        off = points_m - self.mean_m
        return np.asarray(-0.5 * np.einsum("ni,ni->n", off, off) / self.sigma_m**2)
