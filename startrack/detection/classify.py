"""Selection of point sources among the fitted candidates by significance and shape, without edges and hot pixels.

Of a saturated star only the wings are fitted, and a real PSF has wider wings than the Gaussian.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from startrack.core.types import Array, Bools, Ints
from startrack.detection.background import CLIPPED_SIGMA
from startrack.detection.deblend import Fitted
from startrack.detection.fit import (
    FIT_ROUNDS_AGAIN,
    PointFits,
    Stamps,
    fit_points,
    pixel_scratch,
    profile_scratch,
)
from startrack.detection.frame import Frame
from startrack.detection.psf_width import MIN_BRIGHT_SOURCES, WIDTH_SNR
from startrack.kernels.library import kernel

# Of stars of a width [px]; measured at USUAL_SKEWNESS: equal rates of false stars.
HEIGHTS = {0.6: 5.80, 0.8: 5.70, 1.0: 5.54, 1.2: 5.43, 1.5: 5.33, 2.0: 5.18, 3.0: 5.09}
NOMINAL_HEIGHT = 5.42
USUAL_SKEWNESS, LARGEST_SKEWNESS = 0.088, 0.3  # the first: 100 photons and 3 electrons of read noise
FILTERED_SKEWNESS = 0.376  # 2 / (3 sqrt(pi)): fraction that remains after a matched filter of 1 px
NOISE_TOO_SMALL = 0.17  # relative underestimate of the noise per unit of skewness
OWN_LEVEL_FRACTION = 0.8  # of the threshold: required of every source with the level of its stamp alone
EDGE_MARGIN = 8.0  # chi^2 by which an edge must fit better than a star: noise alone gives faint stars less
BAD_FIT_CHI2_PER_DOF = 4.0
ROUGH_PSF_MISFIT = 0.06  # typical misfit above which stars are compared with the frame's bright stars
ROUGH_PSF_SPREAD = 2.0  # largest misfit of a star in such a frame over the typical one
SATURATED_MISFIT = 0.2  # largest misfit of a star measured by its wings, which differ most from the Gaussian
EDGE_DIRECTIONS = 8  # directions of straight edges or lines that are fitted
LARGEST_SIGMA_PX = 2.0  # of the position
WIDTH_FACTORS = (1.15, 1.3, 1.5)  # widths of a saturated star's wings over the width of the PSF
POOR_CHI2_PER_DOF = BAD_FIT_CHI2_PER_DOF / 2  # of a saturated star: no wider wings are tried below
# Within this radius of a source this much brighter the threshold is so much higher.
WING_SIGMAS, WING_BRIGHTER, WING_HEIGHT = 3.0, 2.0, 1.4


def refit_saturated(fitted: Fitted, sigma: float) -> tuple[Fitted, Array]:
    """The fits, saturated sources with the width that fits their wings best, and the widths (n,) [px].

    With the Gaussian of unsaturated stars the flux of a saturated one would be up to twice too large.
    """
    fits, width = fitted.fits, np.full(len(fitted.fits.flux), sigma)
    clipped = np.flatnonzero(are_saturated(fitted.stamps) & (fits.chi2 > POOR_CHI2_PER_DOF * fits.dof))
    for wider in WIDTH_FACTORS if len(clipped) else ():
        again = fit_points(
            fitted.stamps, clipped, fits.xy_px[clipped], wider * sigma, fitted.source_noise, 0.0, FIT_ROUNDS_AGAIN
        )
        better = np.flatnonzero(again.chi2 < fits.chi2[clipped])
        fits = fits.with_rows(clipped[better], again.take(better))
        width[clipped[better]] = wider * sigma
    return replace(fitted, fits=fits), width


def are_saturated(stamps: Stamps) -> Bools:
    """Whether sources (n,) have an unusable pixel at or beside their middle one."""
    if stamps.usable is None:
        return np.zeros(len(stamps.data), dtype=bool)
    middle = stamps.usable.shape[1] // 2
    around = slice(middle - 1, middle + 2)
    return np.asarray(~stamps.usable[:, around, around].all(axis=(1, 2)))


def select_stars(fitted: Fitted, width_px: Array, threshold: float) -> Ints:
    """Indices (k,) of the candidates (n,) that are point sources above the threshold; `width_px` (n,): fitted widths.

    If all bright sources of the frame differ from the Gaussian (trails, coma, a real lens), no bright star passes the
    chi^2 test; then sources with a similar misfit pass.
    """
    fits = fitted.fits
    stands_out = peak_heights(fits) >= threshold
    placed = np.sqrt(fits.covariance[:, 0, 0] + fits.covariance[:, 1, 1]) < LARGEST_SIGMA_PX
    left = np.flatnonzero(stands_out & placed & (fits.chi2 < fits.chi2_pixel))
    if not len(left):
        return left
    misfit, edge = _psf_and_edge_misfit(fitted, left, width_px[left])
    unlike_an_edge = fits.chi2[left] < edge + EDGE_MARGIN
    bright = fits.flux[left] > WIDTH_SNR * np.sqrt(fits.covariance[left, 2, 2])
    alike = misfit[unlike_an_edge & bright]
    typical = float(np.median(alike)) if len(alike) >= MIN_BRIGHT_SOURCES else 0.0
    typical = ROUGH_PSF_SPREAD * typical if typical > ROUGH_PSF_MISFIT else 0.0  # 0: stars fit the Gaussian
    good_fit = fits.chi2[left] < BAD_FIT_CHI2_PER_DOF * fits.dof[left]
    allowed = np.where(are_saturated(fitted.stamps)[left], max(typical, SATURATED_MISFIT), typical)
    return left[unlike_an_edge & (good_fit | (misfit < allowed))]


def select_brightest_per_position(xy_px: Array, flux: Array, closer_px: float) -> Bools:
    """Whether to keep sources (n,): of several that converged to one position the brightest."""
    from scipy.spatial import cKDTree

    one, later = cKDTree(xy_px).query_pairs(closer_px, output_type="ndarray").T
    brightest = np.ones(len(flux), dtype=bool)
    brightest[np.where(flux[one] < flux[later], one, later)] = False
    return brightest


def reject_wing_misfits(xy_px: Array, flux: Array, height: Array, sigma: float, threshold: float) -> Bools:
    """Whether to keep sources (n,): those near the threshold in the wing of a brighter one are rejected.

    Such a source is a residual of the PSF or of a blend: two unresolved stars are fitted as one.
    """
    from scipy.spatial import cKDTree

    pairs = cKDTree(xy_px).query_pairs(WING_SIGMAS * sigma, output_type="ndarray")
    both = np.concatenate([pairs, pairs[:, ::-1]])
    fainter = both[flux[both[:, 0]] * WING_BRIGHTER < flux[both[:, 1]], 0]
    keep = np.ones(len(flux), dtype=bool)
    keep[fainter[height[fainter] < WING_HEIGHT * threshold]] = False
    return keep


def peak_heights(fits: PointFits) -> Array:
    """Heights (n,) of sources above their surroundings, in sigma.

    The level of the surroundings is more precise than that of the stamp; it is used up to 1 / OWN_LEVEL_FRACTION of the
    height from the stamp alone. If the two levels disagree (a slope, the skyline), the stamp alone is used.
    """
    by_itself = fits.flux / np.sqrt(fits.covariance[:, 2, 2])
    even = np.abs(fits.level - fits.surround) < CLIPPED_SIGMA * np.sqrt(fits.covariance[:, 3, 3])
    return np.where(even, np.minimum(fits.significance, by_itself / OWN_LEVEL_FRACTION), by_itself)


def detection_threshold(threshold_snr: float, sigma_px: float, skewness: float) -> float:
    """Height with an equal rate of false peaks for every PSF width and every skewness of the pixel noise.

    The rate is 0.3 to 0.6 in 4 Mpx at the default. A narrower PSF has more independent positions for false stars, up to
    the number of pixels; a wider one has fewer, but its sources overlap more. Photon noise is skew: its bright tail is
    heavier than a Gaussian's (first term of the Cornish-Fisher expansion with the skewness after filtering), and its
    quantiles below the median, from which the noise is measured, lie closer together.
    """
    height = float(np.interp(np.log(sigma_px), np.log(list(HEIGHTS)), list(HEIGHTS.values())))
    filtered = FILTERED_SKEWNESS / np.sqrt(sigma_px**2 + 1.0 / 12.0)
    height += (skewness - USUAL_SKEWNESS) * (filtered * (height**2 - 1.0) / 6.0 + NOISE_TOO_SMALL * height)
    return float(np.sqrt(max(height**2 + threshold_snr**2 - NOMINAL_HEIGHT**2, 9.0)))


def noise_skewness(frame: Frame) -> float:
    """Skewness of the pixel noise, from the photons of the background; USUAL_SKEWNESS without a gain."""
    if frame.source_noise.per_unit != 1.0:  # not in electrons
        return USUAL_SKEWNESS
    some = np.ix_(*(np.arange(0, length, 64) for length in frame.shape))
    noise = float(np.median(frame.noise.at(*some)))
    photons = min(max(float(np.median(frame.background.at(*some))), 0.0), noise**2)
    return min(photons / max(noise, 1e-6) ** 3, LARGEST_SKEWNESS)


def _psf_and_edge_misfit(fitted: Fitted, which: Ints, width_px: Array) -> tuple[Array, Array]:
    """Misfit of the sources `which` (m,) to a PSF of `width_px` (m,), and their chi^2 as straight edges or lines.

    The misfit is the root of the squared residual beyond the noise over the squared signal: 0 for a perfect star, about
    0.6 for a single bright pixel.

    Edges are stripes of any brightness in the best of eight directions: sources that vary in one direction only, such
    as a skyline, the edge of the image circle, a bad column, a satellite's trail. The number of stripes is added to
    chi^2 so that many stripes are not preferred to few.
    """
    s, fits, own, side = fitted.stamps, fitted.fits, fitted.source_noise, fitted.stamps.data.shape[1]
    stripe, ends = _stripes(side)
    misfit, edge = np.empty((2, len(which)))
    _compare_shapes(
        *s.pixels, which, fits.xy_px[which] - s.centres[which], fits.flux[which], fits.level[which], width_px,
        own.per_unit, own.model_error, stripe, ends, profile_scratch(side), np.empty((ends[-1], 2), np.float32),
        pixel_scratch(4, side), misfit, edge,
    )  # fmt: skip
    return misfit, edge


@lru_cache(maxsize=16)
def _stripes(side: int) -> tuple[Ints, Ints]:
    """Number (s, s, d) of the stripe, one pixel wide, of each pixel of a stamp in d directions; the numbers' ends."""
    offset = np.arange(side) - side // 2
    x, y = np.tile(offset, side), np.repeat(offset, side)
    numbers, ends = [], [0]
    for turn in np.arange(EDGE_DIRECTIONS) * np.pi / EDGE_DIRECTIONS:
        _, number = np.unique(np.rint(x * np.cos(turn) + y * np.sin(turn)), return_inverse=True)
        numbers.append(number + ends[-1])
        ends.append(ends[-1] + number.max() + 1)
    return np.stack(numbers, axis=1).reshape(side, side, -1), np.array(ends[1:])


_compare_shapes = kernel(
    "compare_shapes", "data: float32[n, side >= 3, side]", "variance: float32[n, side, side]",
    "usable: bool[usable_rows, side, side]", "which: int64[m]", "offset_px: float64[m, 2]", "flux: float64[m]",
    "level: float64[m]", "width_px: float64[m]", "per_unit: float64", "model_error: float64",
    "stripe: int64[side, side, directions]", "ends: int64[directions]", "profiles: out float64[7, side + 1]",
    "sums: out float32[stripes, 2]", "pixels: out float32[4, room]", "misfit: out float64[m]", "edge: out float64[m]",
)  # fmt: skip
