"""The width of the PSF, measured from the frame's own bright sources."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from startrack.core.types import Array, Bools, Ints
from startrack.detection.fit import FIT_ROUNDS_AGAIN, PointFits, Stamps, fit_points, profile_scratch
from startrack.detection.frame import Frame, Pixels, lie_inside, radius_for
from startrack.detection.peaks import bright_pixels, find_peaks
from startrack.kernels.library import kernel

WIDTH_SNR = 12.0  # of the sources from which the width is measured
WIDTH_TOLERANCE = 0.12  # a measured PSF that differs by more than this fraction from the expected one replaces it
WIDTH_ROUNDS = 4  # a stamp of the wrong size measures a much wider PSF too small
BRIGHT_PIXEL_SIGMAS, MAX_BRIGHT_PIXELS, MIN_BRIGHT_PIXELS = 8.0, 64, 30
MIN_BESIDE, MIN_FALL, MAX_FALL = 0.02, 0.05, 3.5  # relative signal beside a peak; its fall for 4.5 px and 0.45 px
MIN_BRIGHT_SOURCES = 8
MAX_BRIGHT_SOURCES, MAX_SOURCES_ALL_WIDTHS = 100, 40  # the second where many widths are tried
NEAR_WIDTHS = np.geomspace(0.72, 1.4, 8)  # widths tried first, in units of the expected one
WIDTHS_PX = np.geomspace(0.3, 8.0, 22)
NARROWER_IS_A_PIXEL_PX = 0.45  # hot pixels fit the narrowest profile
MAX_END_FRACTION = 0.3  # largest fraction of sources with a best width at the end of NEAR_WIDTHS
STAR_LIKE = 0.75  # fraction of a stamp's variance beyond the noise that a star explains; clouds: 0.2 to 0.5
SHARP_RATIO = 0.6  # of the typical width: narrower sources are stars among clouds
SHARP_FRACTION = 0.1  # of the sources: smallest number of narrow ones that is significant


def measure_psf_width(frame: Frame, centres: Ints, fits: PointFits, sigma: float) -> float | None:
    """Typical PSF sigma [px] of the bright sources that are like stars; None where there are too few.

    Clouds, moonlight and branches give peaks of any width, wider ones with a wider filter. Peaks that no Gaussian fits
    are left out; if two groups of widths remain, the narrower one is the stars'.
    """
    radius = radius_for(sigma)
    bright = np.flatnonzero((fits.snr > WIDTH_SNR) & (fits.chi2 < fits.chi2_pixel))
    bright = bright[np.argsort(-fits.snr[bright], kind="stable")]
    usable = frame.usable_pixels(centres[bright], radius)
    bright = (bright if usable is None else bright[usable.all(axis=(1, 2))])[:MAX_BRIGHT_SOURCES]
    if len(bright) < MIN_BRIGHT_SOURCES:
        return None
    pixels = centres[bright]
    data, variance = frame.cut_light(pixels, radius)
    weights = 1.0 / (variance + np.float32(frame.source_noise.per_unit) * np.maximum(data, 0.0))
    offset = fits.xy_px[bright] - pixels
    widths, inside, part = fit_widths(data, weights, offset, sigma * NEAR_WIDTHS)
    if inside.mean() < 1.0 - MAX_END_FRACTION:
        few = slice(0, MAX_SOURCES_ALL_WIDTHS)
        widths, inside, part = fit_widths(data[few], weights[few], offset[few], WIDTHS_PX)
    widths = widths[inside & (part > STAR_LIKE) & (widths > NARROWER_IS_A_PIXEL_PX)]
    if len(widths) < MIN_BRIGHT_SOURCES:
        return None
    sharp = widths[widths < SHARP_RATIO * np.median(widths)]
    return float(np.median(sharp if len(sharp) >= max(MIN_BRIGHT_SOURCES, SHARP_FRACTION * len(widths)) else widths))


def fit_widths(data: Pixels, weights: Pixels, offset_px: Array, widths_px: Array) -> tuple[Array, Bools, Array]:
    """Best-fitting PSF sigma (n,) [px] of each stamp among `widths_px` (m,), a geometric series.

    Then whether the best width is neither the first nor the last one (n,), and the fraction (n,) of a stamp's variance
    beyond the noise that the fit explains, about 1 for a star. Refined by a parabola through chi^2; flux and level are
    free, the position is `offset_px` from the middle pixel.
    """
    size, explained, variance = data[0].size, np.empty((len(data), len(widths_px))), np.empty(len(data))
    _explain_by_widths(data, weights, offset_px, widths_px, profile_scratch(data.shape[1]), explained, variance)
    best = np.argmax(explained, axis=1)
    inside = (best > 0) & (best < len(widths_px) - 1)
    best = np.clip(best, 1, len(widths_px) - 2)
    row = np.arange(len(data))
    left, middle, right = explained[row, best - 1], explained[row, best], explained[row, best + 1]
    bend = 2 * middle - left - right
    shift = np.divide(0.5 * (right - left), bend, out=np.zeros_like(bend), where=bend > 0)
    log_width = np.log(widths_px)
    beyond_noise = np.maximum(variance - size, 1e-30)
    widths = np.exp(log_width[best] + np.clip(shift, -1, 1) * (log_width[1] - log_width[0]))
    return widths, inside, middle / np.maximum(beyond_noise, 0.5 * middle)


def guess_psf_width(prepare: Callable[[float], Frame], sigma: float) -> float:
    """PSF sigma [px] from the brightest pixels; the first guess if they give none.

    `prepare` returns the frame with the background for a given PSF width.
    """
    frame = prepare(sigma)
    pixels = bright_pixels(frame, BRIGHT_PIXEL_SIGMAS, MAX_BRIGHT_PIXELS)
    if len(pixels) < MIN_BRIGHT_PIXELS:  # too few stand out by one pixel
        found = find_peaks(frame, sigma, WIDTH_SNR, MAX_BRIGHT_PIXELS).centres
        pixels = found if len(found) > len(pixels) else pixels
    elif (guess := _width_by_fall(frame, pixels)) is not None:
        sigma = guess
    for _ in range(WIDTH_ROUNDS):
        radius = radius_for(sigma)
        centres = pixels[lie_inside(pixels, frame.shape, radius)]
        if not len(centres):
            break
        data, variance = frame.cut_light(centres, radius)
        stamps = Stamps(data, variance, frame.usable_pixels(centres, radius), centres, np.zeros(len(centres)))
        every, start = np.arange(len(centres)), centres.astype(np.float64)
        fits = fit_points(stamps, every, start, sigma, frame.source_noise, 0.0, FIT_ROUNDS_AGAIN)
        measured = measure_psf_width(frame, centres, fits, sigma)
        if measured is None:
            break
        settled = abs(np.log(measured / sigma)) < WIDTH_TOLERANCE
        sigma = measured
        if settled:
            break
    return sigma


def _width_by_fall(frame: Frame, pixels: Ints) -> float | None:
    """Approximate PSF sigma [px] of sources with brightest pixels (n, 2) off the border; None outside the valid range.

    For a Gaussian of variance s^2 the product of the values left and right of a pixel is the square of the pixel's
    value times exp(-1 / s^2), independent of the centre.
    """
    signal = np.maximum(frame.cut_light(pixels, 1)[0], 0.0)
    peak = np.maximum(signal[:, 1, 1], 1e-9)
    beside = np.stack([signal[:, 1, 0], signal[:, 1, 2], signal[:, 0, 1], signal[:, 2, 1]], axis=1) / peak[:, None]
    falls = -0.5 * float(np.median(np.log(np.maximum(beside, MIN_BESIDE)).sum(axis=1)))
    if not MIN_FALL < falls < MAX_FALL:
        return None
    return float(np.sqrt(1.0 / falls - 1.0 / 12.0))


_explain_by_widths = kernel(
    "explain_by_widths", "data: float32[n, side, side]", "weights: float32[n, side, side]", "offset_px: float64[n, 2]",
    "widths_px: float64[m]", "profiles: out float64[7, side + 1]", "explained: out float64[n, m]",
    "variance: out float64[n]",
)  # fmt: skip
