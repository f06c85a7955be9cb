"""The compiled step of the branch and bound: bounds of the log-likelihood over boxes of positions.

Arrays are copied element by element: numba takes seconds to compile the assignment of a slice.

A box keeps the sums of the rows that are settled over it and a list of its open rows. A row is settled where its
contribution no longer varies over the box. Rows are compared with disks where the visible ground of each is a disk of
one radius (`Terrain.visible_disks`), else with bounds of the horizon that the terrain gave for each (box, row) pair.
"""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
from math import exp, inf, log, log1p, sqrt

import numpy as np

from startrack.kernels import njit
from startrack.localization.boxes import Boxes, split_boxes
from startrack.localization.score_kernel import smaller_sigma
from startrack.localization.sector_likelihood import log_mixture, row_range

LOG_POINT_M2 = log(100.0)  # area of a box from which it counts as large
SETTLED_NATS = 1e-9  # a row whose contribution varies by less over a box is settled there
DIGITS_NATS = 37.0  # what is smaller than this beside 1 has no digit in a float64
DOOM_EVERY = 32  # rows between two tests whether a box can still matter


@njit(cache=True, nogil=True)
def prune_nats_of_box(prune_nats, half):
    """By how much less likely than the best position a box of that half side [m] is dropped: more for a large box.

    A large box holds more probability at the same likelihood.
    """
    return prune_nats + max(0.0, log(4.0 * half * half) - LOG_POINT_M2)


@njit(cache=True, nogil=True)
def bound_boxes(rows, boxes, centres, half, parent, allowed, strength, weakest, strongest, low, high, sigma,
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
    prune_nats = prune_nats_of_box(prune_nats, half)
    dropped, enough = -inf, certain - negligible_nats - cell
    certain = -inf
    n, used, pair = 0, 0, 0
    for b in range(room):
        p = parent[b]
        x, y = centres[b, 0], centres[b, 1]
        count = boxes.first[p + 1] - boxes.first[p]
        if used + count > len(kept_row):
            kept_row = _enlarge_array(kept_row, used, 2 * (used + count))
            if not disks:
                kept_least = _enlarge_array(kept_least, used, 2 * (used + count))
                kept_most = _enlarge_array(kept_most, used, 2 * (used + count))
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
def refine_disks(
    rows, boxes, searched, best, certain, prune_nats, negligible_nats, boxes_per_sigma, finest, most_boxes
):
    """Quarter the boxes by the disks of the rows, at least once, until `boxes_per_sigma` fit into their spread.

    They are also small enough at the half side `finest` [m], or where four times as many exceed `most_boxes`, or where
    no row is open. Returns as `bound_boxes` does.
    """
    nothing, dropped = np.zeros(0), -inf
    while True:
        centres, parent = split_boxes(boxes.centres_m, boxes.half_m, searched)
        inside = (centres[:, 0] - searched[0]) ** 2 + (centres[:, 1] - searched[1]) ** 2 <= searched[2] ** 2
        allowed = inside & (centres[:, 0] ** 2 + centres[:, 1] ** 2 < rows.radius_m**2)
        boxes, best, certain, lost = bound_boxes(
            rows, boxes, centres, 0.5 * boxes.half_m, parent, allowed, nothing, 0.0, inf, nothing, nothing,
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
def _enlarge_array(a, used, size):
    larger = np.empty(size, dtype=a.dtype)
    for k in range(used):
        larger[k] = a[k]
    return larger


@njit(cache=True, nogil=True)
def _log_add(a, b):
    top, low = max(a, b), min(a, b)
    return top if low < top - DIGITS_NATS or low == -inf else top + log1p(exp(low - top))
