"""The skyline around the compass as a Markov chain: the map's, above it, below it, or nothing seen.

In each sector the skyline is the map's (state 0), stands above it by one of the levels of LEVELS_RAD (something on no
map), hides everything, or lies below it by one of the levels of NOTCH_LEVELS_RAD (a gap that the map has filled, a
crest that it has too high). Where the sky's light has an edge of its own over a part of the circle, all states below
the map's mean that instead: stars at the map's skyline, light at its own edge. An obstacle or a notch pays once to
begin and little to continue; its level stays, moves to a neighbour or, seldom, jumps. Besides, each sector may show a
skyline that is anywhere. The likelihood is the trace of the product of transitions and emissions around the circle.
"""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
from math import exp, log, sqrt
from typing import NamedTuple

import numpy as np

from startrack.core.kernels import REORDERED_SUMS, njit
from startrack.core.types import SECTORS, Array
from startrack.localization.profile_cells import Profiles, cell_at, integral_to, log_at

LEVELS_RAD = np.radians([0.04, 0.08, 0.14, 0.24, 0.4, 0.65, 1.0, 1.6, 2.5, 4.0, 6.5, 10.0, 16.0])  # edges
NOTCH_LEVELS_RAD = np.radians([0.04, 0.1, 0.25, 0.65, 1.6, 4.0, 8.0])  # edges, below the map's skyline
RISEN = len(LEVELS_RAD)  # states 1 to here: the levels, from low to high, and everything hidden
STATES = RISEN + len(NOTCH_LEVELS_RAD)  # behind them the levels of notches, from shallow to deep
FROM_RAD = np.concatenate([LEVELS_RAD[:-1], [np.inf], -NOTCH_LEVELS_RAD[1:]])  # (STATES - 1,) lower edges
TO_RAD = np.concatenate([LEVELS_RAD[1:], [np.inf], -NOTCH_LEVELS_RAD[:-1]])  # (STATES - 1,) upper edges
EDGES_RAD = np.concatenate([-NOTCH_LEVELS_RAD[::-1], LEVELS_RAD])
LOWER_EDGE, UPPER_EDGE = (np.searchsorted(EDGES_RAD, np.minimum(e, EDGES_RAD[-1])) for e in (FROM_RAD, TO_RAD))
START, NOTCH_START = 0.03 / SECTORS, 0.01 / SECTORS  # a sector: 0.03 obstacles and 0.01 notches around the circle
LIT_START = 1.0 / SECTORS  # of light with its own edge, where it has one: once around the circle
STOP, KEEP, NEAR = 0.05, 0.84, 0.14  # one of them ends; else its level stays, or goes to a neighbour
WRONG_SECTOR = 1e-3  # probability that the skyline of a sector is anywhere
NODES = 33  # of shifts, at which the emissions of the levels are prepared
BLOCK = 64  # points that are computed together


class Group(NamedTuple):
    """States that go over into each other, and their probabilities from one sector to the next."""

    first: int  # state
    last: int
    start: float  # from the map's skyline to each
    jump: float  # from each to each


class Moves(NamedTuple):
    """Probabilities of the chain from one sector to the next."""

    risen: Group
    sunk: Group
    stop: float
    keep: float
    near: float  # to each neighbour


def _group(first: int, last: int, start: float) -> Group:
    count = last - first + 1
    return Group(first, last, start / count, (1 - STOP) * (1 - KEEP - NEAR) / count)


def _moves(sunk_start: float) -> Moves:
    risen, sunk = _group(1, RISEN, START), _group(RISEN + 1, STATES - 1, sunk_start)
    return Moves(risen, sunk, STOP, (1 - STOP) * KEEP, 0.5 * (1 - STOP) * NEAR)


MOVES = _moves(NOTCH_START)
LIT_MOVES = _moves(LIT_START)  # where all states below the map's skyline are that of light with its own edge


class Levels(NamedTuple):
    """Emissions of all states but the first at shifts of the map's skyline, on nodes closer to each other about 0."""

    reach: Array  # (SECTORS,) largest shift
    table: Array  # (SECTORS, STATES - 1, NODES), float32
    stars: Profiles  # of the stars alone, where the light may have its own edge
    light: Array  # (SECTORS,) likelihood of light with its own edge; (0,): it has none


