"""The width of the PSF, measured from the frame's own bright sources."""

from __future__ import annotations

import numpy as np

from startrack.detection.fit import PointFits
from startrack.detection.frame import Frame, Pixels, radius_for
from startrack.psf import pixel_profile_single
from startrack.types import Array, Bools, Ints

BRIGHT_SNR = 12.0  # sources that say what the frame's PSF is
FEWEST_BRIGHT = 8
MOST_BRIGHT, FEW_BRIGHT = 100, 40  # the second where many widths are tried
NEAR = np.geomspace(0.72, 1.4, 8)  # widths tried first, in units of the expected one
WIDTHS_PX = np.geomspace(0.3, 8.0, 22)
NARROWER_IS_A_PIXEL_PX = 0.45  # hot pixels fit the narrowest profile
AT_THE_END = 0.3  # part of the sources that the widths tried first may fail to hold
STAR_LIKE = 0.75  # of a stamp's variance beyond the noise that a star of the best width explains; clouds: 0.2 to 0.5
SHARP_RATIO = 0.6  # sources narrower than this part of the typical width are stars among something else
SHARP_PART = 0.1  # of the sources, from which these are no accident


def measured_width(frame: Frame, centres: Ints, fits: PointFits, sigma: float) -> float | None:
    """Typical PSF sigma [px] of the bright sources that are like stars; None where there are too few to tell.

    Clouds, moonlight and branches give bumps of any width, the wider the filter the wider: bumps that no Gaussian
    explains say nothing, and of two kinds of width the sharper is the stars'.
    """
    radius = radius_for(sigma)
    bright = np.flatnonzero((fits.snr > BRIGHT_SNR) & (fits.chi2 < fits.chi2_pixel))
    bright = bright[np.argsort(-fits.snr[bright], kind="stable")]
    usable = frame.usable(centres[bright], radius)
    bright = (bright if usable is None else bright[usable.all(axis=(1, 2))])[:MOST_BRIGHT]
    if len(bright) < FEWEST_BRIGHT:
        return None
    pixels = centres[bright]
    data = frame.data(pixels, radius)
    weights = 1.0 / (frame.variance(pixels, radius) + np.float32(frame.light_noise.per_unit) * np.maximum(data, 0.0))
    offset = fits.xy_px[bright] - pixels
    widths, inside, part = fit_widths(data, weights, offset, sigma * NEAR)
    if inside.mean() < 1.0 - AT_THE_END:
        few = slice(0, FEW_BRIGHT)
        widths, inside, part = fit_widths(data[few], weights[few], offset[few], WIDTHS_PX)
    widths = widths[inside & (part > STAR_LIKE) & (widths > NARROWER_IS_A_PIXEL_PX)]
    if len(widths) < FEWEST_BRIGHT:
        return None
    sharp = widths[widths < SHARP_RATIO * np.median(widths)]
    return float(np.median(sharp if len(sharp) >= max(FEWEST_BRIGHT, SHARP_PART * len(widths)) else widths))


def fit_widths(data: Pixels, weights: Pixels, offset_px: Array, widths_px: Array) -> tuple[Array, Bools, Array]:
    """Best-fitting PSF sigma (n,) [px] of each stamp among `widths_px` (m,), geometric; whether it is not the last;
    and the part of the stamp's variance beyond the noise that it explains, about 1 for a star.

    Refined by a parabola through chi^2; flux and level are free, the place is `offset_px` from the middle pixel.
    """
    radius, m = data.shape[1] // 2, len(widths_px)
    moment = weights * data
    total, light = weights.sum(axis=(1, 2)).astype(np.float64), moment.sum(axis=(1, 2)).astype(np.float64)
    profiles = []
    for axis in range(2):
        profile, _ = pixel_profile_single(np.repeat(offset_px[:, axis], m), np.tile(widths_px, len(data)), radius)
        profiles.append(profile.reshape(len(data), m, 2 * radius + 1))
    px, py = profiles
    ss, s1, sd = _sums(weights, py * py, px * px), _sums(weights, py, px), _sums(moment, py, px)
    # chi^2 falls by this much for a star of each width on a level background.
    part, excess = ss - s1 * s1 / total[:, None], sd - s1 * (light / total)[:, None]
    explained = np.square(excess) / np.maximum(part, 1e-30)
    best = np.argmax(explained, axis=1)
    inside = (best > 0) & (best < len(widths_px) - 1)
    best = np.clip(best, 1, len(widths_px) - 2)
    row = np.arange(len(data))
    left, middle, right = explained[row, best - 1], explained[row, best], explained[row, best + 1]
    bend = 2 * middle - left - right
    shift = np.divide(0.5 * (right - left), bend, out=np.zeros_like(bend), where=bend > 0)
    log_width = np.log(widths_px)
    variance = np.einsum("nij,nij->n", moment, data, dtype=np.float64) - light * light / total
    beyond_noise = np.maximum(variance - data[0].size, 1e-30)
    widths = np.exp(log_width[best] + np.clip(shift, -1, 1) * (log_width[1] - log_width[0]))
    return widths, inside, middle / np.maximum(beyond_noise, 0.5 * middle)


def _sums(stamp: Pixels, down: Pixels, across: Pixels) -> Array:
    """Sums (n, m) of the stamps (n, s, s) times profiles (n, m, s) in y and in x."""
    return np.einsum("nms,nms->nm", np.matmul(down, stamp), across).astype(np.float64)
