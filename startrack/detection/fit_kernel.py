"""The compiled loop of the point-source fits: Gauss-Newton on one stamp after the other.

Pixels are in single precision, twice as many at a time; positions, fluxes and their equations in double precision.
"""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
import math

import numpy as np

from startrack.core.kernels import REORDERED_SUMS, njit
from startrack.psf import ERF_COEFFICIENTS, ERF_T

MAX_STEP_PX = 0.5
POSITION_PRIOR = 0.1  # per px^2: positions within about 3 px of the start keep sources without light solvable
FLUX_PRIOR = 1e-12
NARROWEST_PX = 0.1  # a narrower PSF is one pixel as well; its exponentials would overflow
LANES = 32  # stamps are filled up to a multiple of these pixels, which the compiler treats together
ZERO, ONE, LEAST = np.float32(0.0), np.float32(1.0), np.float32(1e-30)  # literals would be of double precision
SQRT_2PI = math.sqrt(2.0 * math.pi)
ERF_SCALE, A1, A2, A3, A4, A5 = float(ERF_T), *(float(a) for a in ERF_COEFFICIENTS)


@njit(cache=True, fastmath=REORDERED_SUMS)
def fit_stamps(
    data, variance, usable, signal, signal_error, which, start_px, sigma_px, per_unit, model_error, rounds, surround,
    xy_px, values, covariance,
) -> None:  # fmt: skip
    """Fit one point source to each of the stamps `which` (m,) of (n, s^2), and fill the outputs.

    `usable` (n, s^2) may have no rows: all pixels then are. `signal` (m, s^2), the neighbours' light with the
    relative error `signal_error`, is subtracted; it may have no rows either. `start_px` (m, 2) are offsets from the
    middle pixel, `per_unit` and `model_error` the noise of the source's own light, `surround` (m,) the level of its
    surroundings. Outputs: offsets `xy_px` (m, 2); `covariance` (m, 4, 4) of x, y, flux, level; `values` (m, 8): flux,
    level, chi^2, chi^2 of a single pixel, usable pixels, and the sums over pixels of the matched filter times the light
    above the surroundings, times the profile, and times the profile with the own photons' noise.
    """
    side = round(math.sqrt(data.shape[1]))
    radius = side // 2
    profile, slope, centre = np.zeros((2, side), np.float32), np.zeros((2, side), np.float32), np.zeros(2)
    bell = bell_curve(sigma_px, radius)
    # Pixel by pixel: light, variance, 1 where usable; profile of the source and its slopes in x and y.
    padded = (side * side + LANES - 1) // LANES * LANES
    pixels, shapes = np.zeros((3, padded), np.float32), np.zeros((3, padded), np.float32)
    pixels[1] = ONE
    size = covariance.shape[1]  # 4
    normal, right, delta = np.zeros((size, size)), np.zeros(size), np.zeros(size)
    for i in range(len(which)):
        _read_stamp(data, variance, usable, signal, signal_error, which[i], i, pixels)
        for axis in range(2):
            centre[axis] = min(max(start_px[i, axis], -radius), radius)
        flux, level = 0.0, 0.0
        for step in range(rounds + 1):
            if step != 1:  # the first step leaves the position as it is
                for axis in range(2):
                    fill_profile(profile, slope, axis, centre[axis], sigma_px, bell)
                for r in range(side):
                    for c in range(side):
                        shapes[0, r * side + c] = profile[1, r] * profile[0, c]
                        shapes[1, r * side + c] = profile[1, r] * slope[0, c]
                        shapes[2, r * side + c] = slope[1, r] * profile[0, c]
            _normal_equations(pixels, shapes, flux, level, per_unit, model_error, normal, right)
            if step == 0:  # flux and level first: without a flux the position has no gradient
                a, b, d = normal[2, 2], normal[2, 3], normal[3, 3]
                determinant = max(a * d - b * b, 1e-300)
                flux = (d * right[2] - b * right[3]) / determinant
                level = (a * right[3] - b * right[2]) / determinant
                continue
            _factorise(normal)
            # The columns of the inverse, once the fit has converged, and the step.
            for k in range(0 if step == rounds else size, size + 1):
                for m in range(size):
                    delta[m] = right[m] if k == size else (1.0 if m == k else 0.0)
                _solve(normal, delta)
                for m in range(size):
                    if k < size:
                        covariance[i, m, k] = delta[m]
            if step < rounds:
                for axis in range(2):
                    moved = centre[axis] + min(max(delta[axis], -MAX_STEP_PX), MAX_STEP_PX)
                    centre[axis] = min(max(moved, -radius), radius)
                flux += delta[2]
                level += delta[3]
        xy_px[i, 0], xy_px[i, 1] = centre[0], centre[1]
        values[i, 0], values[i, 1] = flux, level
        _judge(pixels, shapes[0], side, flux, level, per_unit, model_error, surround[i], values[i])


