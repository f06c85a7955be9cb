"""The skyline around the compass as a Markov chain: the map's, or risen by something on no map, or nothing seen.

In each sector the skyline is the map's (state 0), stands above it by one of the levels of LEVELS_RAD, or hides
everything (the last state). An obstacle pays once to begin and little to continue; its level stays, moves to a
neighbour or, seldom, jumps. Besides, each sector may show a skyline that is anywhere. The likelihood is the trace of
the product of transitions and emissions around the circle.
"""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
from math import exp, log, sqrt
from typing import NamedTuple

import numpy as np

from startrack.core.kernels import REORDERED_SUMS, njit
from startrack.core.types import SECTORS, Array, Ints
from startrack.localization.skyline_profiles import Profiles, cell_at, integral_to, log_at

LEVELS_RAD = np.radians([0.04, 0.08, 0.14, 0.24, 0.4, 0.65, 1.0, 1.6, 2.5, 4.0, 6.5, 10.0, 16.0])  # edges
STATES = len(LEVELS_RAD) + 1  # the map's skyline, the levels between the edges, and everything hidden
START = 0.03 / SECTORS  # of an obstacle, a sector: 0.03 obstacles around the circle
STOP, KEEP, NEAR = 0.05, 0.84, 0.14  # an obstacle ends; else its level stays, or goes to a neighbour
WRONG_SECTOR = 1e-3  # probability that the skyline of a sector is anywhere
NODES = 33  # of shifts, at which the emissions of the levels are prepared
BLOCK = 64  # points that are computed together
CLEAR = 1e-3  # least probability of a state over which the circle is closed


class Moves(NamedTuple):
    """Probabilities of the chain from one sector to the next."""

    start: float  # to each risen state
    stop: float
    jump: float  # from each risen state to each
    keep: float
    near: float  # to each neighbour


MOVES = Moves(
    START / (STATES - 1), STOP, (1 - STOP) * (1 - KEEP - NEAR) / (STATES - 1), (1 - STOP) * KEEP,
    0.5 * (1 - STOP) * NEAR,
)  # fmt: skip


class Levels(NamedTuple):
    """Emissions of the risen states at shifts of the map's skyline, prepared on nodes closer to each other about 0."""

    reach: Array  # (SECTORS,) largest shift
    table: Array  # (SECTORS, STATES - 1, NODES), float32


@njit(cache=True)
def prepare_levels(profiles, reach):
    """Emissions (SECTORS, STATES - 1, NODES) of the risen states at shifts up to `reach` (SECTORS,)."""
    table, to = np.zeros((len(reach), STATES - 1, NODES), dtype=np.float32), np.empty(len(LEVELS_RAD))
    for s in range(len(reach)):
        for i in range(NODES):
            u = 2.0 * i / (NODES - 1) - 1.0
            shift = reach[s] * u * abs(u)
            for j in range(len(to)):
                to[j] = integral_to(profiles, s, shift + LEVELS_RAD[j])
            for j in range(STATES - 2):
                mean = (to[j + 1] - to[j]) / (LEVELS_RAD[j + 1] - LEVELS_RAD[j])
                table[s, j, i] = (1.0 - WRONG_SECTOR) * mean + WRONG_SECTOR
            table[s, STATES - 2, i] = (1.0 - WRONG_SECTOR) * exp(-profiles.free[s]) + WRONG_SECTOR
    return table


@njit(cache=True, inner=True)
def risen_emission(profiles, s, shift, j):
    """Likelihood of a sector whose skyline stands in level j above the map's, which is higher by `shift`."""
    if j == STATES - 1:
        return (1.0 - WRONG_SECTOR) * exp(-profiles.free[s]) + WRONG_SECTOR
    low, high = LEVELS_RAD[j - 1], LEVELS_RAD[j]
    mean = (integral_to(profiles, s, shift + high) - integral_to(profiles, s, shift + low)) / (high - low)
    return (1.0 - WRONG_SECTOR) * mean + WRONG_SECTOR


@njit(cache=True, inner=True)
def clear_emission(profiles, s, shift):
    """Likelihood of a sector whose skyline is the map's."""
    return (1.0 - WRONG_SECTOR) * exp(log_at(profiles, s, shift)) + WRONG_SECTOR


@njit(cache=True)
def emissions(profiles, shift):
    """Likelihoods (SECTORS, STATES) at shifts (SECTORS,) of the map's skyline."""
    found = np.empty((len(shift), STATES))
    for s in range(len(shift)):
        found[s, 0] = clear_emission(profiles, s, shift[s])
        for j in range(1, STATES):
            found[s, j] = risen_emission(profiles, s, shift[s], j)
    return found


