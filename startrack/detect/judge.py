"""Which fitted candidates are point sources: above the threshold, like the PSF, and nothing else's likeness."""

from __future__ import annotations

import numpy as np

from startrack.detect.crowded import own_light
from startrack.detect.fit import PointFits
from startrack.detect.frame import Frame, radius_for
from startrack.detect.impostors import edge_chi2
from startrack.detect.widths import BRIGHT_SNR, FEWEST_BRIGHT
from startrack.types import Array, Bools, Ints

NARROW_PX = 1.25
OWN_LEVEL_PART = 0.8  # of the threshold that a source must reach by its own stamp alone, everywhere
UNEVEN_SIGMA = 2.5  # difference of the stamp's level and that of its surroundings where these are not to be trusted
EDGE_MARGIN = 20.0  # chi^2 by which an edge must explain a stamp better: noise alone gives faint stars less
BAD_FIT_CHI2_PER_DOF = 4.0
ROUGH_PSF_MISFIT = 0.1  # from here up the frame's own stars, not the Gaussian, say what a star looks like
ROUGH_PSF_SPREAD = 2.0  # times the typical misfit that a star of such a frame may have
LARGEST_SIGMA_PX = 2.0  # of the place


def stars_among(frame: Frame, centres: Ints, fits: PointFits, sigma: float, threshold_snr: float) -> Ints:
    """Indices (k,) of the candidates that are point sources.

    Where the bright sources of the frame all differ from the Gaussian (trails, coma, a real lens), no bright star would
    pass by its chi^2; there a source passes whose misfit is like theirs.
    """
    threshold = _threshold(threshold_snr, sigma)
    by_itself = fits.flux / np.sqrt(fits.covariance[:, 2, 2])
    # On a slope or at the skyline the surroundings do not tell the level; there the stamp must tell by itself.
    even = np.abs(fits.level - fits.surround) < UNEVEN_SIGMA * np.sqrt(fits.covariance[:, 3, 3])
    stands_out = (by_itself >= threshold) | (
        even & (fits.significance >= threshold) & (by_itself >= OWN_LEVEL_PART * threshold)
    )
    placed = np.sqrt(fits.covariance[:, 0, 0] + fits.covariance[:, 1, 1]) < LARGEST_SIGMA_PX
    left = np.flatnonzero(stands_out & placed & (fits.chi2 < fits.chi2_pixel))
    if not len(left):
        return left
    misfit, edge = _likeness(frame, centres[left], fits.take(left), sigma)
    unlike_an_edge = fits.chi2[left] < edge + EDGE_MARGIN
    typical = _typical(misfit[unlike_an_edge & (by_itself[left] > BRIGHT_SNR)])
    good_fit = fits.chi2[left] < BAD_FIT_CHI2_PER_DOF * fits.dof[left]
    return left[unlike_an_edge & (good_fit | (misfit < typical))]


def one_per_place(xy_px: Array, flux: Array, closer_px: float) -> Bools:
    """Which sources (n,) to keep: of those that converged onto one place, the brightest."""
    from scipy.spatial import cKDTree

    rank = np.empty(len(flux), dtype=np.int64)
    rank[np.argsort(-flux, kind="stable")] = np.arange(len(flux))
    pairs = cKDTree(xy_px).query_pairs(closer_px, output_type="ndarray")
    fainter = np.zeros(len(flux), dtype=bool)
    fainter[np.where(rank[pairs[:, 0]] > rank[pairs[:, 1]], pairs[:, 0], pairs[:, 1])] = True
    return ~fainter


def _threshold(threshold_snr: float, sigma_px: float) -> float:
    """Significance that gives a narrow PSF no more false peaks than one of NARROW_PX.

    Noise has about sigma^-4 as many peaks above a given height (measured: 7, 2.5 and 0.25 above 5 in 4 Mpx at sigma
    0.7, 1.0 and 1.5 px), and their number falls as exp(-height^2 / 2).
    """
    return float(np.sqrt(threshold_snr**2 + max(8 * np.log(NARROW_PX / sigma_px), 0.0)))


def _typical(misfit: Array) -> float:
    """Misfit up to which a source is like the frame's bright ones, where these are rough; 0 where they are not."""
    if len(misfit) < FEWEST_BRIGHT:
        return 0.0
    typical = float(np.median(misfit))
    return ROUGH_PSF_SPREAD * typical if typical > ROUGH_PSF_MISFIT else 0.0


def _likeness(frame: Frame, centres: Ints, fits: PointFits, sigma: float) -> tuple[Array, Array]:
    """How far the sources (n) are from the Gaussian PSF, and their chi^2 as straight edges or lines instead.

    The first is the root of the squared residual beyond the noise over the squared light: 0 for a perfect star, about
    0.6 for a single bright pixel.
    """
    radius = radius_for(sigma)
    data, variance, usable = frame.data(centres, radius), frame.variance(centres, radius), frame.usable(centres, radius)
    light = own_light(centres, fits, sigma, radius)
    noise = variance + np.float32(frame.light_noise.per_unit) * light
    excess = np.square(data - light - fits.level[:, None, None].astype(np.float32)) - noise
    weights = 1.0 / (noise + np.square(np.float32(frame.light_noise.model_error) * light))
    squared = np.square(light)
    if usable is not None:
        excess, weights, squared = excess * usable, weights * usable, squared * usable
    total = squared.sum(axis=(1, 2), dtype=np.float64)
    misfit = np.sqrt(np.maximum(excess.sum(axis=(1, 2), dtype=np.float64), 0.0) / np.maximum(total, 1e-12))
    return misfit, edge_chi2(data, weights)