@njit(inline="always")
def _read_stamp(data, variance, usable, signal, signal_error, k, i, pixels) -> None:
    """Fill pixels (3, m): light, variance and usability of stamp k without the neighbours' signal i."""
    size, error = data.shape[1], np.float32(signal_error * signal_error)
    for p in range(size):
        pixels[0, p], pixels[1, p], pixels[2, p] = data[k, p], variance[k, p], ONE
    if len(signal):
        for p in range(size):
            pixels[0, p] -= signal[i, p]
            pixels[1, p] += error * signal[i, p] * signal[i, p]
    if len(usable):
        for p in range(size):
            pixels[2, p] = ONE if usable[k, p] else ZERO


@njit(inner=True, fastmath=REORDERED_SUMS)
def bell_curve(sigma_px, radius):
    """exp(-x^2 / 2 sigma^2) at x = 1/2, 3/2, ..., as far as a stamp's edge is from a source at its other edge [px]."""
    at = (np.arange(5 * radius + 2) + 0.5) / max(sigma_px, NARROWEST_PX)
    return np.exp(-0.5 * at * at)


@njit(inner=True, fastmath=REORDERED_SUMS)
def fill_profile(profile, slope, axis, offset, sigma_px, bell) -> None:
    """Row `axis`: the pixel-integrated Gaussian and its derivative by the offset, as `psf.pixel_profile_single`.

    A Gaussian about the source is one about a pixel (`bell`) times exponentials of x, which are powers of one.
    """
    side, sigma = profile.shape[1], max(sigma_px, NARROWEST_PX)
    whole = round(offset)
    part = offset - whole
    first = -(side // 2) - whole - 0.5  # the first edge from the pixel nearest to the source
    ratio = math.exp(part / (sigma * sigma))
    power = math.exp((first - 0.5 * part) * part / (sigma * sigma))
    last_area, last_density = 0.0, 0.0
    for j in range(side + 1):
        edge = (first + j - part) / sigma
        density = bell[int(abs(first + j))] * power
        power *= ratio
        t = 1.0 / (1.0 + ERF_SCALE * abs(edge))
        area = 0.5 - density * t * (A1 + t * (A2 + t * (A3 + t * (A4 + t * A5))))
        area = area if edge >= 0.0 else -area
        density /= sigma * SQRT_2PI
        if j > 0:
            profile[axis, j - 1], slope[axis, j - 1] = area - last_area, last_density - density
        last_area, last_density = area, density


@njit(inline="always")
def _normal_equations(pixels, shapes, flux, level, per_unit, model_error, normal, right) -> None:
    """Normal matrix (4, 4), symmetric, and right side (4,) for x, y, flux, level."""
    light, variance, use = pixels[0], pixels[1], pixels[2]
    shape, by_x, by_y = shapes[0], shapes[1], shapes[2]
    bright, flat, own_noise = np.float32(flux), np.float32(level), np.float32(per_unit)
    shine, error = max(bright, ZERO), np.float32(model_error * model_error)
    xx = yy = xy = xf = yf = xl = yl = ff = fl = ll = bx = by = bf = bl = ZERO
    for k in range(len(light)):
        f, x, y = shape[k], by_x[k], by_y[k]
        own = shine * f
        weight = use[k] / (variance[k] + own * (own_noise + error * own))
        miss = light[k] - bright * f - flat
        wf, wx, wy = weight * f, weight * x, weight * y
        xx += wx * x
        yy += wy * y
        xy += wx * y
        xf += wx * f
        yf += wy * f
        xl += wx
        yl += wy
        ff += wf * f
        fl += wf
        ll += weight
        bx += wx * miss
        by += wy * miss
        bf += wf * miss
        bl += weight * miss
    normal[0, 0], normal[1, 1] = flux * flux * xx + POSITION_PRIOR, flux * flux * yy + POSITION_PRIOR
    normal[2, 2], normal[3, 3] = ff + FLUX_PRIOR, ll + FLUX_PRIOR
    normal[1, 0], normal[2, 0], normal[2, 1] = flux * flux * xy, flux * xf, flux * yf
    normal[3, 0], normal[3, 1], normal[3, 2] = flux * xl, flux * yl, fl
    normal[2, 3] = fl
    right[0], right[1], right[2], right[3] = flux * bx, flux * by, bf, bl


@njit(inline="always")
def _factorise(matrix) -> None:
    """Cholesky factor of a positive definite matrix (4, 4) in place of its lower triangle, 1 / root on the diagonal."""
    size = len(matrix)  # a constant would be unrolled into much code
    for j in range(size):
        rest = matrix[j, j]
        for k in range(j):
            rest -= matrix[j, k] * matrix[j, k]
        matrix[j, j] = 1.0 / math.sqrt(max(rest, 1e-300))
        for i in range(j + 1, size):
            rest = matrix[i, j]
            for k in range(j):
                rest -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = rest * matrix[j, j]


@njit(inline="always")
def _solve(factor, x) -> None:
    """Replace a right side (4,) by its solution, by the factor of `_factorise`."""
    size = len(x)
    for i in range(size):
        rest = x[i]
        for k in range(i):
            rest -= factor[i, k] * x[k]
        x[i] = rest * factor[i, i]
    for m in range(size):
        i = size - 1 - m
        rest = x[i]
        for k in range(i + 1, size):
            rest -= factor[k, i] * x[k]
        x[i] = rest * factor[i, i]


@njit(inline="always")
def _judge(pixels, shape, side, flux, level, per_unit, model_error, surround, values) -> None:
    """Fill values[2:] for the fitted source: how well it fits, how well a single pixel does, and filter sums."""
    light, variance, use = pixels[0], pixels[1], pixels[2]
    middle = side * side // 2
    hot = middle - side - 1  # the brightest pixel of the middle nine
    for r in range(-1, 2):
        for c in range(-1, 2):
            k = middle + r * side + c
            hot = k if light[k] > light[hot] else hot
    bright, flat, around, own_noise = np.float32(flux), np.float32(level), np.float32(surround), np.float32(per_unit)
    shine, error = max(bright, ZERO), np.float32(model_error * model_error)
    chi2 = count = above = norm = own = total = light_sum = ZERO
    for k in range(len(light)):
        plain, glow = use[k] / variance[k], shine * shape[k]
        miss = light[k] - bright * shape[k] - flat
        filtered = plain * shape[k]
        chi2 += use[k] * miss * miss / (variance[k] + glow * (own_noise + error * glow))
        count += use[k]
        above += filtered * (light[k] - around)
        norm += filtered * shape[k]
        own += filtered * shape[k] / (ONE + own_noise * glow * plain)
    use[hot] = ZERO
    for k in range(len(light)):
        total += use[k] / variance[k]
        light_sum += use[k] / variance[k] * light[k]
    mean, chi2_pixel = light_sum / max(total, LEAST), ZERO
    for k in range(len(light)):
        chi2_pixel += use[k] * (light[k] - mean) ** 2 / variance[k]
    values[2], values[3], values[4] = chi2, chi2_pixel, count
    values[5], values[6], values[7] = above, norm, own


@njit(cache=True, fastmath=REORDERED_SUMS)
def sum_neighbours(star, offset_px, flux, sigma_px, variance, limit_sigma, last, signal, changed) -> None:
    """Fill signal (k, s, s) with the light of sources in the stamps of the k different stars among `star` (m,).

    The sources are `offset_px` (m, 2) from the middle of the stamp of `star`, which is sorted. `changed` (k,): whether
    the light and its difference from `last` (n, s, s) exceed `limit_sigma` of a pixel's noise.
    """
    side = last.shape[1]
    profile, slope, bell = np.zeros((2, side)), np.zeros((2, side)), bell_curve(sigma_px, side // 2)
    k = -1
    for i in range(len(star)):
        if i == 0 or star[i] != star[i - 1]:
            k += 1
            signal[k] = 0.0
        for axis in range(2):
            fill_profile(profile, slope, axis, offset_px[i, axis], sigma_px, bell)
        for r in range(side):
            for c in range(side):
                signal[k, r, c] += max(flux[i], 0.0) * profile[1, r] * profile[0, c]
        if i + 1 < len(star) and star[i + 1] == star[i]:
            continue
        matters = differs = False
        for r in range(side):
            for c in range(side):
                limit = limit_sigma * limit_sigma * variance[star[i], r, c]
                matters |= signal[k, r, c] ** 2 > limit
                differs |= (signal[k, r, c] - last[star[i], r, c]) ** 2 > limit
        changed[k] = matters and differs
