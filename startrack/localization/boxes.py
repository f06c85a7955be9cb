"""The evidence and the boxes of positions as the compiled search reads them, and how boxes are quartered."""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
from math import inf
from typing import NamedTuple

import numpy as np

from startrack.kernels import njit
from startrack.localization.score_kernel import log_mixtures
from startrack.types import Array, Ints

NO_NUMBERS = np.zeros(0)
NO_DISKS = np.zeros((0, 2))


class Rows(NamedTuple):
    """The evidence as the kernels read it."""

    azimuth_rad: Array  # (n,)
    elevation_rad: Array
    llr: Array
    extended_nats: Array
    sigma_rad: Array  # of the edge, without the terrain's
    least: Array  # (n,) least contribution
    most: Array
    sector: Ints
    ceiling: Array  # (sectors,)
    log_floor: float
    disks_m: Array  # (n, 2) centres of the disks from which the rows are visible; (0, 2): not disks
    radius_m: float


class Boxes(NamedTuple):
    """Equal boxes of positions that may still matter, with the open rows of each."""

    centres_m: Array  # (n, 2)
    half_m: float
    first: Ints  # (n + 1,) where the open rows of each box begin
    row: Ints  # (pairs,)
    least: Array  # (pairs,) bounds of the rows' contributions; empty where rows are compared with disks
    most: Array
    sums: Array  # (n, sectors) contributions of the settled rows, less the sectors' ceilings
    settled: Array  # (n,) log-likelihood of these sums
    lower: Array  # (n,) bounds of the log-likelihood over the box
    upper: Array
    score: Array  # (n,) log-likelihood at the centre; -inf where no camera can be; valid only with disks


def root_box(rows: Rows, searched: tuple[float, float, float]) -> Boxes:
    """The box about the disk that is `searched` (east, north, radius [m]), with all rows open."""
    sums = -rows.ceiling[None]
    settled = log_mixtures(sums[0], rows.log_floor)
    n, open_pairs_too = len(rows.llr), not len(rows.disks_m)
    return Boxes(
        np.array([searched[:2]]), searched[2], np.array([0, n]), np.arange(n),
        rows.least if open_pairs_too else NO_NUMBERS,
        rows.most if open_pairs_too else NO_NUMBERS, sums, np.array([settled]), np.array([-inf]),
        np.array([settled + rows.most.sum()]), np.array([-inf]),
    )  # fmt: skip


@njit(cache=True, nogil=True)
def split_boxes(centres, half, searched):
    """Centres (m, 2) of the quarters that touch the disk that is searched, and the box (m,) of each."""
    quarter = 0.5 * half
    found = np.empty((4 * len(centres), 2))
    parent = np.empty(4 * len(centres), dtype=np.int64)
    n = 0
    for b in range(len(centres)):
        for k in range(4):
            x = centres[b, 0] + (quarter if k % 2 else -quarter)
            y = centres[b, 1] + (quarter if k // 2 else -quarter)
            beyond_x = max(abs(x - searched[0]) - quarter, 0.0)
            beyond_y = max(abs(y - searched[1]) - quarter, 0.0)
            found[n, 0], found[n, 1], parent[n] = x, y, b
            n += beyond_x * beyond_x + beyond_y * beyond_y <= searched[2] * searched[2]
    return found[:n], parent[:n]


@njit(cache=True, nogil=True)
def open_pairs(parent, first, row, strength, weakest, strongest):
    """Box (m,) and row (m,) of the open pairs with strengths from weakest to below strongest, box by box."""
    total = 0
    for b in range(len(parent)):
        for q in range(first[parent[b]], first[parent[b] + 1]):
            total += weakest <= strength[row[q]] < strongest
    box, rows = np.empty(total, dtype=np.int64), np.empty(total, dtype=np.int64)
    n = 0
    for b in range(len(parent)):
        for q in range(first[parent[b]], first[parent[b] + 1]):
            k = row[q]
            if weakest <= strength[k] < strongest:
                box[n], rows[n] = b, k
                n += 1
    return box, rows