@njit(cache=True, fastmath=REORDERED_SUMS)
def chain_log_likelihoods(profiles, levels, moves, shifts, cut, closing, found):
    """Fill found (n,) with the log-likelihoods at shifts (n, SECTORS) of the map's skyline.

    The circle is cut at the sector `cut` and closed over its states `closing`. Blocks of points go from sector to
    sector together, so that processors compute several points at a time. The risen states are held with a zero on
    either side; in float32, which is right to 1e-5 nats.
    """
    count, sectors = shifts.shape
    start, stop, jump = np.float32(moves.start), np.float32(moves.stop), np.float32(moves.jump)
    keep, near, stay = np.float32(moves.keep), np.float32(moves.near), np.float32(1.0 - moves.start * (STATES - 1))
    risen, moved = np.zeros((STATES + 1, BLOCK), dtype=np.float32), np.zeros((STATES + 1, BLOCK), dtype=np.float32)
    clear, total = np.empty(BLOCK, dtype=np.float32), np.empty(BLOCK, dtype=np.float32)
    part, node = np.empty(BLOCK, dtype=np.float32), np.empty(BLOCK, dtype=np.int64)
    reach, table = levels.reach, levels.table
    logs, product, clear_emissions = np.empty(BLOCK), np.empty(BLOCK), np.empty((sectors, BLOCK))
    for first in range(0, count, BLOCK):
        shift = shifts[first : first + BLOCK].T.copy()
        points = shift.shape[1]
        fill_clear_emissions(profiles, shift, clear_emissions)
        found[first : first + BLOCK] = -np.inf
        for k in closing:
            clear[:], logs[:], product[:] = 0.0, 0.0, 1.0
            risen[:], moved[:] = 0.0, 0.0
            for step in range(sectors + 1):
                s = cut + step if cut + step < sectors else cut + step - sectors
                if step > 0:
                    total[:] = 0.0
                    for j in range(1, STATES):
                        for p in range(points):
                            total[p] += risen[j, p]
                    for j in range(1, STATES):
                        for p in range(points):
                            common = start * clear[p] + jump * total[p]
                            moved[j, p] = common + keep * risen[j, p] + near * (risen[j - 1, p] + risen[j + 1, p])
                    for p in range(points):  # the outermost levels have one neighbour, to which they go twice as often
                        moved[2, p] += near * risen[1, p]
                        moved[STATES - 2, p] += near * risen[STATES - 1, p]
                        clear[p] = stay * clear[p] + stop * total[p]
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
                    moved[k] = 1.0 if k > 0 else 0.0
                for j in range(1, STATES):
                    emission = table[s, j - 1]
                    for p in range(points):
                        low = emission[node[p]]
                        risen[j, p] = moved[j, p] * (low + part[p] * (emission[node[p] + 1] - low))
                for p in range(points):
                    clear[p] *= clear_emissions[s, p]
                if step % 4 == 3:
                    for p in range(points):  # numba takes 1.5 s to compile total[:] = clear
                        total[p] = clear[p]
                    for j in range(1, STATES):
                        for p in range(points):
                            total[p] += risen[j, p]
                    for p in range(points):
                        product[p] *= total[p]
                        clear[p] /= total[p]
                    for j in range(1, STATES):
                        for p in range(points):
                            risen[j, p] /= total[p]
                if step % 32 == 31:
                    for p in range(points):
                        logs[p] += log(product[p])
                        product[p] = 1.0
            last = clear if k == 0 else moved[k]
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
    _, x, left, right, bend, _, free, guide = profiles
    for s in range(len(shifts)):
        for p in range(shifts.shape[1]):
            at = shifts[s, p]
            k = cell_at(x, guide, s, at)
            value, rise = left[k], right[k] - left[k]
            if rise != 0.0 or bend[k] != 0.0:
                u = min(max((at - x[k]) / (x[k + 1] - x[k]), 0.0), 1.0)
                value += u * rise + u * (1.0 - u) * bend[k]
            found[s, p] = (1.0 - WRONG_SECTOR) * exp(value - free[s]) + WRONG_SECTOR


def transitions(moves: Moves = MOVES) -> Array:
    """The transitions (STATES, STATES) of the chain, from rows to columns."""
    T = np.full((STATES, STATES), moves.jump)
    T[0], T[:, 0] = moves.start, moves.stop
    T[0, 0] = 1.0 - moves.start * (STATES - 1)
    for j in range(1, STATES):
        T[j, j] += moves.keep
        neighbours = [i for i in (j - 1, j + 1) if 1 <= i < STATES]
        for i in neighbours:
            T[j, i] += 2.0 * moves.near / len(neighbours)
    return T


@njit(cache=True)
def _smooth(e, T):
    """Posterior (SECTORS, STATES) by two rounds forward and backward: the second has forgotten where it began."""
    sectors, states = e.shape
    f, post, a, b = np.zeros((sectors, states)), np.zeros((sectors, states)), np.zeros(states), np.zeros(states)
    for step in range(2 * sectors):
        s, total = step % sectors, 0.0
        for j in range(states):
            moved = 1.0 if step == 0 else 0.0
            for i in range(states):
                moved += a[i] * T[i, j]
            f[s, j] = moved * e[s, j]
            total += f[s, j]
        for j in range(states):
            f[s, j] /= total
            a[j] = f[s, j]
    for j in range(states):
        a[j] = 1.0
    for step in range(2 * sectors):
        s, total, whole = sectors - 1 - step % sectors, 0.0, 0.0
        for j in range(states):
            post[s, j], b[j] = f[s, j] * a[j], a[j] * e[s, j]
            total += post[s, j]
        for i in range(states):
            post[s, i] /= total
            a[i] = 0.0
            for j in range(states):
                a[i] += T[i, j] * b[j]
            whole += a[i]
        for i in range(states):
            a[i] /= whole
    return post


def state_probabilities(profiles: Profiles, shift: Array) -> Array:
    """Probabilities (SECTORS, STATES) of the states where the map's skyline is higher by `shift` (SECTORS,) [rad]."""
    return np.asarray(_smooth(emissions(profiles, shift), transitions()))


def closing_of(states: Array) -> tuple[int, Ints]:
    """The sector where the circle is best cut, and its states that count, by probabilities (SECTORS, STATES)."""
    cut = int(np.argmax(states[:, 0]))
    return cut, np.flatnonzero(states[cut] > CLEAR)
