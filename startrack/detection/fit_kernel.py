"""The compiled loop of the point-source fits: Gauss-Newton on one stamp after the other."""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
import math

import numpy as np
from numba import njit

from startrack.psf import ERF_COEFFICIENTS, ERF_T

MAX_STEP_PX = 0.5
POSITION_PRIOR = 0.1  # per px^2: positions within about 3 px of the start keep sources without light solvable
FLUX_PRIOR = 1e-12
SQRT_2PI = math.sqrt(2.0 * math.pi)
T, A1, A2, A3, A4, A5 = float(ERF_T), *(float(a) for a in ERF_COEFFICIENTS)


@njit(cache=True, nogil=True)
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
    px, dx, py, dy = np.zeros(side), np.zeros(side), np.zeros(side), np.zeros(side)
    weight, miss = np.zeros((side, side)), np.zeros((side, side))
    normal, right, delta = np.zeros((4, 4)), np.zeros(4), np.zeros(4)
    for i in range(n):
        x = min(max(start_px[i, 0], -radius), radius)
        y = min(max(start_px[i, 1], -radius), radius)
        flux, level = 0.0, 0.0
        for step in range(rounds + 1):
            if step != 1:  # the first step leaves the position as it is
                _profile(px, dx, x, sigma_px, radius)
                _profile(py, dy, y, sigma_px, radius)
            shine = max(flux, 0.0)
            for r in range(side):
                for c in range(side):
                    shape = py[r] * px[c]
                    light = shine * shape
                    noise = variance[i, r, c] + light * (per_unit + model_error * model_error * light)
                    weight[r, c] = 1.0 / noise
                    miss[r, c] = data[i, r, c] - flux * shape - level
            if len(usable) > 0:
                for r in range(side):
                    for c in range(side):
                        if not usable[i, r, c]:
                            weight[r, c] = 0.0
            _normal_equations(weight, miss, flux, px, dx, py, dy, normal, right)
            if step == rounds:
                break
            if step == 0:  # flux and level first: without a flux the position has no gradient
                a, b, d = normal[2, 2], normal[2, 3], normal[3, 3]
                determinant = max(a * d - b * b, 1e-300)
                flux = (d * right[2] - b * right[3]) / determinant
                level = (a * right[3] - b * right[2]) / determinant
                continue
            _factorise(normal)
            _solve(normal, right, delta)
            x = min(max(x + min(max(delta[0], -MAX_STEP_PX), MAX_STEP_PX), -radius), radius)
            y = min(max(y + min(max(delta[1], -MAX_STEP_PX), MAX_STEP_PX), -radius), radius)
            flux += delta[2]
            level += delta[3]
        xy_px[i, 0], xy_px[i, 1] = x, y
        _factorise(normal)
        for k in range(4):
            for m in range(4):
                right[m] = 1.0 if m == k else 0.0
            _solve(normal, right, delta)
            for m in range(4):
                covariance[i, m, k] = delta[m]
        values[i, 0], values[i, 1] = flux, level
        _judge(data, variance, usable, i, weight, miss, px, py, flux, per_unit, surround, values)


@njit(cache=True, nogil=True)
def _profile(profile, slope, offset, sigma_px, radius) -> None:
    """The pixel-integrated Gaussian and its derivative with respect to the offset, as `psf.pixel_profile_single`."""
    last_area, last_density = 0.0, 0.0
    for j in range(2 * radius + 2):
        edge = (j - radius - 0.5 - offset) / sigma_px
        density = math.exp(-0.5 * edge * edge)
        t = 1.0 / (1.0 + T * abs(edge))
        area = 0.5 - density * t * (A1 + t * (A2 + t * (A3 + t * (A4 + t * A5))))
        area = area if edge >= 0.0 else -area
        density /= sigma_px * SQRT_2PI
        if j > 0:
            profile[j - 1], slope[j - 1] = area - last_area, last_density - density
        last_area, last_density = area, density


@njit(cache=True, nogil=True)
def _normal_equations(weight, miss, flux, px, dx, py, dy, normal, right) -> None:
    """Normal matrix (4, 4), symmetric, and right side (4,) for x, y, flux, level: sums over x, then over y."""
    side = len(px)
    xx = yy = xy = xf = yf = xl = yl = ff = fl = ll = bx = by = bf = bl = 0.0
    for r in range(side):
        w = wp = wd = wpp = wpd = wdd = m = mp = md = 0.0
        for c in range(side):
            v, p, d = weight[r, c], px[c], dx[c]
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
        p, d = py[r], dy[r]
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


@njit(cache=True, nogil=True)
def _factorise(matrix) -> None:
    """Cholesky factor of a positive definite matrix (4, 4) in place of its lower triangle, 1 / root on the diagonal."""
    for j in range(4):
        rest = matrix[j, j]
        for k in range(j):
            rest -= matrix[j, k] * matrix[j, k]
        matrix[j, j] = 1.0 / math.sqrt(max(rest, 1e-300))
        for i in range(j + 1, 4):
            rest = matrix[i, j]
            for k in range(j):
                rest -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = rest * matrix[j, j]


@njit(cache=True, nogil=True)
def _solve(factor, right, solution) -> None:
    """The solution (4,) for a right side (4,), by the factor of `_factorise`."""
    for i in range(4):
        rest = right[i]
        for k in range(i):
            rest -= factor[i, k] * solution[k]
        solution[i] = rest * factor[i, i]
    for m in range(4):
        i = 3 - m
        rest = solution[i]
        for k in range(i + 1, 4):
            rest -= factor[k, i] * solution[k]
        solution[i] = rest * factor[i, i]


@njit(cache=True, nogil=True)
def _judge(data, variance, usable, i, weight, miss, px, py, flux, per_unit, surround, values) -> None:
    """Fill values[i, 2:] for the fitted source: how well it fits, how well a single pixel does, and filter sums."""
    side = len(px)
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
            plain, shape = 1.0 / variance[i, r, c], py[r] * px[c]
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
