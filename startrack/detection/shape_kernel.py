"""The compiled loops that compare fitted sources with the PSF, and with straight edges and lines."""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
import math

import numpy as np

from startrack.core.kernels import REORDERED_SUMS, njit
from startrack.detection.fit_kernel import LEAST, ONE, ZERO, bell_curve, fill_profile


@njit(cache=True, fastmath=REORDERED_SUMS)
def compare_shapes(
    data, variance, usable, which, offset_px, flux, level, width_px, per_unit, model_error, stripe, ends, misfit, edge
) -> None:  # fmt: skip
    """Fill misfit (m,) to the PSF and chi^2 as an edge (m,) for the stamps `which` (m,) of (n, s^2).

    The sources of the stamps have the offset (m, 2) from the middle pixel, flux, local level and PSF width; `per_unit`
    and `model_error` are the noise of their own light. `usable` (n, s^2) may have no rows. `stripe` (s^2, d) is the
    stripe of each pixel in d directions, counted on from one direction to the next; `ends` (d,) the number behind each
    direction's last.
    """
    size = data.shape[1]
    side = round(math.sqrt(size))
    profile, slope, bell, bell_px = np.zeros((2, side)), np.zeros((2, side)), np.zeros(0), 0.0
    weight, moment = np.empty(size, np.float32), np.empty(size, np.float32)
    sums = np.empty((ends[-1], 2), np.float32)
    own_noise, error = np.float32(per_unit), np.float32(model_error * model_error)
    for i in range(len(which)):
        k = which[i]
        if width_px[i] != bell_px:
            bell_px = width_px[i]
            bell = bell_curve(bell_px, side // 2)
        for axis in range(2):
            fill_profile(profile, slope, axis, offset_px[i, axis], bell_px, bell)
        shine, flat = max(flux[i], 0.0), np.float32(level[i])
        for r in range(side):
            for c in range(side):
                moment[r * side + c] = shine * profile[1, r] * profile[0, c]
        excess = squared = total = ZERO
        for p in range(size):
            signal, light = moment[p], data[k, p]
            noise, miss = variance[k, p] + own_noise * signal, light - signal - flat
            use = ONE if len(usable) == 0 or usable[k, p] else ZERO
            weight[p] = use / (noise + error * signal * signal)
            excess += use * (miss * miss - noise)
            squared += use * signal * signal
            moment[p] = weight[p] * light
            total += moment[p] * light
        misfit[i] = math.sqrt(max(excess, ZERO) / max(squared, LEAST))
        edge[i] = total - _most_explained(weight, moment, stripe, ends, sums)


@njit(inline="always")
def _most_explained(weight, moment, stripe, ends, sums):
    """The largest reduction of chi^2 by stripes in one direction, less the number of stripes."""
    sums[:] = ZERO
    for p in range(len(weight)):
        for d in range(stripe.shape[1]):
            sums[stripe[p, d], 0] += weight[p]
            sums[stripe[p, d], 1] += moment[p]
    most, first = -np.inf, 0
    for d in range(len(ends)):
        explained = np.float32(first - ends[d])
        for j in range(first, ends[d]):
            explained += sums[j, 1] * sums[j, 1] / max(sums[j, 0], LEAST)
        most, first = max(most, explained), ends[d]
    return most


@njit(cache=True, fastmath=REORDERED_SUMS)
def fill_squared_residuals(
    data, variance, offset_px, flux, level, covariance, sigma_px, model_error, faint, most, signal, squared, relative,
    lit,
) -> None:  # fmt: skip
    """Fill the outputs (n, s^2) for the fitted sources of stamps (n, s^2).

    Outputs: the sources' `signal`; the `squared` residual, corrected by the leverage of the pixel; the `relative`
    residual, of unit mean square in each stamp; which pixels are `lit` by more than `faint` of their variance, with a
    leverage below `most`. `covariance` (n, 4, 4) is that of offset, flux and level.
    """
    side = round(math.sqrt(data.shape[1]))
    profile, slope, bell = np.zeros((2, side)), np.zeros((2, side)), bell_curve(sigma_px, side // 2)
    for i in range(len(data)):
        for axis in range(2):
            fill_profile(profile, slope, axis, offset_px[i, axis], sigma_px, bell)
        shine, c, total = max(flux[i], 0.0), covariance[i], 0.0
        for row in range(side):
            for column in range(side):
                p = row * side + column
                f = profile[1, row] * profile[0, column]
                x, y = shine * profile[1, row] * slope[0, column], shine * slope[1, row] * profile[0, column]
                signal[i, p] = shine * f
                residual = data[i, p] - signal[i, p] - level[i]
                error = model_error * signal[i, p]
                spread = (
                    x * (c[0, 0] * x + 2.0 * (c[0, 1] * y + c[0, 2] * f + c[0, 3]))
                    + y * (c[1, 1] * y + 2.0 * (c[1, 2] * f + c[1, 3]))
                    + f * (c[2, 2] * f + 2.0 * c[2, 3])
                    + c[3, 3]
                )
                leverage = spread / max(residual * residual, variance[i, p] + error * error)
                lit[i, p] = signal[i, p] > faint * variance[i, p] and leverage < most
                squared[i, p] = residual * residual / (1.0 - leverage)
                relative[i, p] = residual
                total += residual * residual
        for p in range(data.shape[1]):
            relative[i, p] /= max(math.sqrt(total / data.shape[1]), 1e-30)


@njit(cache=True, fastmath=REORDERED_SUMS)
def explain_by_widths(data, weights, offset_px, widths_px, explained, variance):
    """Fill explained (n, m): how much a star of each width on a constant level reduces chi^2 of the stamps (n, s^2).

    `weights` are 1 / variance of the pixels, `offset_px` (n, 2) the stars' positions from the middle pixel. `variance`
    (n,) becomes chi^2 of a constant level alone.
    """
    side = round(math.sqrt(data.shape[1]))
    profile, slope = np.zeros((2, side)), np.zeros((2, side))
    for j in range(len(widths_px)):
        bell = bell_curve(widths_px[j], side // 2)
        for i in range(len(data)):
            for axis in range(2):
                fill_profile(profile, slope, axis, offset_px[i, axis], widths_px[j], bell)
            total = signal = squared = ss = s1 = sd = 0.0
            for row in range(side):
                for column in range(side):
                    light, weight = data[i, row * side + column], weights[i, row * side + column]
                    weighted = weight * profile[1, row] * profile[0, column]
                    total += weight
                    signal += weight * light
                    squared += weight * light * light
                    ss += weighted * profile[1, row] * profile[0, column]
                    s1 += weighted
                    sd += weighted * light
            excess = sd - s1 * signal / total
            explained[i, j] = excess * excess / max(ss - s1 * s1 / total, 1e-30)
            variance[i] = squared - signal * signal / total
