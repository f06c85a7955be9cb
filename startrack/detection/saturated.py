"""Stars with saturated middles: only their wings are measured, and a real PSF has wider wings than the Gaussian."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from startrack.detection.deblend import Fitted
from startrack.detection.fit import ROUNDS_AGAIN, Stamps, fit_points
from startrack.types import Array, Bools

WIDTH_FACTORS = (1.15, 1.3, 1.5)  # times the PSF's width that the wings of a star may have
POOR_CHI2_PER_DOF = 2.0  # of the Gaussian that fits the frame's other stars; below, it does for this one too


def refit_saturated(fitted: Fitted, sigma: float) -> tuple[Fitted, Array]:
    """The fits, saturated sources by the width that suits their wings best, and each one's width (n,) [px].

    By the Gaussian of the whole star the wings of a real one make the hidden middle up to twice too bright.
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
    """The sources (n,) that have an unusable pixel at or beside their middle one."""
    if stamps.usable is None:
        return np.zeros(len(stamps.data), dtype=bool)
    middle = stamps.usable.shape[1] // 2
    around = slice(middle - 1, middle + 2)
    return np.asarray(~stamps.usable[:, around, around].all(axis=(1, 2)))
