"""Errors of the skyline that are linear at any size, integrated in closed form: of the image, and waves of the map's.

Where sectors see heights of the skyline with known variances, the likeliest errors follow from a linear model, and the
integral over them is the density at these times a volume that is the same everywhere.

A gross error of the waves is a seam besides: between two azimuths the map is too high or too low by one normal error,
all pairs of SEAM_ENDS azimuths equally likely. It is integrated over its size in closed form, and summed over its ends.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from startrack.core.types import SECTORS, Array
from startrack.localization.neighbourhood import SectorRows
from startrack.localization.shared_errors import SharedErrors
from startrack.terrain import WAVES

SEAM_ENDS = 48  # azimuths where a seam may end


@dataclass(frozen=True, eq=False)
class LinearErrors:
    """Normal errors (j,) that raise the skyline, with the weights of the sectors that show them."""

    rise_rad: Array  # (SECTORS, j) by one unit of each
    mean: Array  # (j,)
    covariance: Array  # (j, j)
    wide_covariance: Array  # (j, j) of a normal distribution as wide as the errors with a seam
    weight: Array  # (SECTORS,) 1 / variance of the heights that the sectors see; next to 0 where the rows show none
    waves: int  # how many of them, the last ones, are waves of the map's error
    seams_rad: Array  # (SECTORS, c) by one standard deviation of each seam, of which there is one; c = 0: none

    @classmethod
    def of(cls, seen: SectorRows, errors: SharedErrors, gross: str, clear: Array) -> LinearErrors:
        """Linear errors of the image whose rows are `seen`, and of the waves among the shared `errors`.

        `gross` names the fact with a gross error, "" none. `clear` (SECTORS,) is how much each sector counts.
        """
        image, slopes = seen.image_errors, seen.around.wave_slopes_rad(errors)
        j, size = len(image.mean), len(image.mean) + len(errors.waves)
        plain, wide = np.zeros((2, size, size))
        for covariance, one in (plain, ""), (wide, gross):
            covariance[:j, :j], covariance[j:, j:] = image.covariance, np.diag(np.square(errors.waves_sigma_rad(one)))
        rise = np.column_stack([seen.image_rise, slopes.T])
        seams = WAVES.gross_sigma * list_seams() if errors.are_waves(gross) else np.zeros((SECTORS, 0))
        weight = clear * seen.moments.information / seen.moments.variance_rad2
        return cls(rise, np.r_[image.mean, np.zeros(size - j)], plain, wide, weight, size - j, seams)

    def __len__(self) -> int:
        return len(self.mean)

    @property
    def sigma_of_waves_rad(self) -> Array:
        """Rise (SECTORS, w) [rad] of the skyline by one standard deviation of each wave."""
        own = slice(len(self) - self.waves, None)
        return np.asarray(self.rise_rad[:, own] * np.sqrt(np.diag(self.covariance)[own]))

    @cached_property
    def inverse(self) -> Array:
        """Inverse (j, j) of the covariance."""
        return np.asarray(np.linalg.inv(self.covariance))

    @cached_property
    def expected_rad(self) -> Array:
        """Rise (SECTORS,) [rad] of the skyline by the expected errors."""
        return np.asarray(self.rise_rad @ self.mean)

    @cached_property
    def _information(self) -> Array:
        """Information (j, j) on the errors by the sectors and the prior."""
        return np.asarray((self.rise_rad.T * self.weight) @ self.rise_rad + self.inverse)

    @cached_property
    def gain(self) -> Array:
        """Matrix (j, SECTORS) from heights that are left to the likeliest errors."""
        return np.asarray(np.linalg.solve(self._information, self.rise_rad.T * self.weight))

    @cached_property
    def log_volume(self) -> float:
        """Logarithm of the integral over the errors, the norm of their prior in it, over the integrand at the best."""
        return 0.5 * float(np.linalg.slogdet(self.inverse)[1] - np.linalg.slogdet(self._information)[1])

    @cached_property
    def _score_of_seams(self) -> tuple[Array, Array]:
        """Gradient (SECTORS, c) with the size of each seam by heights that are left, and its information (c,)."""
        score = self.weight[:, None] * (self.seams_rad - self.rise_rad @ (self.gain @ self.seams_rad))
        return score, 1.0 + np.sum(self.seams_rad * score, axis=0)

    def fit(self, left_rad: Array) -> tuple[Array, Array]:
        """Rise (n, SECTORS) [rad] by the likeliest errors, less the expected, and the logarithm (n,) of a ratio.

        The ratio is that of the integral to the likelihood at these errors. `left_rad` (n, SECTORS) are the heights
        that the sectors see above the skyline with the expected errors.
        """
        errors, seam_rad, log = self._fit(left_rad)
        return errors @ self.rise_rad.T + seam_rad, log

    def _fit(self, left_rad: Array) -> tuple[Array, Array, Array]:
        """Errors (n, j) less their mean, rise (n, SECTORS) by a seam, and the logarithm; see `fit`."""
        seam_rad, log = np.zeros_like(left_rad), np.full(len(left_rad), self.log_volume)
        if self.seams_rad.shape[1]:
            score, information = self._score_of_seams
            gradient = left_rad @ score
            logs = 0.5 * np.square(gradient) / information - 0.5 * np.log(information)
            best = np.argmax(logs, axis=1)
            best_gradient = np.take_along_axis(gradient, best[:, None], axis=1)[:, 0]
            size = best_gradient / information[best]
            seam_rad = size[:, None] * self.seams_rad.T[best]
            log += np.logaddexp.reduce(logs, axis=1) - np.log(logs.shape[1])
            log -= 0.5 * (best_gradient * size + np.square(size))
        errors = (left_rad - seam_rad) @ self.gain.T
        return errors, seam_rad, log - 0.5 * np.einsum("ni,ij,nj->n", errors, self.inverse, errors)

    def waves_rad(self, left_rad: Array) -> Array:
        """Rise (SECTORS,) [rad] of the skyline by the likeliest waves and seam at `left_rad` (SECTORS,); see `fit`."""
        own, (errors, seam_rad, _) = slice(len(self) - self.waves, None), self._fit(left_rad[None])
        return np.asarray(self.rise_rad[:, own] @ errors[0, own] + seam_rad[0])


def list_seams() -> Array:
    """Membership (SECTORS, c), 1 or 0, of sectors in each seam; the rest of the circle is another, less a bias."""
    end = SECTORS // SEAM_ENDS * np.transpose(np.triu_indices(SEAM_ENDS, 1))
    sector = np.arange(SECTORS)[:, None]
    return np.asarray((sector >= end[:, 0]) & (sector < end[:, 1]), dtype=float)