@njit(cache=True)
def prepare_levels(profiles, reach):
    """Emissions (SECTORS, STATES - 1, NODES) of the states but the first at shifts up to `reach` (SECTORS,).

    As `level_emission`; the cells are met in the order of the nodes.
    """
    table, to = np.zeros((len(reach), STATES - 1, NODES), dtype=np.float32), np.empty((len(EDGES_RAD), NODES))
    x, integral, free = profiles.x, profiles.integral, profiles.free
    for s in range(len(reach)):
        last, outside, scale = profiles.first[s + 1] - 1, exp(-free[s]), profiles.scale[s]
        for e in range(len(EDGES_RAD)):
            k = cell_at(x, profiles.guide, s, EDGES_RAD[e] - reach[s])
            for i in range(NODES):
                u = 2.0 * i / (NODES - 1) - 1.0
                at = EDGES_RAD[e] + reach[s] * u * abs(u)
                while k < last - 1 and x[k + 1] <= at:
                    k += 1
                inside = min(at, x[last])
                to[e, i] = integral[k] + (inside - x[k]) / (x[k + 1] - x[k]) * (integral[k + 1] - integral[k])
                to[e, i] += (at - inside) * outside
        for j in range(1, STATES):
            for i in range(NODES):
                mean = profiles.hidden[s]
                if j != RISEN:
                    mean = (to[UPPER_EDGE[j - 1], i] - to[LOWER_EDGE[j - 1], i]) / (TO_RAD[j - 1] - FROM_RAD[j - 1])
                    mean *= scale
                table[s, j - 1, i] = (1.0 - WRONG_SECTOR) * mean + WRONG_SECTOR * scale
    return table


@njit(cache=True, inner=True)
def level_emission(profiles, s, shift, j):
    """Likelihood of a sector in state j, above or below the map's skyline, which is higher by `shift`."""
    if j == RISEN:
        mean = profiles.hidden[s]
    else:
        low, high = FROM_RAD[j - 1], TO_RAD[j - 1]
        mean = (integral_to(profiles, s, shift + high) - integral_to(profiles, s, shift + low)) / (high - low)
        mean *= profiles.scale[s]
    return (1.0 - WRONG_SECTOR) * mean + WRONG_SECTOR * profiles.scale[s]


@njit(cache=True, inner=True)
def clear_emission(profiles, s, shift):
    """Likelihood of a sector whose skyline is the map's."""
    return profiles.scale[s] * ((1.0 - WRONG_SECTOR) * exp(log_at(profiles, s, shift)) + WRONG_SECTOR)


@njit(cache=True)
def clear_emissions(profiles, shifts):
    """`clear_emission` (SECTORS, n) at shifts (SECTORS, n)."""
    found = np.empty(shifts.shape)
    fill_clear_emissions(profiles, shifts, found)
    return found


@njit(cache=True)
def emissions(profiles, shift):
    """Likelihoods (SECTORS, STATES) at shifts (SECTORS,) of the map's skyline."""
    found = np.empty((len(shift), STATES))
    for s in range(len(shift)):
        found[s, 0] = clear_emission(profiles, s, shift[s])
        for j in range(1, STATES):
            found[s, j] = level_emission(profiles, s, shift[s], j)
    return found


