"""Errors of the skyline that are linear at any size, integrated in closed form: of the image, and waves of the map's.

Where sectors see heights of the skyline with known variances, the likeliest errors follow from a linear model, and the
integral over them is the density at these times a volume that is the same everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from startrack.core.types import Array
from startrack.localization.neighbourhood import SectorRows
from startrack.localization.shared_errors import SharedErrors


@dataclass(frozen=True, eq=False)
class LinearErrors:
    """Normal errors (j,) that raise the skyline, with the weights of the sectors that show them."""

    rise_rad: Array  # (SECTORS, j) by one unit of each
    mean: Array  # (j,)
    covariance: Array  # (j, j)
    weight: Array  # (SECTORS,) 1 / variance of the heights that the sectors see
    waves: int  # how many of them, the last ones, are waves of the map's error

    @classmethod
    def of(cls, seen: SectorRows, errors: SharedErrors, gross: str, clear: Array) -> LinearErrors:
        """Of the image whose rows are `seen`, and of the waves among the shared `errors`.

        `gross` names the fact with a gross error, "" none. `clear` (SECTORS,) is how much each sector counts.
        """
        image, slopes = seen.image_errors, seen.around.wave_slopes_rad(errors)
        w, j = len(errors.waves), len(image.mean)
        covariance = np.zeros((j + w, j + w))
        covariance[:j, :j], covariance[j:, j:] = image.covariance, np.diag(np.square(errors.waves_sigma_rad(gross)))
        rise = np.column_stack([seen.image_rise, slopes.T])
        return cls(rise, np.r_[image.mean, np.zeros(w)], covariance, clear / seen.moments.variance_rad2, w)

    def __len__(self) -> int:
        return len(self.mean)

    @property
    def sigma_of_waves_rad(self) -> Array:
        """(SECTORS, w) rise of the skyline by one standard deviation of each wave."""
        own = slice(len(self) - self.waves, None)
        return np.asarray(self.rise_rad[:, own] * np.sqrt(np.diag(self.covariance)[own]))

    @cached_property
    def inverse(self) -> Array:
        """(j, j) of the covariance."""
        return np.asarray(np.linalg.inv(self.covariance))

    @cached_property
    def expected_rad(self) -> Array:
        """(SECTORS,) rise of the skyline by the expected errors."""
        return np.asarray(self.rise_rad @ self.mean)

    @cached_property
    def _information(self) -> Array:
        """(j, j) by the sectors and the prior."""
        return np.asarray((self.rise_rad.T * self.weight) @ self.rise_rad + self.inverse)

    @cached_property
    def gain(self) -> Array:
        """(j, SECTORS) from heights that are left to the likeliest errors."""
        return np.asarray(np.linalg.solve(self._information, self.rise_rad.T * self.weight))

    @cached_property
    def log_volume(self) -> float:
        """Logarithm of the integral over the errors, the norm of their prior in it, over the integrand at the best."""
        return 0.5 * float(np.linalg.slogdet(self.inverse)[1] - np.linalg.slogdet(self._information)[1])

    def fit(self, left_rad: Array) -> tuple[Array, Array]:
        """The likeliest errors (n, j) less their mean, and the logarithm (n,) of the integral to the likelihood.

        `left_rad` (n, SECTORS) are the heights that the sectors see above the skyline with the expected errors.
        """
        errors = left_rad @ self.gain.T
        return errors, self.log_volume - 0.5 * np.einsum("ni,ij,nj->n", errors, self.inverse, errors)

    def waves_rad(self, left_rad: Array) -> Array:
        """(SECTORS,) rise of the skyline by the likeliest waves at `left_rad` (SECTORS,); see `fit`."""
        own = slice(len(self) - self.waves, None)
        return np.asarray(self.rise_rad[:, own] @ self.fit(left_rad[None])[0][0, own])
