"""Least-squares fits of point sources, at the Cramer-Rao bound, and the noise that their residuals show."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from startrack.core.types import Array, Bools, Ints
from startrack.core.values import Rows, array
from startrack.detection.frame import MODEL_ERROR, RESIDUAL_FRACTION, Pixels, SourceNoise
from startrack.kernels import STAMP_LANES
from startrack.kernels.library import kernel

FIT_ROUNDS = 3  # iterations of a first fit
FIT_ROUNDS_AGAIN = FIT_ROUNDS - 1
BRIGHT_STAR_SNR = 15.0  # of stars that show what the frame's stars are like
MIN_NOISE_STARS, MAX_NOISE_STARS = 20, 120
FAINT_FRACTION = 0.3  # of the pixel's variance: pixels with less signal are left out
MAX_LEVERAGE = 0.5  # residuals of pixels with a larger leverage do not show the noise
NOISE_BINS, MIN_PIXELS_PER_BIN = 12, 15
MAX_CORRELATION = 2.0
MEDIAN_OF_SQUARE = 0.4549  # of a unit Gaussian
MIN_MODEL_ERROR = 0.005
MAX_STEP_PX = 0.5
POSITION_PRIOR = 0.1  # per px^2: positions within about 3 px of the start keep sources without light solvable
FLUX_PRIOR = 1e-12


@dataclass(frozen=True, kw_only=True)
class PointFits(Rows):
    """Fitted point sources and how well they fit."""

    xy_px: Array = array("n", 2, may_be_nan=True)
    flux: Array = array("n", may_be_nan=True)
    level: Array = array("n", may_be_nan=True)  # local background
    covariance: Array = array("n", 4, 4, may_be_nan=True)  # of x, y, flux, level
    chi2: Array = array("n", may_be_nan=True)  # of the point source
    chi2_pixel: Array = array("n", may_be_nan=True)  # of a single bright pixel instead
    dof: Array = array("n")
    surround: Array = array("n", may_be_nan=True)  # level of the wider surroundings
    significance: Array = array("n", may_be_nan=True)  # matched-filter SNR against background noise alone
    snr: Array = array("n", may_be_nan=True)  # matched-filter SNR, the source's own photon noise included


@dataclass(frozen=True)
class Stamps:
    """Cut-outs (n, s, s) around the pixels `centres` (n, 2), and the level (n,) of their wider surroundings."""

    data: Pixels
    variance: Pixels
    usable: Bools | None
    centres: Ints
    surround: Array

    @property
    def pixels(self) -> tuple[Pixels, Pixels, Bools]:
        """Light, variance and usability (n, s, s) for kernels; the last has no rows where all pixels are usable."""
        none = np.empty((0, *self.data.shape[1:]), np.bool_)
        return self.data, self.variance, none if self.usable is None else self.usable

    def take(self, which: slice | Ints) -> Stamps:
        """Stamps that the indices or the slice `which` select."""
        usable = None if self.usable is None else self.usable[which]
        return Stamps(self.data[which], self.variance[which], usable, self.centres[which], self.surround[which])


def profile_scratch(side: int) -> Array:
    """Room for profiles of a PSF in stamps of this side."""
    return np.empty((7, side + 1))


def pixel_scratch(rows: int, side: int) -> Pixels:
    """Room for so many rows of a stamp's pixels."""
    return np.empty((rows, -(-side * side // STAMP_LANES) * STAMP_LANES), np.float32)


def fit_points(
    stamps: Stamps, which: Ints, start_xy_px: Array, sigma_px: float, source_noise: SourceNoise, own_part: float,
    rounds: int, signal: Pixels | None = None,
) -> PointFits:  # fmt: skip
    """Position, flux and local level of one point source in each of the stamps at the indices `which` (n,).

    The neighbours' `signal` (n, s, s) is subtracted; its error counts as noise.

    Only the significance relies on `surround`, which contains `own_part` of the source's signal. Gauss-Newton on the
    pixel-integrated Gaussian from `start_xy_px` (n, 2); steps are limited to half a pixel, so that diverging fits stay
    near their start. Weights: the pixels' variance and the variance of the source's own signal.
    """
    n, side = len(which), stamps.data.shape[1]
    offset, values, covariance = np.empty((n, 2)), np.empty((n, 8)), np.empty((n, 4, 4))
    light = np.empty((0, side, side), np.float32) if signal is None else signal
    centres, surround = stamps.centres[which], stamps.surround[which]
    _fit_stamps(
        *stamps.pixels, light, RESIDUAL_FRACTION, which, start_xy_px - centres, sigma_px, source_noise.per_unit,
        source_noise.model_error, rounds, MAX_STEP_PX, POSITION_PRIOR, FLUX_PRIOR, surround, profile_scratch(side),
        pixel_scratch(7, side), offset, values, covariance,
    )  # fmt: skip
    columns = np.ascontiguousarray(values.T)
    columns.flags.writeable = covariance.flags.writeable = False  # locked values need no copy
    flux, level, chi2, chi2_pixel, count, above, norm, own = columns
    # Pixels of the surroundings hold the star: their level lowers signal by `own_part`, noise by its root.
    undiluted = np.sqrt(np.maximum(norm, 1e-30) * (1.0 - own_part))
    return PointFits(
        xy_px=centres + offset,
        flux=flux,
        level=level,
        covariance=covariance,
        chi2=chi2,
        chi2_pixel=chi2_pixel,
        dof=np.maximum(count - 4.0, 1.0),
        surround=surround,
        significance=above / undiluted,
        snr=flux * np.sqrt(own),
    )


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


def measure_source_noise(s: Stamps, fits: PointFits, alone: Bools, sigma: float, expected: SourceNoise) -> SourceNoise:
    """The source noise of the frame; `expected` where bright stars are too few. Stated photon noise is kept.

    From isolated stars `alone` (n,): in bins of a pixel's signal s, the median squared residual minus the variance
    without the star is a s + b s^2. The PSF misfit is at most the expected one. If the residuals of different stars are
    correlated, the PSF differs from the model, and unknown photon noise cannot be separated from that.
    """
    good = alone & (fits.snr > BRIGHT_STAR_SNR) & (fits.chi2 < fits.chi2_pixel)
    if s.usable is not None:
        good &= s.usable.all(axis=(1, 2))
    which = np.flatnonzero(good)
    # Stars of every brightness: the brightest determine the PSF misfit, the others the photon noise.
    bright = which[np.argsort(-fits.snr[which], kind="stable")][:: max(1, len(which) // MAX_NOISE_STARS)]
    if len(bright) < MIN_NOISE_STARS:
        return expected
    signal, squared, variance, correlation = _squared_residuals(s.take(bright), fits.take(bright), sigma)
    if (expected.per_unit == 0.0 and correlation > MAX_CORRELATION) or len(signal) < NOISE_BINS * MIN_PIXELS_PER_BIN:
        return expected
    order = np.argsort(signal, kind="stable")
    bins = [part for part in np.array_split(order, NOISE_BINS) if len(part) >= MIN_PIXELS_PER_BIN]
    level, total, dark = (np.array([_median(values[part]) for part in bins]) for values in (signal, squared, variance))
    total /= MEDIAN_OF_SQUARE
    beyond, error = total - dark, np.maximum(total, dark) * 2.0 / np.sqrt([len(part) for part in bins])
    # Weighted least squares for a and b, neither below 0.
    one, two = level / error, level**2 / error
    per_unit = expected.per_unit
    if per_unit == 0.0:
        normal = np.array([[one @ one, one @ two], [one @ two, two @ two]])
        right = np.array([one @ (beyond / error), two @ (beyond / error)])
        per_unit, b = np.linalg.solve(normal, right)
        per_unit = float(max(per_unit if b >= 0 else right[0] / normal[0, 0], 0.0))
    b = float(two @ ((beyond - per_unit * level) / error) / (two @ two))
    return SourceNoise(per_unit, float(np.clip(np.sqrt(max(b, 0.0)), MIN_MODEL_ERROR, MODEL_ERROR)))


def _median(values: Array) -> float:
    """Median of the values (n,), for a few of them in a fifth of the time that numpy takes."""
    ordered, half = np.sort(values), len(values) // 2
    return 0.5 * float(ordered[half] + ordered[~half])


def _squared_residuals(s: Stamps, fits: PointFits, sigma: float) -> tuple[Array, Array, Array, float]:
    """Signal, squared residual (leverage corrected) and variance without the star of pixels (m,) that the stars light.

    Last, the correlation of the stars' residuals: 1 for independent ones.
    """
    signal, squared, relative = np.empty((3, *s.data.shape))
    lit = np.empty(s.data.shape, dtype=np.bool_)
    _fill_squared_residuals(
        s.data, s.variance, fits.xy_px - s.centres, fits.flux, fits.level, fits.covariance, sigma, MODEL_ERROR,
        FAINT_FRACTION, MAX_LEVERAGE, profile_scratch(s.data.shape[1]), signal, squared, relative, lit,
    )  # fmt: skip
    correlation = float(np.sum(np.square(relative.sum(axis=0))) / np.sum(np.square(relative)))
    return signal[lit], squared[lit], s.variance[lit].astype(np.float64), correlation


_fit_stamps = kernel(
    "fit_stamps", "data: float32[n, side >= 3, side]", "variance: float32[n, side, side]",
    "usable: bool[usable_rows, side, side]", "signal: float32[signals, side, side]", "signal_error: float64",
    "which: int64[m]", "start_px: float64[m, 2]", "sigma_px: float64", "per_unit: float64", "model_error: float64",
    "rounds: int64", "max_step_px: float64", "position_prior: float64", "flux_prior: float64", "surround: float64[m]",
    "profiles: out float64[7, side + 1]", "pixels: out float32[7, room]", "xy_px: out float64[m, 2]",
    "values: out float64[m, 8]", "covariance: out float64[m, 4, 4]",
)  # fmt: skip
_fill_squared_residuals = kernel(
    "fill_squared_residuals", "data: float32[n, side, side]", "variance: float32[n, side, side]",
    "offset_px: float64[n, 2]", "flux: float64[n]", "level: float64[n]", "covariance: float64[n, 4, 4]",
    "sigma_px: float64", "model_error: float64", "faint: float64", "most_leverage: float64",
    "profiles: out float64[7, side + 1]", "signal: out float64[n, side, side]", "squared: out float64[n, side, side]",
    "relative: out float64[n, side, side]", "lit: out bool[n, side, side]",
)  # fmt: skip
