"""Least-squares fits of point sources: centroids and fluxes at the Cramer-Rao bound."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from startrack.core.types import Array, Bools, Ints
from startrack.detection.frame import Pixels, SourceNoise

ROUNDS, ROUNDS_AGAIN = 3, 2  # iterations of a first fit, and of a repeated one
ALL_USABLE = np.zeros((0, 0, 0), dtype=np.bool_)


@dataclass(frozen=True, kw_only=True)
class PointFits:
    """Fitted point sources (n) and how well they fit."""

    xy_px: Array  # (n, 2)
    flux: Array  # (n,)
    level: Array  # (n,) local background
    covariance: Array  # (n, 4, 4) of x, y, flux, level
    chi2: Array  # (n,) of the point source
    chi2_pixel: Array  # (n,) of a single bright pixel instead
    dof: Array  # (n,)
    surround: Array  # (n,) level of the wider surroundings
    significance: Array  # (n,) matched-filter SNR against background noise alone
    snr: Array  # (n,) matched-filter SNR, the source's own photon noise included

    def take(self, which: Ints) -> PointFits:
        """The fits selected by indices."""
        return PointFits(**{f.name: getattr(self, f.name)[which] for f in fields(self)})

    def with_rows(self, which: Ints, others: PointFits) -> PointFits:
        """These fits with `others` at the indices `which`."""
        values = {f.name: getattr(self, f.name).copy() for f in fields(self)}
        for name, value in values.items():
            value[which] = getattr(others, name)
        return PointFits(**values)


@dataclass(frozen=True)
class Stamps:
    """Cut-outs (n, s, s) around the pixels `centres` (n, 2), and the level (n,) of their wider surroundings."""

    data: Pixels
    variance: Pixels
    usable: Bools | None
    centres: Ints
    surround: Array

    def take(self, which: slice | Ints) -> Stamps:
        """Some of them."""
        usable = None if self.usable is None else self.usable[which]
        return Stamps(self.data[which], self.variance[which], usable, self.centres[which], self.surround[which])


def fit_points(
    stamps: Stamps,
    start_xy_px: Array,
    sigma_px: float,
    source_noise: SourceNoise,
    own_part: float,
    rounds: int = ROUNDS,
) -> PointFits:
    """Position, flux and local level of one point source in each stamp.

    Only the significance relies on `surround`, which contains `own_part` of the source's signal. Gauss-Newton on the
    pixel-integrated Gaussian from `start_xy_px` (n, 2); steps are limited to half a pixel, so that diverging fits stay
    near their start. Weights: the pixels' variance and the variance of the source's own signal.
    """
    from startrack.detection.fit_kernel import fit_stamps

    n = len(stamps.data)
    offset, values, covariance = np.empty((n, 2)), np.empty((n, 8)), np.empty((n, 4, 4))
    usable = ALL_USABLE if stamps.usable is None else stamps.usable
    fit_stamps(
        stamps.data, stamps.variance, usable, start_xy_px - stamps.centres, sigma_px, source_noise.per_unit,
        source_noise.model_error, rounds, stamps.surround, offset, values, covariance,
    )  # fmt: skip
    flux, level, chi2, chi2_pixel, count, above, norm, own = np.ascontiguousarray(values.T)
    # The level of the surroundings was taken from pixels that hold the star: it lowers signal by `own_part`, noise by
    # its root.
    undiluted = np.sqrt(np.maximum(norm, 1e-30) * (1.0 - own_part))
    return PointFits(
        xy_px=stamps.centres + offset,
        flux=flux,
        level=level,
        covariance=covariance,
        chi2=chi2,
        chi2_pixel=chi2_pixel,
        dof=np.maximum(count - 4.0, 1.0),
        surround=stamps.surround,
        significance=above / undiluted,
        snr=flux * np.sqrt(own),
    )


def concatenate_fits(parts: list[PointFits]) -> PointFits:
    """The fits of all parts in one value."""
    return PointFits(**{f.name: np.concatenate([getattr(b, f.name) for b in parts]) for f in fields(PointFits)})


def unbin_fits(fits: PointFits, side: int) -> PointFits:
    """Fits in a binned frame converted to the frame itself: positions, their errors, and levels per pixel."""
    if side == 1:
        return fits
    unit = np.array([side, side, 1.0, 1.0 / side**2])
    return replace(
        fits,
        xy_px=side * fits.xy_px + 0.5 * (side - 1),
        level=fits.level / side**2,
        surround=fits.surround / side**2,
        covariance=fits.covariance * np.outer(unit, unit),
    )