@njit(cache=True, fastmath=REORDERED_SUMS)
def chain_log_likelihoods(profiles, levels, moves, shifts, cut, closing, found):
    """Fill found (n,) with the log-likelihoods at shifts (n, SECTORS) of the map's skyline.

    The circle is cut at the sector `cut` and closed over its states `closing`. Blocks of points go from sector to
    sector together, so that processors compute several points at a time. The states of each group are held with a zero
    on either side; in float32, which is right to 1e-5 nats.
    """
    count, sectors = shifts.shape
    starts = np.array([moves.risen.start, moves.sunk.start], dtype=np.float32)
    jumps = np.array([moves.risen.jump, moves.sunk.jump], dtype=np.float32)
    rows = np.array([[1, RISEN + 1], [RISEN + 2, STATES + 1]])  # of each group, its end excluded
    stop, keep, near = np.float32(moves.stop), np.float32(moves.keep), np.float32(moves.near)
    stay = np.float32(1.0 - moves.risen.start * RISEN - moves.sunk.start * (STATES - 1 - RISEN))
    off, moved = np.zeros((STATES + 2, BLOCK), dtype=np.float32), np.zeros((STATES + 2, BLOCK), dtype=np.float32)
    clear, total = np.empty(BLOCK, dtype=np.float32), np.empty(BLOCK, dtype=np.float32)
    ended, part = np.empty(BLOCK, dtype=np.float32), np.empty(BLOCK, dtype=np.float32)
    node = np.empty(BLOCK, dtype=np.int64)
    reach, table, is_lit = levels.reach, levels.table, len(levels.light) > 0
    logs, product, at_skyline = np.empty(BLOCK), np.empty(BLOCK), np.empty((sectors, BLOCK))
    lit = np.empty((sectors if is_lit else 0, BLOCK))
    for first in range(0, count, BLOCK):
        shift = shifts[first : first + BLOCK].T.copy()
        points = shift.shape[1]
        fill_clear_emissions(profiles, shift, at_skyline)
        if is_lit:
            fill_clear_emissions(levels.stars, shift, lit)
        found[first : first + BLOCK] = -np.inf
        for k in closing:
            clear[:], logs[:], product[:] = 0.0, 0.0, 1.0
            off[:], moved[:] = 0.0, 0.0
            at_end = k if k <= RISEN else k + 1  # row of the state
            for step in range(sectors + 1):
                s = cut + step if cut + step < sectors else cut + step - sectors
                if step > 0:
                    ended[:] = 0.0
                    for g in range(2):
                        start, jump, begin, end = starts[g], jumps[g], rows[g, 0], rows[g, 1]
                        total[:] = 0.0
                        for r in range(begin, end):
                            for p in range(points):
                                total[p] += off[r, p]
                        for r in range(begin, end):
                            for p in range(points):
                                common = start * clear[p] + jump * total[p]
                                moved[r, p] = common + keep * off[r, p] + near * (off[r - 1, p] + off[r + 1, p])
                        for p in range(points):  # the outermost levels go to their only neighbour twice as often
                            moved[begin + 1, p] += near * off[begin, p]
                            moved[end - 2, p] += near * off[end - 1, p]
                            ended[p] += stop * total[p]
                    for p in range(points):
                        clear[p] = stay * clear[p] + ended[p]
                if step == sectors:
                    break
                for p in range(points):
                    d = shift[s, p]
                    u = sqrt(min(abs(d) / reach[s], 0.999))
                    at = ((u if d > 0.0 else -u) + 1.0) * 0.5 * (NODES - 1)
                    node[p] = int(at)
                    part[p] = at - node[p]
                if step == 0:
                    clear[:] = 1.0 if k == 0 else 0.0
                    moved[at_end] = 1.0 if k > 0 else 0.0
                for g in range(2):
                    for r in range(rows[g, 0], rows[g, 1]):
                        emission = table[s, r - 1 - g]
                        for p in range(points):
                            low = emission[node[p]]
                            off[r, p] = moved[r, p] * (low + part[p] * (emission[node[p] + 1] - low))
                if is_lit:
                    for r in range(rows[1, 0], rows[1, 1]):
                        for p in range(points):
                            off[r, p] = moved[r, p] * np.float32(levels.light[s] * lit[s, p])
                for p in range(points):
                    clear[p] *= at_skyline[s, p]
                if step % 4 == 3:
                    for p in range(points):  # numba takes 1.5 s to compile total[:] = clear
                        total[p] = clear[p]
                    for r in range(1, STATES + 1):
                        for p in range(points):
                            total[p] += off[r, p]
                    for p in range(points):
                        product[p] *= total[p]
                        clear[p] /= total[p]
                    for r in range(1, STATES + 1):
                        for p in range(points):
                            off[r, p] /= total[p]
                if step % 32 == 31:
                    for p in range(points):
                        logs[p] += log(product[p])
                        product[p] = 1.0
            last = clear if k == 0 else moved[at_end]
            for p in range(points):
                value = logs[p] + log(product[p]) + log(max(last[p], np.float32(1e-37)))
                top = max(value, found[first + p])
                found[first + p] = top + log(exp(value - top) + exp(found[first + p] - top))


@njit(cache=True, inner=True)
def fill_clear_emissions(profiles, shifts, found):
    """Fill found (SECTORS, n) with `clear_emission` at shifts (SECTORS, n).

    The arrays are taken out of the tuple once: numba counts references at each access, which took two thirds of the
    time.
    """
    _, x, left, right, bend, _, free, guide, scale, _, _ = profiles
    for s in range(len(shifts)):
        for p in range(shifts.shape[1]):
            at = shifts[s, p]
            k = cell_at(x, guide, s, at)
            value, rise = left[k], right[k] - left[k]
            if rise != 0.0 or bend[k] != 0.0:
                u = min(max((at - x[k]) / (x[k + 1] - x[k]), 0.0), 1.0)
                value += u * rise + u * (1.0 - u) * bend[k]
            found[s, p] = scale[s] * ((1.0 - WRONG_SECTOR) * exp(value - free[s]) + WRONG_SECTOR)
