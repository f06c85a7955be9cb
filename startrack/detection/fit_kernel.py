"""The compiled loop of the point-source fits: Gauss-Newton on one stamp after the other."""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
import math

import numpy as np

from startrack.core.kernels import REORDERED_SUMS, njit
from startrack.psf import ERF_COEFFICIENTS, ERF_T

MAX_STEP_PX = 0.5
POSITION_PRIOR = 0.1  # per px^2: positions within about 3 px of the start keep sources without light solvable
FLUX_PRIOR = 1e-12
SQRT_2PI = math.sqrt(2.0 * math.pi)
ERF_SCALE, A1, A2, A3, A4, A5 = float(ERF_T), *(float(a) for a in ERF_COEFFICIENTS)


@njit(cache=True, nogil=True, fastmath=REORDERED_SUMS, error_model="numpy")
def fit_stamps(
    data, variance, usable, start_px, sigma_px, per_unit, model_error, rounds, surround, xy_px, values, covariance
) -> None:
    """Fit one point source to each stamp (n, s, s) and fill the outputs.

    `usable` (n, s, s) may have no rows: all pixels then are. `start_px` (n, 2) are offsets from the middle pixel,
    `per_unit` and `model_error` the noise of the source's own light, `surround` (n,) the level of its surroundings.
    Outputs: offsets `xy_px` (n, 2); `covariance` (n, 4, 4) of x, y, flux, level; `values` (n, 8): flux, level, chi^2,
    chi^2 of a single pixel, usable pixels, and the sums over pixels of the matched filter times the light above the
    surroundings, times the profile, and times the profile with the own photons' noise.
    """
    n, side = data.shape[0], data.shape[1]
    radius = side // 2
    profile, slope, centre = np.zeros((2, side)), np.zeros((2, side)), np.zeros(2)
    weight, miss = np.zeros((side, side)), np.zeros((side, side))
    size = covariance.shape[1]  # 4
    normal, right, delta = np.zeros((size, size)), np.zeros(size), np.zeros(size)
    for i in range(n):
        for axis in range(2):
            centre[axis] = min(max(start_px[i, axis], -radius), radius)
        flux, level = 0.0, 0.0
        for step in range(rounds + 1):
            if step != 1:  # the first step leaves the position as it is
                for axis in range(2):
                    _profile(profile, slope, axis, centre[axis], sigma_px, radius)
            shine = max(flux, 0.0)
            for r in range(side):
                for c in range(side):
                    shape = profile[1, r] * profile[0, c]
                    light = shine * shape
                    noise = variance[i, r, c] + light * (per_unit + model_error * model_error * light)
                    weight[r, c] = 1.0 / noise
                    miss[r, c] = data[i, r, c] - flux * shape - level
            if len(usable) > 0:
                for r in range(side):
                    for c in range(side):
                        if not usable[i, r, c]:
                            weight[r, c] = 0.0
            _normal_equations(weight, miss, flux, profile, slope, normal, right)
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
        _judge(data, variance, usable, i, weight, miss, profile, flux, per_unit, surround, values)


@njit(inline="always")
def _profile(profile, slope, axis, offset, sigma_px, radius) -> None:
    """Row `axis`: the pixel-integrated Gaussian and its derivative by the offset, as `psf.pixel_profile_single`."""
    last_area, last_density = 0.0, 0.0
    for j in range(2 * radius + 2):
        edge = (j - radius - 0.5 - offset) / sigma_px
        density = math.exp(-0.5 * edge * edge)
        t = 1.0 / (1.0 + ERF_SCALE * abs(edge))
        area = 0.5 - density * t * (A1 + t * (A2 + t * (A3 + t * (A4 + t * A5))))
        area = area if edge >= 0.0 else -area
        density /= sigma_px * SQRT_2PI
        if j > 0:
            profile[axis, j - 1], slope[axis, j - 1] = area - last_area, last_density - density
        last_area, last_density = area, density


@njit(inline="always")
def _normal_equations(weight, miss, flux, profile, slope, normal, right) -> None:
    """Normal matrix (4, 4), symmetric, and right side (4,) for x, y, flux, level: sums over x, then over y."""
    side = profile.shape[1]
    xx = yy = xy = xf = yf = xl = yl = ff = fl = ll = bx = by = bf = bl = 0.0
    for r in range(side):
        w = wp = wd = wpp = wpd = wdd = m = mp = md = 0.0
        for c in range(side):
            v, p, d = weight[r, c], profile[0, c], slope[0, c]
            e = v * miss[r, c]
            w += v
            wp += v * p
            wd += v * d
            wpp += v * p * p
            wpd += v * p * d
            wdd += v * d * d
            m += e
            mp += e * p
            md += e * d
        p, d = profile[1, r], slope[1, r]
        xx += p * p * wdd
        yy += d * d * wpp
        xy += p * d * wpd
        xf += p * p * wpd
        yf += p * d * wpp
        xl += p * wd
        yl += d * wp
        ff += p * p * wpp
        fl += p * wp
        ll += w
        bx += p * md
        by += d * mp
        bf += p * mp
        bl += m
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
def _judge(data, variance, usable, i, weight, miss, profile, flux, per_unit, surround, values) -> None:
    """Fill values[i, 2:] for the fitted source: how well it fits, how well a single pixel does, and filter sums."""
    side = profile.shape[1]
    middle = side // 2
    hot_r, hot_c = middle - 1, middle - 1
    for r in range(middle - 1, middle + 2):
        for c in range(middle - 1, middle + 2):
            if data[i, r, c] > data[i, hot_r, hot_c]:
                hot_r, hot_c = r, c
    shine = max(flux, 0.0)
    chi2 = count = above = norm = own = total = light_sum = 0.0
    for r in range(side):
        for c in range(side):
            chi2 += weight[r, c] * miss[r, c] * miss[r, c]
            if len(usable) > 0 and not usable[i, r, c]:
                continue
            count += 1.0
            plain, shape = 1.0 / variance[i, r, c], profile[1, r] * profile[0, c]
            above += plain * shape * (data[i, r, c] - surround[i])
            norm += plain * shape * shape
            own += plain * shape * shape / (1.0 + per_unit * shine * shape * plain)
            if r != hot_r or c != hot_c:
                total += plain
                light_sum += plain * data[i, r, c]
    mean = light_sum / max(total, 1e-300)
    chi2_pixel = 0.0
    for r in range(side):
        for c in range(side):
            if (r != hot_r or c != hot_c) and (len(usable) == 0 or usable[i, r, c]):
                chi2_pixel += (data[i, r, c] - mean) ** 2 / variance[i, r, c]
    values[i, 2], values[i, 3], values[i, 4] = chi2, chi2_pixel, count
    values[i, 5], values[i, 6], values[i, 7] = above, norm, own
