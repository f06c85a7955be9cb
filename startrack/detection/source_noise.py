"""Noise of the sources' own signal from the residuals of bright stars: photon noise and PSF misfit."""

from __future__ import annotations

import numpy as np

from startrack.core.types import Array, Bools, Ints
from startrack.detection.fit import PointFits, Stamps
from startrack.detection.frame import MODEL_ERROR, SourceNoise
from startrack.psf import pixel_profile

BRIGHT_SNR = 15.0
MIN_STARS, MAX_STARS = 20, 120
FAINT_FRACTION = 0.3  # of the pixel's variance: pixels with less signal are left out
MAX_LEVERAGE = 0.5  # residuals of pixels with a larger leverage do not show the noise
BINS, MIN_PIXELS_PER_BIN = 12, 15
MAX_CORRELATION = 2.0
MEDIAN_OF_SQUARE = 0.4549  # of a unit Gaussian
MIN_MODEL_ERROR = 0.005


def measure_source_noise(s: Stamps, fits: PointFits, alone: Bools, sigma: float, expected: SourceNoise) -> SourceNoise:
    """The source noise of the frame; `expected` where bright stars are too few. Stated photon noise is kept.

    From isolated stars `alone` (n,): in bins of a pixel's signal s, the median squared residual minus the variance
    without the star is a s + b s^2. The PSF misfit is at most the expected one. If the residuals of different stars are
    correlated, the PSF differs from the model, and unknown photon noise cannot be separated from that.
    """
    bright = _select_bright(s, fits, alone)
    if len(bright) < MIN_STARS:
        return expected
    signal, excess, correlation = _excess_variance(s.take(bright), fits.take(bright), sigma)
    if expected.per_unit == 0.0 and correlation > MAX_CORRELATION:
        return expected
    if len(signal) < BINS * MIN_PIXELS_PER_BIN:
        return expected
    order = np.argsort(signal, kind="stable")
    bins = [part for part in np.array_split(order, BINS) if len(part) >= MIN_PIXELS_PER_BIN]
    rows = [(np.median(signal[part]), *_typical_excess(excess[:, part])) for part in bins]
    level, beyond, error = np.array(rows).T
    return _fit_noise_terms(level, beyond, error, expected)


def _fit_noise_terms(level: Array, beyond: Array, error: Array, expected: SourceNoise) -> SourceNoise:
    """Weighted least squares for a and b, neither below 0; a is kept where it is known."""
    one, two = level / error, level**2 / error
    per_unit = expected.per_unit
    if per_unit == 0.0:
        normal = np.array([[one @ one, one @ two], [one @ two, two @ two]])
        right = np.array([one @ (beyond / error), two @ (beyond / error)])
        per_unit, b = np.linalg.solve(normal, right)
        per_unit = float(max(per_unit if b >= 0 else right[0] / normal[0, 0], 0.0))
    b = float(two @ ((beyond - per_unit * level) / error) / (two @ two))
    return SourceNoise(per_unit, float(np.clip(np.sqrt(max(b, 0.0)), MIN_MODEL_ERROR, MODEL_ERROR)))


def _select_bright(s: Stamps, fits: PointFits, alone: Bools) -> Ints:
    good = alone & (fits.snr > BRIGHT_SNR) & (fits.chi2 < fits.chi2_pixel)
    if s.usable is not None:
        good &= s.usable.all(axis=(1, 2))
    which = np.flatnonzero(good)
    # Stars of every brightness: the brightest determine the PSF misfit, the others the photon noise.
    return which[np.argsort(-fits.snr[which], kind="stable")][:: max(1, len(which) // MAX_STARS)]


def _excess_variance(s: Stamps, fits: PointFits, sigma: float) -> tuple[Array, Array, float]:
    """Signal (m,) of the stars' pixels, squared residuals (leverage corrected) and variances (2, m), and the
    correlation of the stars' residuals: 1 for independent ones.
    """
    radius = s.data.shape[1] // 2
    offset, n = fits.xy_px - s.centres, len(s.data)
    px, dx = pixel_profile(offset[:, 0], sigma, radius)
    py, dy = pixel_profile(offset[:, 1], sigma, radius)
    flux = np.maximum(fits.flux, 0.0)[:, None, None]
    shape = py[:, :, None] * px[:, None, :]
    signal = flux * shape
    gradient = [flux * py[:, :, None] * dx[:, None, :], flux * dy[:, :, None] * px[:, None, :], shape, 1.0 + 0 * shape]
    g = np.stack([q.reshape(n, -1) for q in gradient], axis=1)
    residual = (s.data - signal - fits.level[:, None, None]).reshape(n, -1)
    squared = np.square(residual)
    variance = s.variance.reshape(n, -1).astype(np.float64)
    seen = np.maximum(squared, variance + np.square(MODEL_ERROR * signal.reshape(n, -1)))
    leverage = np.sum(g * np.matmul(fits.covariance, g), axis=1) / seen
    use = (signal.reshape(n, -1) > FAINT_FRACTION * variance) & (leverage < MAX_LEVERAGE)
    relative = residual / flux[:, :, 0]
    relative /= np.maximum(
        np.sqrt(np.mean(np.square(relative), axis=1, keepdims=True)), 1e-30
    )  # equal weight for each star
    correlation = float(np.sum(np.square(relative.sum(axis=0))) / np.sum(np.square(relative)))
    return signal.reshape(n, -1)[use], np.stack([(squared / (1.0 - leverage))[use], variance[use]]), correlation


def _typical_excess(squared_and_variance: Array) -> tuple[float, float]:
    """Excess variance over that of a pixel without the star, and its error."""
    total = float(np.median(squared_and_variance[0])) / MEDIAN_OF_SQUARE
    dark = float(np.median(squared_and_variance[1]))
    return total - dark, max(total, dark) * 2.0 / np.sqrt(squared_and_variance.shape[1])
