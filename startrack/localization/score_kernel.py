"""Compiled scores: log-likelihoods at the centres of boxes and at points, and the spread of scored boxes."""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
from math import exp, inf, log1p, sqrt

import numpy as np

from startrack.kernels import njit
from startrack.localization.sector_likelihood import log_mixture, row_contribution


@njit(cache=True, nogil=True)
def score_boxes(rows, boxes, horizon, sigma, score):
    """Fill score (n,) with log-likelihoods where the open rows of the boxes meet horizons (pairs,) of that sigma."""
    log_keep = log1p(-exp(rows.log_floor))
    sums = np.empty(len(rows.ceiling))
    for b in range(len(score)):
        for s in range(len(sums)):
            sums[s] = boxes.sums[b, s]
        for q in range(boxes.first[b], boxes.first[b + 1]):
            k = boxes.row[q]
            width = sqrt(rows.sigma_rad[k] ** 2 + sigma[q] ** 2)
            margin = rows.elevation_rad[k] - horizon[q]
            if width > 0.0:
                sums[rows.sector[k]] += row_contribution(rows.llr[k], rows.extended_nats[k], margin / width, 0)
            elif margin > 0.0:
                sums[rows.sector[k]] += rows.llr[k]
        total = 0.0
        for s in range(len(sums)):
            total += log_mixture(sums[s], log_keep, rows.log_floor)
        score[b] = total


@njit(cache=True, nogil=True)
def score_disks(disks, radius, llr, sector, settled, log_floor, points, found):
    """Fill found (n,) with the log-likelihoods of points (n, 2) inside or outside the disks (rows, 2) of the rows.

    settled (n or 1, sectors): sums of the other rows, at each point or everywhere.
    """
    r2, log_keep = radius * radius, log1p(-exp(log_floor))
    sums = np.empty(settled.shape[1])
    for p in range(len(found)):
        for s in range(len(sums)):
            sums[s] = settled[p % len(settled), s]
        for k in range(len(llr)):
            u, v = points[p, 0] - disks[k, 0], points[p, 1] - disks[k, 1]
            sums[sector[k]] += llr[k] * (u * u + v * v < r2)
        found[p] = 0.0
        for s in range(len(sums)):
            found[p] += log_mixture(sums[s], log_keep, log_floor)


@njit(cache=True, nogil=True)
def smaller_sigma(centres, score):
    """Standard deviation [m] along the shorter axis of the boxes weighted by exp(score); 0 for a single box."""
    top = -inf
    for b in range(len(score)):
        top = max(top, score[b])
    total, mean_x, mean_y, xx, yy, xy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    if top > -inf:
        for b in range(len(score)):
            w = exp(score[b] - top)
            total += w
            mean_x += w * centres[b, 0]
            mean_y += w * centres[b, 1]
        mean_x /= total
        mean_y /= total
        for b in range(len(score)):
            w = exp(score[b] - top) / total
            u, v = centres[b, 0] - mean_x, centres[b, 1] - mean_y
            xx += w * u * u
            yy += w * v * v
            xy += w * u * v
    return sqrt(max(0.5 * (xx + yy) - sqrt(0.25 * (xx - yy) ** 2 + xy * xy), 0.0))


@njit(cache=True, nogil=True)
def log_mixtures(sums, log_floor):
    """Log-likelihood of the sums of contributions, less the ceilings (sectors,)."""
    log_keep, total = log1p(-exp(log_floor)), 0.0
    for s in range(len(sums)):
        total += log_mixture(sums[s], log_keep, log_floor)
    return total
