"""An edge of the background in a star's stamp: ground darker or brighter than the sky, before a skyline is known."""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
import numpy as np
from scipy.special import ndtr

from startrack.core.kernels import REORDERED_SUMS, njit
from startrack.core.types import Array

FLAT_SLOPE_EXCESS = 3.0  # squared slopes that the noise explains, in its variance: 5 % of flat stamps have more
EDGE_FARTHEST_PX, EDGE_STEP_PX = 6.0, 0.5  # of its place from the star, for a PSF of 1 px; beyond, it has no part
EDGE_PLACES = int(2 * EDGE_FARTHEST_PX / EDGE_STEP_PX) + 1
WIDTH_PART = 0.3  # sigma of how much wider or sharper the edge is: in a real photograph stars had 0.58 px, a wall 0.95
COLUMNS = 4  # of the fit: the star, the edge, its place and its width
PHASES = 64  # of a pixel between two places of the edge, in the table of its light: interpolated to 2e-6 of a contrast
SUMS = 15  # weighted products at each place
CONTRAST_SIGMAS = 10.0  # of an edge, in the noise of a pixel: a normal prior about none


def edge_profiles(radius: int, width_px: float) -> Array:
    """Light of an edge of `width_px`, and its slope [1/px], (2, PHASES + 1, n) single, for stamps of a `radius` [px].

    Rows are phases of a pixel between two places of the edge; the column is the number of places from the edge to the
    pixel, from the farthest before it to the farthest behind it.
    """
    spread_px, step_px = _spread_px.py_func(width_px), width_px * EDGE_STEP_PX
    farthest = _farthest_place.py_func(radius, width_px) + EDGE_PLACES // 2
    places = np.arange(-farthest, farthest + 1.0) + np.linspace(0.0, 1.0, PHASES + 1)[:, None]
    z = places * step_px / spread_px
    slope = np.exp(-0.5 * z * z) / (np.sqrt(2.0 * np.pi) * spread_px)
    return np.stack([ndtr(z), slope]).astype(np.float32)


@njit(inline="always")
def _spread_px(width_px):  # of an edge that pixels of a side of 1 have sampled
    return np.sqrt(width_px * width_px + 1.0 / 12.0)


@njit(inline="always")
def _farthest_place(radius, width_px):
    """Number of places of the edge, rounded up, between the corner and the middle of a stamp."""
    return int(np.ceil(radius * np.sqrt(2.0) / (width_px * EDGE_STEP_PX))) + 1


