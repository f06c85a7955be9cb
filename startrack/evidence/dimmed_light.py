"""Fluxes of stars of which something takes a part: their likelihoods, with the scatter that the frame itself shows.

The stars well above the skyline show how far the light of visible stars scatters: photons, errors of the catalogue and
of the PSF, blends.
"""

from __future__ import annotations

import numpy as np

from startrack.core.types import Array

OUTLIERS = 0.02  # least share of stars with any light: variable, blended, beside a defect
OUTLIER_SIGMAS, SCATTER_ROUNDS = 4.0, 4


def measure_scatter(expected_e: Array, flux_e: Array, sigma_e: Array) -> tuple[Array, float]:
    """Scatter of visible stars' measured light `flux_e` (n,) about `expected_e`, beyond the noise `sigma_e`.

    The variance per expected electron and per its square (2,), from the residuals' squares with deviant ones clipped;
    and the share of outliers.
    """
    terms, per_e = np.stack([expected_e, np.square(expected_e)], axis=1), np.asarray([0.0, 0.0])
    beyond = np.square(flux_e - expected_e)
    kept = beyond < np.square(np.maximum(OUTLIER_SIGMAS * sigma_e, 0.5 * expected_e))
    for _ in range(SCATTER_ROUNDS):
        variance = np.square(sigma_e) + terms @ per_e
        weighted = terms[kept] / variance[kept, None]
        rest = (beyond - np.square(sigma_e))[kept] / variance[kept]
        per_e = np.asarray(np.linalg.lstsq(weighted, rest, rcond=None)[0])
        if per_e.min() < 0:  # one of them alone
            one = int(np.argmax(per_e))
            alone = float(weighted[:, one] @ rest / np.square(weighted[:, one]).sum())
            per_e = np.where(np.arange(2) == one, max(alone, 0.0), 0.0)
        kept = beyond < OUTLIER_SIGMAS**2 * (np.square(sigma_e) + terms @ per_e)
    return per_e, max(OUTLIERS, 1.0 - float(np.mean(kept)))


def log_likelihoods(
    light: Array, expected_e: Array, flux_e: Array, sigma_e: Array, per_e: Array, outliers: float
) -> Array:
    """Log-likelihoods (n, k) of fluxes `flux_e` (n,) where stars shine with parts `light` (k,) of what is expected.

    `sigma_e` (n,): noise without the star; `per_e` (2,) and `outliers`: from `measure_scatter`.
    """
    mean = expected_e[:, None] * light
    variance = np.square(sigma_e)[:, None] + per_e[0] * mean + per_e[1] * np.square(mean)
    normal = -0.5 * np.square(flux_e[:, None] - mean) / variance - 0.5 * np.log(2 * np.pi * variance)
    anything = np.log(outliers) - np.log(2.0 * expected_e + 10.0 * sigma_e)
    return np.logaddexp(np.log1p(-outliers) + normal, anything[:, None])
