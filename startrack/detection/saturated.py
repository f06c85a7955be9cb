"""Saturated stars: only their wings are fitted, and a real PSF has wider wings than the Gaussian."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from startrack.core.types import Array, Bools
from startrack.detection.deblend import Fitted
from startrack.detection.fit import ROUNDS_AGAIN, Stamps, fit_points

WIDTH_FACTORS = (1.15, 1.3, 1.5)  # widths of the wings over the width of the PSF
POOR_CHI2_PER_DOF = 2.0  # with the PSF's own width; below it no wider one is tried


def refit_saturated(fitted: Fitted, sigma: float) -> tuple[Fitted, Array]:
    """The fits, saturated sources with the width that fits their wings best, and the widths (n,) [px].

    With the Gaussian of unsaturated stars the flux of a saturated one would be up to twice too large.
    """
    fits, width = fitted.fits, np.full(len(fitted.fits.flux), sigma)
    clipped = np.flatnonzero(are_saturated(fitted.stamps) & (fits.chi2 > POOR_CHI2_PER_DOF * fits.dof))
    for wider in WIDTH_FACTORS if len(clipped) else ():
        stamps = fitted.stamps.take(clipped)
        again = fit_points(stamps, fits.xy_px[clipped], wider * sigma, fitted.source_noise, 0.0, ROUNDS_AGAIN)
        better = np.flatnonzero(again.chi2 < fits.chi2[clipped])
        fits = fits.with_rows(clipped[better], again.take(better))
        width[clipped[better]] = wider * sigma
    return replace(fitted, fits=fits), width


def are_saturated(stamps: Stamps) -> Bools:
    """Which sources (n,) have an unusable pixel at or beside their middle one."""
    if stamps.usable is None:
        return np.zeros(len(stamps.data), dtype=bool)
    middle = stamps.usable.shape[1] // 2
    around = slice(middle - 1, middle + 2)
    return np.asarray(~stamps.usable[:, around, around].all(axis=(1, 2)))
