"""Selection of point sources among the fitted candidates, by height, likeness to the PSF, and no edge or hot pixel."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from startrack.detection.deblend import Fitted, own_light
from startrack.detection.fit import PointFits, Stamps
from startrack.detection.frame import Frame, Pixels, SourceNoise
from startrack.detection.psf_width import BRIGHT_SNR, MIN_BRIGHT
from startrack.detection.saturated import are_saturated
from startrack.types import Array, Bools, Ints

WIDTHS_PX = (0.6, 0.8, 1.0, 1.2, 1.5, 2.0, 3.0)
HEIGHTS = (5.80, 5.70, 5.54, 5.43, 5.33, 5.18, 5.09)  # measured at USUAL_SKEWNESS: alike in false stars
HEIGHT_AT_NOMINAL = 5.42
USUAL_SKEWNESS, LARGEST_SKEWNESS = 0.088, 0.3  # the first is that of 100 photons and 3 electrons of read noise
FILTERED_SKEWNESS = 0.376  # 2 / (3 sqrt(pi)): part that a matched filter of 1 px leaves
NOISE_TOO_SMALL = 0.17  # part of the skewness by which the noise is measured too small
OWN_LEVEL_FRACTION = 0.8  # of the threshold that a source must reach by its own stamp alone, everywhere
UNEVEN_SIGMA = 2.5  # difference of the stamp's level and that of its surroundings where these are not to be trusted
EDGE_MARGIN = 8.0  # chi^2 by which an edge must explain a stamp better: noise alone gives faint stars less
BAD_FIT_CHI2_PER_DOF = 4.0
ROUGH_PSF_MISFIT = 0.06  # from here up stars are compared with the frame's own bright stars, not with the Gaussian
ROUGH_PSF_SPREAD = 2.0  # times the typical misfit that a star of such a frame may have
SATURATED_MISFIT = 0.2  # of a star that shows only its wings, which are the least Gaussian
EDGE_DIRECTIONS = 8  # of the straight edges or lines tried
LARGEST_SIGMA_PX = 2.0  # of the position
WING_SIGMAS, WING_BRIGHTER, WING_HEIGHT = (
    3.0,
    2.0,
    1.4,
)  # within this radius of a source this much brighter the threshold is higher


def select_stars(fitted: Fitted, width_px: Array, threshold: float) -> Ints:
    """Indices (k,) of the candidates, fitted with widths (n,), that are point sources and stand out by the threshold.

    Where the bright sources of the frame all differ from the Gaussian (trails, coma, a real lens), no bright star would
    pass by its chi^2; there a source passes whose misfit is like theirs.
    """
    fits = fitted.fits
    stands_out = peak_heights(fits) >= threshold
    placed = np.sqrt(fits.covariance[:, 0, 0] + fits.covariance[:, 1, 1]) < LARGEST_SIGMA_PX
    left = np.flatnonzero(stands_out & placed & (fits.chi2 < fits.chi2_pixel))
    if not len(left):
        return left
    misfit, edge = _psf_and_edge_misfit(fitted.stamps.take(left), fits.take(left), width_px[left], fitted.source_noise)
    unlike_an_edge = fits.chi2[left] < edge + EDGE_MARGIN
    bright = fits.flux[left] > BRIGHT_SNR * np.sqrt(fits.covariance[left, 2, 2])
    typical = _typical_misfit(misfit[unlike_an_edge & bright])
    good_fit = fits.chi2[left] < BAD_FIT_CHI2_PER_DOF * fits.dof[left]
    allowed = np.where(are_saturated(fitted.stamps.take(left)), max(typical, SATURATED_MISFIT), typical)
    return left[unlike_an_edge & (good_fit | (misfit < allowed))]


def select_brightest_per_position(xy_px: Array, flux: Array, closer_px: float) -> Bools:
    """Which sources (n,) to keep: the brightest of all that converged onto one position."""
    from scipy.spatial import cKDTree

    rank = np.empty(len(flux), dtype=np.int64)
    rank[np.argsort(-flux, kind="stable")] = np.arange(len(flux))
    pairs = cKDTree(xy_px).query_pairs(closer_px, output_type="ndarray")
    fainter = np.zeros(len(flux), dtype=bool)
    fainter[np.where(rank[pairs[:, 0]] > rank[pairs[:, 1]], pairs[:, 0], pairs[:, 1])] = True
    return ~fainter


def reject_wing_misfits(xy_px: Array, flux: Array, height: Array, sigma: float, threshold: float) -> Bools:
    """Which sources (n,) to keep: those hardly above the threshold in a brighter one's wing are its misfit, or a blend.

    Two stars that are not resolved are fitted as one, and what that leaves looks like a third.
    """
    from scipy.spatial import cKDTree

    pairs = cKDTree(xy_px).query_pairs(WING_SIGMAS * sigma, output_type="ndarray")
    both = np.concatenate([pairs, pairs[:, ::-1]])
    fainter = both[flux[both[:, 0]] * WING_BRIGHTER < flux[both[:, 1]], 0]
    keep = np.ones(len(flux), dtype=bool)
    keep[fainter[height[fainter] < WING_HEIGHT * threshold]] = False
    return keep


def peak_heights(fits: PointFits) -> Array:
    """Height of each source (n) above its surroundings, in sigma.

    Above its surroundings, whose level is known better than that of the stamp, where the stamp by itself shows at least
    OWN_LEVEL_PART of it; by its own stamp alone where the two levels do not agree: on a slope or at the skyline.
    """
    by_itself = fits.flux / np.sqrt(fits.covariance[:, 2, 2])
    even = np.abs(fits.level - fits.surround) < UNEVEN_SIGMA * np.sqrt(fits.covariance[:, 3, 3])
    return np.where(even, np.minimum(fits.significance, by_itself / OWN_LEVEL_FRACTION), by_itself)


def detection_threshold(threshold_snr: float, sigma_px: float, skewness: float) -> float:
    """Height that gives about as many false peaks, whatever the PSF's width and the skewness of the pixels' noise.

    That is 0.3 to 0.6 in 4 Mpx at the default. A narrower PSF has more independent positions for false stars, down to
    where the number of pixels limits it; a wider one has fewer, but more crowded sources. Photons' noise is skew:
    its bright tail is heavier than a Gaussian's (the first term of Cornish and Fisher's expansion, with what the filter
    leaves of the skewness), and its quantiles below the median, from which the noise is taken, lie closer together.
    """
    height = float(np.interp(np.log(sigma_px), np.log(WIDTHS_PX), HEIGHTS))
    filtered = FILTERED_SKEWNESS / np.sqrt(sigma_px**2 + 1.0 / 12.0)
    height += (skewness - USUAL_SKEWNESS) * (filtered * (height**2 - 1.0) / 6.0 + NOISE_TOO_SMALL * height)
    return float(np.sqrt(max(height**2 + threshold_snr**2 - HEIGHT_AT_NOMINAL**2, 9.0)))


def noise_skewness(frame: Frame) -> float:
    """Skewness of the noise of the frame's pixels, by the photons of its background; a usual one without a gain."""
    if frame.source_noise.per_unit != 1.0:  # not in electrons
        return USUAL_SKEWNESS
    some = slice(None, None, 64), slice(None, None, 64)
    noise = float(np.median(frame.noise[some]))
    photons = min(max(float(np.median(frame.background[some])), 0.0), noise**2)
    return min(photons / max(noise, 1e-6) ** 3, LARGEST_SKEWNESS)