@njit(inline="always")
def fit_beside_edge(profile, light, data, shape, weight, flux, level, strength, width_px, edges):
    """Flux, and its variance beyond 1 / `strength`, of a star in a square stamp (n,).

    The edge is straight and as wide as the PSF, `width_px`; its direction is that of the stamp's slope, its place and
    its contrast are unknown: the means are over all places, by their likelihoods. A stamp whose slope the noise and
    neighbours that may not shine explain has none: its `flux` and `level` are those of a fit with
    the background's `shape`. The `data` are without the background, and without the `light` of neighbours; `edges` are
    the `edge_profiles` of the stamp.
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
        steep = np.sqrt(x * x + y * y)
        found, variance = fit_at_places(
            profile, data, shape, weight, x / steep, y / steep, mean_p / total, mean_q / total, total, width_px, edges
        )
        beyond = max(variance - 1.0 / strength, 0.0)
    return found, beyond


@njit(cache=True, inner=True, fastmath=REORDERED_SUMS)
def fit_at_places(profile, data, shape, weight, x, y, mean_p, mean_q, total, width_px, edges):
    """Mean flux of a star, and its variance, over the places of an edge that faces (x, y), by their likelihoods.

    `mean_p` and `mean_q` are the weighted means of the `profile` and of the light, data + `shape`; `total` is the sum
    of the weights.
    """
    sums = np.zeros((SUMS, EDGE_PLACES))
    star = _sum_at_places(sums, profile, data, shape, weight, x, y, mean_p, mean_q, width_px, edges)
    best, sum_w, sum_f, sum_v = -np.inf, 0.0, 0.0, 0.0
    A, b = np.empty((COLUMNS, COLUMNS)), np.empty(COLUMNS)
    for m in range(EDGE_PLACES):
        we, wg, wh = sums[0, m], sums[1, m], sums[2, m]
        A[0, 0], A[1, 0], A[2, 0], A[3, 0] = star[0], sums[3, m], sums[4, m], sums[5, m]
        A[1, 1], A[2, 1], A[3, 1] = (
            sums[6, m] - we * we / total, sums[7, m] - we * wg / total, sums[8, m] - we * wh / total,
        )  # fmt: skip
        A[2, 2], A[3, 2], A[3, 3] = (
            sums[9, m] - wg * wg / total, sums[10, m] - wg * wh / total, sums[11, m] - wh * wh / total,
        )  # fmt: skip
        b[0], b[1], b[2], b[3] = star[1], sums[12, m], sums[13, m], sums[14, m]
        log, f, v = _solve_edge(A, b, total / len(profile), width_px * EDGE_STEP_PX)
        if log > best:  # all weights are relative to that of the best place so far
            part = np.exp(best - log)
            sum_w, sum_f, sum_v, best = sum_w * part, sum_f * part, sum_v * part, log
        part = np.exp(log - best)
        sum_w, sum_f, sum_v = sum_w + part, sum_f + part * f, sum_v + part * (f * f + v)
    found = sum_f / sum_w
    return found, sum_v / sum_w - found * found


@njit(inline="always")
def _sum_at_places(sums, profile, data, shape, weight, x, y, mean_p, mean_q, width_px, edges):
    """Fill `sums` (SUMS, places) of weighted products; returns those of the star with itself and with the light.

    The columns are the star p, an edge e at each place, what changes where the edge is moved by a pixel, g, or wider
    by its own width, h; q is the light. The rows of `sums` are e, g, h; pe, pg, ph; ee, eg, eh; gg, gh; hh; eq, gq, hq.
    """
    side = int(np.sqrt(len(profile)))
    half = side // 2
    step_px = width_px * EDGE_STEP_PX
    nearest = _farthest_place(half, width_px)
    pp, pq = 0.0, 0.0
    for k in range(len(profile)):
        w, p, q = np.float64(weight[k]), profile[k] - mean_p, data[k] + shape[k] - mean_q
        pp, pq = pp + w * p * p, pq + w * p * q
        wp, wq = w * p, w * q
        across = (x * (k % side - half) + y * (k // side - half)) / step_px
        first = int(np.floor(across))
        phase = (across - first) * PHASES
        low = min(int(phase), PHASES - 1)
        part = np.float32(phase - low)
        begin = np.uint64(nearest + first)
        behind_px = (across - EDGE_PLACES // 2) * step_px
        for m in range(np.uint64(EDGE_PLACES)):
            j = begin + m
            e = np.float64(edges[0, low, j] + part * (edges[0, low + 1, j] - edges[0, low, j]))
            g = np.float64(edges[1, low, j] + part * (edges[1, low + 1, j] - edges[1, low, j]))
            h = (behind_px + step_px * m) * g
            we, wg, wh = w * e, w * g, w * h
            sums[0, m] += we
            sums[1, m] += wg
            sums[2, m] += wh
            sums[3, m] += wp * e
            sums[4, m] += wp * g
            sums[5, m] += wp * h
            sums[6, m] += we * e
            sums[7, m] += we * g
            sums[8, m] += we * h
            sums[9, m] += wg * g
            sums[10, m] += wg * h
            sums[11, m] += wh * h
            sums[12, m] += wq * e
            sums[13, m] += wq * g
            sums[14, m] += wq * h
    return pp, pq


@njit(inline="always")
def _solve_edge(A, b, pixel_weight, step_px):
    """Logarithm of the likelihood of an edge's place, with the star's flux there and its variance.

    A and b are the products of the columns with each other and with the light; A is overwritten. The edge is within
    half a `step_px` of its place.
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
