"""The compiled step of the branch and bound: bounds of the log-likelihood over boxes of positions.

Arrays are copied element by element: numba takes seconds to compile the assignment of a slice.

A box keeps the sums of the rows that are settled over it and a list of its open rows. A row is settled where its
contribution no longer varies over the box. Rows are compared with disks where the visible ground of each is a disk of
one radius (`Terrain.visible_disks`), else with bounds of the horizon that the terrain gave for each (box, row) pair.
"""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
from math import exp, inf, log, log1p, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

from startrack.localization.score_kernel import log_mixtures, smaller_sigma
from startrack.localization.sector_likelihood import log_mixture, row_range
from startrack.types import Array, Ints

LOG_POINT_M2 = log(100.0)  # boxes of larger area hold more probability: they are dropped at that lower likelihoods
SETTLED_NATS = 1e-9  # a row whose contribution varies by less over a box is settled there
DIGITS_NATS = 37.0  # what is smaller than this beside 1 has no digit in a float64
CLIMB_BELOW = 12.0  # of the radius: half side of the boxes in the best of which the search climbs
LAST_CLIMB_STEP = 1.0 / 64.0  # of the half side
DOOM_EVERY = 32  # rows between two tests whether a box can still matter
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


@njit(cache=True, nogil=True)
def split_boxes(centres, half, reach):
    """Centres (m, 2) of the quarters that come within reach of the origin, and the box (m,) of each."""
    quarter = 0.5 * half
    found = np.empty((4 * len(centres), 2))
    parent = np.empty(4 * len(centres), dtype=np.int64)
    n = 0
    for b in range(len(centres)):
        for k in range(4):
            x = centres[b, 0] + (quarter if k % 2 else -quarter)
            y = centres[b, 1] + (quarter if k // 2 else -quarter)
            beyond_x, beyond_y = max(abs(x) - quarter, 0.0), max(abs(y) - quarter, 0.0)
            found[n, 0], found[n, 1], parent[n] = x, y, b
            n += beyond_x * beyond_x + beyond_y * beyond_y <= reach * reach
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


@njit(cache=True, nogil=True)
def bound_boxes(rows, reach, boxes, centres, half, parent, allowed, strength, weakest, strongest, low, high, sigma,
                best, certain, prune_nats, negligible_nats):  # fmt: skip
    """Bounds over boxes (n, 2) whose open rows are those of their parents in `boxes`; drop what cannot matter.

    The rows are in the order of their sectors. Rows of a strength from `weakest` to below `strongest` are compared with
    their disks, or with the horizon's bounds low, high (pairs,) and its sigma (pairs,), in the order of `open_pairs`.
    `best` is the best log-likelihood known, `certain` the logarithm of the mass [m2] that the boxes hold at least.
    Returns the boxes kept, both of these anew, and the logarithm of a bound of the mass dropped.
    """
    sectors = len(rows.ceiling)
    disks = len(rows.disks_m) > 0
    log_floor = rows.log_floor
    log_keep = log1p(-exp(log_floor))
    additive = disks and log_floor == -inf  # losses simply add up: most boxes are hopeless after a few dozen rows
    r2 = rows.radius_m * rows.radius_m
    inner, outer = rows.radius_m - half * sqrt(2.0), rows.radius_m + half * sqrt(2.0)
    inner2 = inner * inner if inner > 0.0 else -1.0
    outer2 = outer * outer
    room = len(centres)
    kept_centres, kept_sums = np.empty((room, 2)), np.empty((room, sectors))
    settled, lower, upper, score = np.empty(room), np.empty(room), np.empty(room), np.empty(room)
    kept_first = np.zeros(room + 1, dtype=np.int64)
    space = max(1024, len(boxes.row) + len(boxes.row) // 2)
    kept_row = np.empty(space, dtype=boxes.row.dtype)
    kept_least, kept_most = np.empty(0 if disks else space), np.empty(0 if disks else space)
    cell = log(4.0 * half * half)
    prune_nats += max(0.0, cell - LOG_POINT_M2)
    dropped, enough = -inf, certain - negligible_nats - cell
    certain = -inf
    n, used, pair = 0, 0, 0
    for b in range(room):
        p = parent[b]
        x, y = centres[b, 0], centres[b, 1]
        count = boxes.first[p + 1] - boxes.first[p]
        if used + count > len(kept_row):
            kept_row = _grown(kept_row, used, 2 * (used + count))
            if not disks:
                kept_least = _grown(kept_least, used, 2 * (used + count))
                kept_most = _grown(kept_most, used, 2 * (used + count))
        for s in range(sectors):
            kept_sums[n, s] = boxes.sums[p, s]
        start, hopeless = used, False
        limit = max(best - prune_nats, enough)
        now, low_total, high_total, centre_total = (
            boxes.settled[p],
            boxes.settled[p],
            boxes.settled[p],
            boxes.settled[p],
        )
        highest = boxes.upper[p]  # bound of the log-likelihood by what is known of the rows so far
        q, end = boxes.first[p], boxes.first[p + 1]
        while q < end and not hopeless:
            s = rows.sector[boxes.row[q]]
            sure, least, most, at_centre, most_of_parent, lost = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            while q < end and rows.sector[boxes.row[q]] == s:
                k = boxes.row[q]
                llr = rows.llr[k]
                if disks:
                    u, v = x - rows.disks_m[k, 0], y - rows.disks_m[k, 1]
                    d2 = u * u + v * v
                    # No processor predicts which case holds: multiplying by 0 or 1 takes half the time of branches.
                    inside = d2 < inner2
                    open_ = (d2 >= inner2) & (d2 <= outer2)
                    gain, positive = llr * open_, max(llr, 0.0)
                    sure += llr * inside
                    most += gain * (gain > 0.0)
                    least += gain * (gain < 0.0)
                    at_centre += gain * (d2 < r2)
                    most_of_parent += positive
                    lost += (llr - positive) * inside - positive * (d2 > outer2)
                    kept_row[used] = k
                    used += open_
                    if additive and q % DOOM_EVERY == 0 and highest + lost <= limit:
                        hopeless = True
                        break
                else:
                    under, over = boxes.least[q], boxes.most[q]
                    if weakest <= strength[k] < strongest:
                        e, width = rows.elevation_rad[k], sqrt(rows.sigma_rad[k] ** 2 + sigma[pair] ** 2)
                        if width > 0.0:
                            above, below = (e - high[pair]) / width, (e - low[pair]) / width
                            under, over = row_range(llr, rows.extended_nats[k], above, below)
                        elif e > high[pair]:
                            under, over = llr, llr
                        elif e <= low[pair]:
                            under, over = 0.0, 0.0
                        pair += 1
                    if over - under < SETTLED_NATS:
                        sure += 0.5 * (under + over)
                    else:
                        least += under
                        most += over
                        kept_row[used], kept_least[used], kept_most[used] = k, under, over
                        used += 1
                q += 1
            before, total = boxes.sums[p, s], boxes.sums[p, s] + sure
            kept_sums[n, s] = total
            known = log_mixture(before, log_keep, log_floor)
            now += log_mixture(total, log_keep, log_floor) - known
            low_total += log_mixture(total + least, log_keep, log_floor) - known
            high_sector = log_mixture(total + most, log_keep, log_floor)
            high_total += high_sector - known
            if disks:
                centre_total += log_mixture(total + at_centre, log_keep, log_floor) - known
                if additive:
                    highest += lost
                else:
                    highest += high_sector - log_mixture(before + most_of_parent, log_keep, log_floor)
                hopeless = hopeless or highest <= limit
        if hopeless:
            dropped = _log_add(dropped, max(highest, limit) + cell)
            used = start
            continue
        if not allowed[b]:
            low_total, centre_total = -inf, -inf
        best = max(best, low_total)
        if disks:
            best = max(best, centre_total)
        if high_total <= max(best - prune_nats, enough):
            dropped = _log_add(dropped, high_total + cell)
            used = start
            continue
        kept_centres[n, 0], kept_centres[n, 1] = x, y
        settled[n], lower[n], upper[n], score[n] = now, low_total, high_total, centre_total
        certain = _log_add(certain, low_total + cell)
        kept_first[n + 1] = used
        n += 1
    if disks and n > 0 and half * CLIMB_BELOW < rows.radius_m:
        top = np.argmax(score[:n])
        if score[top] > -inf:
            first, last = kept_first[top], kept_first[top + 1]
            climbed = _climb_in_box(
                rows, kept_sums[top], kept_row[first:last], kept_centres[top], half, score[top], reach
            )
            best = max(best, climbed)
    # Boxes that were kept before a better position was known may no longer matter.
    enough = certain - negligible_nats - cell
    write, write_pair, begin = 0, 0, 0
    for b in range(n):
        end = kept_first[b + 1]
        if upper[b] <= max(best - prune_nats, enough):
            dropped = _log_add(dropped, upper[b] + cell)
        else:
            if write != b:
                for q in range(begin, end):
                    kept_row[write_pair + q - begin] = kept_row[q]
                    if not disks:
                        kept_least[write_pair + q - begin] = kept_least[q]
                        kept_most[write_pair + q - begin] = kept_most[q]
                kept_centres[write, 0], kept_centres[write, 1] = kept_centres[b, 0], kept_centres[b, 1]
                for s in range(sectors):
                    kept_sums[write, s] = kept_sums[b, s]
                settled[write], lower[write], upper[write], score[write] = settled[b], lower[b], upper[b], score[b]
            write_pair += end - begin
            write += 1
            kept_first[write] = write_pair  # write <= b + 1, whose own offset is already in `end`
        begin = end
    pairs = 0 if disks else write_pair
    kept = Boxes(
        kept_centres[:write], half, kept_first[: write + 1], kept_row[:write_pair], kept_least[:pairs],
        kept_most[:pairs], kept_sums[:write], settled[:write], lower[:write], upper[:write], score[:write],
    )  # fmt: skip
    return kept, best, certain, dropped


@njit(cache=True, nogil=True)
def refine_disks(rows, boxes, reach, best, certain, prune_nats, negligible_nats, boxes_per_sigma, finest, most_boxes):
    """Quarter the boxes by the disks of the rows, at least once, until `boxes_per_sigma` fit into their spread.

    They are also small enough at the half side `finest` [m], or where four times as many exceed `most_boxes`, or where
    no row is open. Returns as `bound_boxes` does.
    """
    nothing, dropped = np.zeros(0), -inf
    while True:
        centres, parent = split_boxes(boxes.centres_m, boxes.half_m, reach)
        away2 = centres[:, 0] ** 2 + centres[:, 1] ** 2
        allowed = (away2 < rows.radius_m**2) & (away2 <= reach * reach)
        boxes, best, certain, lost = bound_boxes(
            rows, reach, boxes, centres, 0.5 * boxes.half_m, parent, allowed, nothing, 0.0, inf, nothing, nothing,
            nothing, best, certain, prune_nats, negligible_nats,
        )  # fmt: skip
        dropped = _log_add(dropped, lost)
        n = len(boxes.centres_m)
        if boxes.half_m <= finest or 4 * n > most_boxes or len(boxes.row) == 0:
            break
        if 2.0 * boxes.half_m * boxes_per_sigma < smaller_sigma(boxes.centres_m, boxes.score):
            break
    return boxes, best, certain, dropped


@njit(cache=True, nogil=True)
def _climb_in_box(rows, sums, row, centre, half, best, reach):
    """Best log-likelihood on a climb from the centre of a box that stays in it: only the open rows change there."""
    r2, log_keep = rows.radius_m * rows.radius_m, log1p(-exp(rows.log_floor))
    limit2 = min(r2, reach * reach)
    now = np.empty(len(sums))
    x, y, step = centre[0], centre[1], 0.5 * half
    while step > half * LAST_CLIMB_STEP:
        to_x, to_y = x, y
        for k in range(9):
            u, v = x + step * (k // 3 - 1), y + step * (k % 3 - 1)
            if k == 4 or abs(u - centre[0]) > half or abs(v - centre[1]) > half or u * u + v * v >= limit2:
                continue
            for s in range(len(sums)):
                now[s] = sums[s]
            for q in range(len(row)):
                a, b = u - rows.disks_m[row[q], 0], v - rows.disks_m[row[q], 1]
                now[rows.sector[row[q]]] += rows.llr[row[q]] * (a * a + b * b < r2)
            total = 0.0
            for s in range(len(now)):
                total += log_mixture(now[s], log_keep, rows.log_floor)
            if total > best:
                best, to_x, to_y = total, u, v
        if to_x == x and to_y == y:
            step *= 0.5
        x, y = to_x, to_y
    return best


@njit(cache=True, nogil=True)
def _grown(a, used, size):
    larger = np.empty(size, dtype=a.dtype)
    for k in range(used):
        larger[k] = a[k]
    return larger


@njit(cache=True, nogil=True)
def _log_add(a, b):
    top, low = max(a, b), min(a, b)
    return top if low < top - DIGITS_NATS or low == -inf else top + log1p(exp(low - top))


def root_box(rows: Rows, half_m: float) -> Boxes:
    """One box about the origin with all rows open."""
    sums = -rows.ceiling[None]
    settled = log_mixtures(sums[0], rows.log_floor)
    n, open_pairs_too = len(rows.llr), not len(rows.disks_m)
    return Boxes(
        np.zeros((1, 2)), half_m, np.array([0, n]), np.arange(n), rows.least if open_pairs_too else NO_NUMBERS,
        rows.most if open_pairs_too else NO_NUMBERS, sums, np.array([settled]), np.array([-inf]),
        np.array([settled + rows.most.sum()]), np.array([-inf]),
    )  # fmt: skip
