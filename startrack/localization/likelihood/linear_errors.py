"""Errors of the skyline that are linear at any size, integrated in closed form: of the image, and waves of the map's.

At a skyline, the errors of the image are shown by the light of the sky alone, which they lift above it; the waves by
all rows, which see the skyline where it is. Where sectors see heights with known variances, the likeliest errors follow
from a linear model, and the integral over them is the density at these times a volume that is the same everywhere.

A gross error of the waves is a seam besides: between two azimuths the map is too high or too low by one normal error,
all pairs of SEAM_ENDS azimuths equally likely. It is integrated over its size in closed form, and summed over its ends.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from startrack.core.types import SECTORS, Array
from startrack.localization.likelihood.neighbourhood import SectorRows
from startrack.localization.likelihood.shared_errors import SharedErrors
from startrack.terrain import WAVES

SEAM_ENDS = 48  # azimuths where a seam may end


class Lifts(NamedTuple):
    """Errors (i,) of the image, which lift the light of the sky above the skyline, and what this light alone shows."""

    lift_rad: Array  # (SECTORS, i) by one unit of each
    weight: Array  # (SECTORS,) 1 / variance of the light's height; at most that of the light and the stars together
    above_rad: Array  # (SECTORS,) height of the light above that of light and stars together


NO_LIFTS = Lifts(np.zeros((SECTORS, 0)), np.zeros(SECTORS), np.zeros(SECTORS))


@dataclass(frozen=True, eq=False)
class LinearErrors:
    """Normal errors (j,), first the image's beyond their reference, with the weights of the sectors that show them.

    The reference is the lift that is expected: it is taken out of the heights of the light.
    """

    rise_rad: Array  # (SECTORS, j) of the skyline that light and stars together show, by one unit of each
    mean: Array  # (j,)
    covariance: Array  # (j, j)
    wide_covariance: Array  # (j, j) of a normal distribution as wide as the errors with a seam
    weight: Array  # (SECTORS,) 1 / variance of the heights that the sectors see; next to 0 where the rows show none
    waves: int  # how many of them, the last ones, are waves of the map's error
    seams_rad: Array  # (SECTORS, c) by one standard deviation of each seam, of which there is one; c = 0: none
    lifts: Lifts = NO_LIFTS

    @classmethod
    def of(cls, seen: SectorRows, errors: SharedErrors, gross: str, sector_weight: Array) -> LinearErrors:
        """Linear errors of the image whose rows are `seen`, and of the waves among the shared `errors`.

        `gross` names the fact with a gross error, "" none. `sector_weight` (SECTORS,) is how much each sector counts.
        """
        image, slopes = seen.image_errors, seen.around.wave_slopes_rad(errors)
        j, size = len(image.mean), len(image.mean) + len(errors.waves)
        plain, wide = np.zeros((2, size, size))
        for covariance, one in (plain, ""), (wide, gross):
            covariance[:j, :j], covariance[j:, j:] = image.covariance, np.diag(np.square(errors.waves_sigma_rad(one)))
        rise = np.column_stack([seen.image_rise, slopes.T])
        seams = WAVES.gross_sigma * list_seams() if errors.are_waves(gross) else np.zeros((SECTORS, 0))
        weight = sector_weight * seen.moments.information / seen.moments.variance_rad2
        lifts = _lifts_of(seen, sector_weight, weight) if j else NO_LIFTS
        mean = np.r_[image.mean - image.reference, np.zeros(size - j)]
        return cls(rise, mean, plain, wide, weight, size - j, seams, lifts)

    def __len__(self) -> int:
        return len(self.covariance)

    @property
    def images(self) -> int:
        """Number of the errors of the image."""
        return len(self) - self.waves

    @property
    def sigma_of_waves_rad(self) -> Array:
        """Rise (SECTORS, w) [rad] of the skyline by one standard deviation of each wave."""
        return np.asarray(self.wave_rise_rad * np.sqrt(np.diag(self.covariance)[self.images :]))

    @property
    def wave_rise_rad(self) -> Array:
        """Rise (SECTORS, w) [rad] of the skyline by one unit of each wave."""
        return self.rise_rad[:, self.images :]

    @cached_property
    def inverse(self) -> Array:
        """Inverse (j, j) of the covariance."""
        return np.asarray(np.linalg.inv(self.covariance))

    @cached_property
    def weighted(self) -> Array:
        """Information (SECTORS, j) on the errors in a height that a sector sees, light and stars alike."""
        of_image = self.lifts.lift_rad * self.lifts.weight[:, None]
        return np.hstack([of_image, self.wave_rise_rad * self.weight[:, None]])

    @cached_property
    def _information(self) -> Array:
        """Information (j, j) on the errors by the sectors and the prior."""
        by_sectors = self.weighted.T @ np.hstack([self.lifts.lift_rad, self.wave_rise_rad])
        own, waves = slice(0, self.images), slice(self.images, None)
        by_sectors[waves, own] = by_sectors[own, waves].T  # what they share is seen by the light alone
        return np.asarray(self.inverse + by_sectors)

    @cached_property
    def gain(self) -> Array:
        """Matrix (j, SECTORS) from heights that are left to the likeliest errors."""
        return np.asarray(np.linalg.solve(self._information, self.weighted.T))

    @cached_property
    def _gain_of_light(self) -> Array:
        """Matrix (j, SECTORS) to them from what the light stands higher than light and stars together."""
        of_image = np.zeros_like(self.weighted)
        of_image[:, : self.images] = self.weighted[:, : self.images]
        return np.asarray(np.linalg.solve(self._information, of_image.T))

    @cached_property
    def _by_prior(self) -> Array:
        """Part (j,) of the prior in the likeliest errors."""
        return np.asarray(np.linalg.solve(self._information, self.inverse @ self.mean))

    @cached_property
    def log_volume(self) -> float:
        """Logarithm of the integral over the errors, the norm of their prior in it, over the integrand at the best."""
        return 0.5 * float(np.linalg.slogdet(self.inverse)[1] - np.linalg.slogdet(self._information)[1])

    @cached_property
    def _seams_seen(self) -> tuple[Array, Array]:
        """Gradient (j, c) of the errors with the size of each seam, and the information (c,) on that size."""
        seen = self.weighted.T @ self.seams_rad
        by_sectors = np.sum(np.square(self.seams_rad) * self.weight[:, None], axis=0)
        return seen, 1.0 + by_sectors - np.sum(seen * np.linalg.solve(self._information, seen), axis=0)

    def fit(self, left_rad: Array, lifts_rad: Array | None = None) -> tuple[Array, Array | None, Array]:
        """Rise (n, SECTORS) [rad] by the likeliest waves, lifts of the light, and the logarithm (n,) of a ratio.

        The ratio is that of the integral to the likelihood at these errors. `left_rad` (n, SECTORS) are the heights
        that the sectors see above the skyline, `lifts_rad` (n, SECTORS) are lifts by other errors; None, here and of
        those found: 0.
        """
        errors, seam_rad, log = self._fit(left_rad, lifts_rad)
        if self.images:
            own = errors[:, : self.images] @ self.lifts.lift_rad.T
            lifts_rad = own if lifts_rad is None else own + lifts_rad
        return errors[:, self.images :] @ self.wave_rise_rad.T + seam_rad, lifts_rad, log

    def _fit(self, left_rad: Array, lifts_rad: Array | None) -> tuple[Array, Array, Array]:
        """Errors (n, j), rise (n, SECTORS) by a seam, and the logarithm; see `fit`."""
        seam_rad, log = np.zeros_like(left_rad), np.full(len(left_rad), self.log_volume)
        errors, left_rad = self.likeliest(left_rad, lifts_rad)
        if self.seams_rad.shape[1]:
            seen, information = self._seams_seen
            gradient = left_rad @ (self.weight[:, None] * self.seams_rad) - errors @ seen
            logs = 0.5 * np.square(gradient) / information - 0.5 * np.log(information)
            best = np.argmax(logs, axis=1)
            best_gradient = np.take_along_axis(gradient, best[:, None], axis=1)[:, 0]
            size = best_gradient / information[best]
            seam_rad = size[:, None] * self.seams_rad.T[best]
            log += np.logaddexp.reduce(logs, axis=1) - np.log(logs.shape[1])
            log -= 0.5 * (best_gradient * size + np.square(size))
            errors = errors - seam_rad @ self.gain.T
        beyond = errors - self.mean
        return errors, seam_rad, log - 0.5 * np.einsum("ni,ij,nj->n", beyond, self.inverse, beyond)

    def likeliest(self, left_rad: Array, lifts_rad: Array | None = None) -> tuple[Array, Array]:
        """Errors (n, j) without a seam, and the heights (n, SECTORS) that are left without the lifts.

        `left_rad` and `lifts_rad` (n, SECTORS) are those of `fit`. The light stands `left_rad + above_rad` above the
        skyline, which the errors of the image follow; the waves follow `left_rad`.
        """
        above_rad = self.lifts.above_rad
        if lifts_rad is not None:
            part = np.divide(self.lifts.weight, self.weight, out=np.zeros(SECTORS), where=self.weight > 0.0)
            left_rad, above_rad = left_rad - part * lifts_rad, above_rad - (1.0 - part) * lifts_rad
        return self._by_prior + left_rad @ self.gain.T + above_rad @ self._gain_of_light.T, left_rad

    def waves_rad(self, left_rad: Array) -> Array:
        """Rise (SECTORS,) [rad] of the skyline by the likeliest waves and seam at `left_rad` (SECTORS,); see `fit`."""
        return np.asarray(self.fit(left_rad[None])[0][0])


def _lifts_of(seen: SectorRows, sector_weight: Array, weight: Array) -> Lifts:
    """Lifts of the light in the rows `seen`; `sector_weight` and `weight` (SECTORS,) are those of LinearErrors."""
    alone, together, lit = seen.light.moments, seen.moments, np.zeros(SECTORS) if seen.edge is None else seen.edge.lit
    own = (1.0 - lit) * sector_weight * alone.information / alone.variance_rad2
    own[np.isinf(seen.image_errors.variance_rad2)] = 0.0
    return Lifts(seen.image_errors.slopes_rad, np.minimum(own, weight), alone.mean_rad - together.mean_rad)


def list_seams() -> Array:
    """Membership (SECTORS, c), 1 or 0, of sectors in each seam; the rest of the circle is another, less a bias."""
    end = SECTORS // SEAM_ENDS * np.transpose(np.triu_indices(SEAM_ENDS, 1))
    sector = np.arange(SECTORS)[:, None]
    return np.asarray((sector >= end[:, 0]) & (sector < end[:, 1]), dtype=float)
