"""An edge of the background in a star's stamp: ground darker or brighter than the sky, before a skyline is known."""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
import numpy as np

from startrack.core.kernels import njit, normal_cdf

FLAT_SLOPE_EXCESS = 3.0  # squared slopes that the noise explains, in its variance: 5 % of flat stamps have more
EDGE_FARTHEST_PX, EDGE_STEP_PX = 6.0, 0.5  # of its place from the star, for a PSF of 1 px; beyond, it has no part
EDGE_PLACES = int(2 * EDGE_FARTHEST_PX / EDGE_STEP_PX) + 1
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
        for m in range(EDGE_PLACES):
            at = width_px * (m * EDGE_STEP_PX - EDGE_FARTHEST_PX)
            we, wee, wpe, wqe, wpp, wpq = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for k in range(len(profile)):
                e = normal_cdf((x * (k % side - half) + y * (k // side - half) - at) / spread_px)
                p, q = profile[k] - mean_p, data[k] + shape[k] - mean_q
                we, wee, wpe = we + weight[k] * e, wee + weight[k] * e * e, wpe + weight[k] * p * e
                wqe, wpp, wpq = wqe + weight[k] * q * e, wpp + weight[k] * p * p, wpq + weight[k] * p * q
            wee += total / len(profile) / CONTRAST_SIGMAS**2 - we * we / total
            det = wpp * wee - wpe * wpe
            f, contrast = (wee * wpq - wpe * wqe) / det, (wpp * wqe - wpe * wpq) / det
            log = 0.5 * (f * wpq + contrast * wqe - np.log(det))
            if log > best:  # all weights are relative to that of the best place so far
                part = np.exp(best - log)
                sum_w, sum_f, sum_v, best = sum_w * part, sum_f * part, sum_v * part, log
            part = np.exp(log - best)
            sum_w, sum_f, sum_v = sum_w + part, sum_f + part * f, sum_v + part * (f * f + wee / det)
        found = sum_f / sum_w
        beyond = max(sum_v / sum_w - found * found - 1.0 / strength, 0.0)
    return found, beyond