def _typical_misfit(misfit: Array) -> float:
    """Misfit up to which a source is like the frame's bright ones, where these are rough; 0 where they are not."""
    if len(misfit) < MIN_BRIGHT:
        return 0.0
    typical = float(np.median(misfit))
    return ROUGH_PSF_SPREAD * typical if typical > ROUGH_PSF_MISFIT else 0.0


def _psf_and_edge_misfit(s: Stamps, fits: PointFits, width_px: Array, own: SourceNoise) -> tuple[Array, Array]:
    """How far the sources (n) are from the Gaussian PSF, and their chi^2 as straight edges or lines instead.

    The first is the root of the squared residual beyond the noise over the squared light: 0 for a perfect star, about
    0.6 for a single bright pixel.
    """
    light = own_light(s.centres, fits, width_px, s.data.shape[1] // 2)
    noise = s.variance + np.float32(own.per_unit) * light
    excess = np.square(s.data - light - fits.level[:, None, None].astype(np.float32)) - noise
    weights = 1.0 / (noise + np.square(np.float32(own.model_error) * light))
    squared = np.square(light)
    if s.usable is not None:
        excess, weights, squared = excess * s.usable, weights * s.usable, squared * s.usable
    total = squared.sum(axis=(1, 2), dtype=np.float64)
    misfit = np.sqrt(np.maximum(excess.sum(axis=(1, 2), dtype=np.float64), 0.0) / np.maximum(total, 1e-12))
    return misfit, edge_chi2(s.data, weights)


def edge_chi2(data: Pixels, weights: Pixels) -> Array:
    """chi^2 (n,) of stamps (n, s, s) as straight stripes of any brightness, in the best of eight directions.

    Larger by the number of stripes than the least squares' own, so that many stripes are no better than few.

    A skyline, the edge of the image circle, a bad column, a satellite's trail: what varies in one direction only.
    """
    n, side = len(data), data.shape[1]
    stripes, starts = _stripes(side)
    counts = np.diff(starts, append=stripes.shape[1]).astype(np.float32)  # of stripes: noise alone explains as much
    w = weights.reshape(n, -1).astype(np.float32)
    flat = data.reshape(n, -1).astype(np.float32)
    moment = w * flat
    total, light = w @ stripes, moment @ stripes
    explained = np.add.reduceat(light * light / np.maximum(total, 1e-30), starts, axis=1) - counts
    return np.asarray(np.sum(moment * flat, axis=1) - explained.max(axis=1), dtype=np.float64)


@lru_cache(maxsize=16)
def _stripes(side: int) -> tuple[NDArray[np.float32], Ints]:
    """Which pixel lies in which stripe of one pixel's width (s^2, m): 0 or 1; and each direction's first stripe."""
    offset = np.arange(side) - side // 2
    x, y = np.tile(offset, side), np.repeat(offset, side)
    masks = []
    for turn in np.arange(EDGE_DIRECTIONS) * np.pi / EDGE_DIRECTIONS:
        _, number = np.unique(np.rint(x * np.cos(turn) + y * np.sin(turn)), return_inverse=True)
        masks.append(np.eye(number.max() + 1, dtype=np.float32)[number])
    return np.concatenate(masks, axis=1), np.cumsum([0] + [mask.shape[1] for mask in masks[:-1]])
