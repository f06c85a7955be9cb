"""An edge of the background in a star's stamp: ground darker or brighter than the sky, before a skyline is known."""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
import numpy as np

from startrack.core.kernels import njit, normal_cdf

FLAT_SLOPE_EXCESS = 3.0  # squared slopes that the noise explains, in its variance: 5 % of flat stamps have more
EDGE_FARTHEST_PX, EDGE_STEP_PX = 6.0, 0.5  # of its place from the star, for a PSF of 1 px; beyond, it has no part
EDGE_PLACES = int(2 * EDGE_FARTHEST_PX / EDGE_STEP_PX) + 1
WIDTH_PART = 0.3  # sigma of how much wider or sharper the edge is: in a real photograph stars had 0.58 px, a wall 0.95
COLUMNS = 4  # of the fit: the star, the edge, its place and its width
CONTRAST_SIGMAS = 10.0  # of an edge, in the noise of a pixel: a normal prior about none


@njit(inline="always")
def fit_beside_edge(profile, light, data, shape, weight, flux, level, strength, width_px):
    """Flux, and its variance beyond 1 / `strength`, of a star in a square stamp (n,).

    The edge is straight and as wide as the PSF, `width_px`; its direction is that of the stamp's slope, its place and
    its contrast are unknown: the means are over all places, by their likelihoods. A stamp whose slope the noise and
    neighbours that may not shine explain has none: its `flux` and `level` are those of a fit with
    the background's `shape`. The `data` are without the background, and without the `light` of neighbours.
    """
    side = int(np.sqrt(len(profile)))
    half = side // 2
    total, wx, wy, lx, ly, wxx, wyy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    mean_p, mean_q = 0.0, 0.0
    for k in range(len(profile)):
        dx, dy, w = k % side - half, k // side - half, weight[k]
        rest = w * (data[k] - flux * profile[k] - level)
        wx, wy, lx, ly = wx + dx * rest, wy + dy * rest, lx + w * dx * light[k], ly + w * dy * light[k]
        wxx, wyy, total = wxx + w * dx * dx, wyy + w * dy * dy, total + w
        mean_p, mean_q = mean_p + w * profile[k], mean_q + w * (data[k] + shape[k])
    wxx, wyy = max(wxx, 1e-30), max(wyy, 1e-30)
    explained = FLAT_SLOPE_EXCESS * (1.0 / wxx + 1.0 / wyy) + (lx / wxx) ** 2 + (ly / wyy) ** 2
    x, y = wx / wxx, wy / wyy
    found, beyond = np.float64(flux), 0.0
    if x * x + y * y > explained:
        mean_p, mean_q, steep = mean_p / total, mean_q / total, np.sqrt(x * x + y * y)
        x, y = x / steep, y / steep
        spread_px = np.sqrt(width_px * width_px + 1.0 / 12.0)
        best, sum_w, sum_f, sum_v = -np.inf, 0.0, 0.0, 0.0
        A, b = np.empty((COLUMNS, COLUMNS)), np.empty(COLUMNS)
        for m in range(EDGE_PLACES):
            at = width_px * (m * EDGE_STEP_PX - EDGE_FARTHEST_PX)
            _add_columns(A, b, profile, data, shape, weight, x, y, at, spread_px, mean_p, mean_q, total)
            log, f, v = _solve_edge(A, b, total / len(profile), width_px * EDGE_STEP_PX)
            if log > best:  # all weights are relative to that of the best place so far
                part = np.exp(best - log)
                sum_w, sum_f, sum_v, best = sum_w * part, sum_f * part, sum_v * part, log
            part = np.exp(log - best)
            sum_w, sum_f, sum_v = sum_w + part, sum_f + part * f, sum_v + part * (f * f + v)
        found = sum_f / sum_w
        beyond = max(sum_v / sum_w - found * found - 1.0 / strength, 0.0)
    return found, beyond


@njit(inline="always")
def _add_columns(A, b, profile, data, shape, weight, x, y, at, spread_px, mean_p, mean_q, total):
    """Fill A and b with the weighted products of the columns, and with the light: of the star, of an edge `at` a place,
    and of what changes where the edge is moved by a pixel, or wider by its own width; all about their means.
    """
    side = int(np.sqrt(len(profile)))
    half = side // 2
    A[:], b[:] = 0.0, 0.0
    we, wg, wh = 0.0, 0.0, 0.0
    for k in range(len(profile)):
        w, p, q = weight[k], profile[k] - mean_p, data[k] + shape[k] - mean_q
        z = (x * (k % side - half) + y * (k // side - half) - at) / spread_px
        e, slope = normal_cdf(z), np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi)
        g, h = slope / spread_px, z * slope
        we, wg, wh = we + w * e, wg + w * g, wh + w * h
        b[0], b[1], b[2], b[3] = b[0] + w * p * q, b[1] + w * e * q, b[2] + w * g * q, b[3] + w * h * q
        A[0, 0], A[1, 0], A[2, 0], A[3, 0] = (
            A[0, 0] + w * p * p,
            A[1, 0] + w * p * e,
            A[2, 0] + w * p * g,
            A[3, 0] + w * p * h,
        )
        A[1, 1], A[2, 1], A[3, 1] = A[1, 1] + w * e * e, A[2, 1] + w * e * g, A[3, 1] + w * e * h
        A[2, 2], A[3, 2], A[3, 3] = A[2, 2] + w * g * g, A[3, 2] + w * g * h, A[3, 3] + w * h * h
    A[1, 1], A[2, 1], A[3, 1] = A[1, 1] - we * we / total, A[2, 1] - we * wg / total, A[3, 1] - we * wh / total
    A[2, 2], A[3, 2], A[3, 3] = A[2, 2] - wg * wg / total, A[3, 2] - wg * wh / total, A[3, 3] - wh * wh / total


@njit(inline="always")
def _solve_edge(A, b, pixel_weight, step_px):
    """Logarithm of the likelihood of an edge's place, with the star's flux there and its variance.

    Columns A and b as `_add_columns` has them; A is overwritten. The edge is within half a `step_px` of its place.
    """
    A[1, 1] += pixel_weight / CONTRAST_SIGMAS**2
    det = A[0, 0] * A[1, 1] - A[1, 0] * A[1, 0]
    contrast2 = ((A[0, 0] * b[1] - A[1, 0] * b[0]) / det) ** 2 + A[0, 0] / det
    moved, wider = 12.0 / (contrast2 * step_px * step_px), 1.0 / (contrast2 * WIDTH_PART**2)
    A[2, 2], A[3, 3] = A[2, 2] + moved, A[3, 3] + wider
    log = 0.5 * (np.log(moved) + np.log(wider))
    for i in range(COLUMNS - 1, -1, -1):  # A = U D U^T from the last column: the flux is left for the end
        log += 0.5 * (b[i] * b[i] / A[i, i] - np.log(A[i, i]))
        for j in range(i):
            part = A[i, j] / A[i, i]
            b[j] -= part * b[i]
            for k in range(j + 1):
                A[j, k] -= part * A[i, k]
    return log, b[0] / A[0, 0], 1.0 / A[0, 0]
