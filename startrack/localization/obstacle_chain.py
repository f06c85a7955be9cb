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

from startrack.core.kernels import njit
from startrack.core.types import SECTORS, Array, Ints
from startrack.localization.skyline_profiles import Profiles, cell_at, integral_to, log_at

LEVELS_RAD = np.radians([0.04, 0.08, 0.14, 0.24, 0.4, 0.65, 1.0, 1.6, 2.5, 4.0, 6.5, 10.0, 16.0])  # edges
STATES = len(LEVELS_RAD) + 1  # the map's skyline, the levels between the edges, and everything hidden
START = 0.03 / SECTORS  # of an obstacle, a sector: 0.03 obstacles around the circle
STOP, KEEP, NEAR = 0.05, 0.84, 0.14  # an obstacle ends; else its level stays, or goes to a neighbour
WRONG_SECTOR = 1e-3  # probability that the skyline of a sector is anywhere
NODES = 33  # of shifts, at which the emissions of the levels are prepared
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
    table: Array  # (SECTORS, NODES, STATES - 1), float32


@njit(cache=True, nogil=True)
def prepare_levels(profiles, reach):
    """Emissions (SECTORS, NODES, STATES - 1) of the risen states at shifts up to `reach` (SECTORS,)."""
    table, to = np.zeros((len(reach), NODES, STATES - 1), dtype=np.float32), np.empty(len(LEVELS_RAD))
    for s in range(len(reach)):
        for i in range(NODES):
            u = 2.0 * i / (NODES - 1) - 1.0
            shift = reach[s] * u * abs(u)
            for j in range(len(to)):
                to[j] = integral_to(profiles, s, shift + LEVELS_RAD[j])
            for j in range(STATES - 2):
                mean = (to[j + 1] - to[j]) / (LEVELS_RAD[j + 1] - LEVELS_RAD[j])
                table[s, i, j] = (1.0 - WRONG_SECTOR) * mean + WRONG_SECTOR
            table[s, i, STATES - 2] = (1.0 - WRONG_SECTOR) * exp(-profiles.free[s]) + WRONG_SECTOR
    return table


@njit(cache=True, nogil=True)
def risen_emission(profiles, s, shift, j):
    """Likelihood of a sector whose skyline stands in level j above the map's, which is higher by `shift`."""
    if j == STATES - 1:
        return (1.0 - WRONG_SECTOR) * exp(-profiles.free[s]) + WRONG_SECTOR
    low, high = LEVELS_RAD[j - 1], LEVELS_RAD[j]
    mean = (integral_to(profiles, s, shift + high) - integral_to(profiles, s, shift + low)) / (high - low)
    return (1.0 - WRONG_SECTOR) * mean + WRONG_SECTOR


@njit(cache=True, nogil=True)
def clear_emission(profiles, s, shift):
    """Likelihood of a sector whose skyline is the map's."""
    return (1.0 - WRONG_SECTOR) * exp(log_at(profiles, s, shift)) + WRONG_SECTOR


@njit(cache=True, nogil=True)
def emissions(profiles, shift):
    """Likelihoods (SECTORS, STATES) at shifts (SECTORS,) of the map's skyline."""
    found = np.empty((len(shift), STATES))
    for s in range(len(shift)):
        found[s, 0] = clear_emission(profiles, s, shift[s])
        for j in range(1, STATES):
            found[s, j] = risen_emission(profiles, s, shift[s], j)
    return found


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "nsz"})
def chain_log_likelihoods(profiles, levels, moves, shifts, cut, closing, found):
    """Fill found (n,) with the log-likelihoods at shifts (n, SECTORS) of the map's skyline.

    The circle is cut at the sector `cut` and closed over its states `closing`. The risen states are held with a zero
    on either side, so that all have two neighbours; in float32, which is right to 1e-5 nats.
    """
    sectors, risen_states = shifts.shape[1], STATES - 1
    a, b = np.zeros(STATES + 1, dtype=np.float32), np.zeros(STATES + 1, dtype=np.float32)
    start, stop, jump = np.float32(moves.start), np.float32(moves.stop), np.float32(moves.jump)
    keep, near, stay = np.float32(moves.keep), np.float32(moves.near), np.float32(1.0 - moves.start * risen_states)
    cell = profiles.first[:-1].copy()  # of the last point: that of the next one is near
    reach, table, clear_emissions = levels.reach, levels.table, np.empty(sectors)
    for p in range(len(shifts)):
        fill_clear_emissions(profiles, shifts[p], cell, clear_emissions)
        total = -np.inf
        for k in closing:
            logs, product, clear = 0.0, 1.0, np.float32(0.0)
            for j in range(STATES + 1):
                a[j] = 0.0
            for step in range(sectors + 1):
                s = cut + step if cut + step < sectors else cut + step - sectors
                if step > 0:
                    risen = np.float32(0.0)
                    for j in range(risen_states):
                        risen += a[j + 1]
                    common = start * clear + jump * risen
                    clear = stay * clear + stop * risen
                    for j in range(risen_states):
                        b[j + 1] = common + keep * a[j + 1] + near * (a[j] + a[j + 2])
                    b[2] += near * a[1]  # the outermost levels have one neighbour, to which they go twice as often
                    b[risen_states - 1] += near * a[risen_states]
                if step == sectors:
                    break
                d = shifts[p, s]
                emission = np.float32(clear_emissions[s])
                u = sqrt(min(abs(d) / reach[s], 0.999))
                at = ((u if d > 0.0 else -u) + 1.0) * 0.5 * (NODES - 1)
                i = int(at)
                part = np.float32(at - i)
                if step == 0:
                    clear = emission if k == 0 else np.float32(0.0)
                    if k > 0:
                        a[k] = table[s, i, k - 1] + part * (table[s, i + 1, k - 1] - table[s, i, k - 1])
                    continue
                clear *= emission
                for j in range(risen_states):
                    a[j + 1] = b[j + 1] * (table[s, i, j] + part * (table[s, i + 1, j] - table[s, i, j]))
                if step % 4 == 0:
                    scale = clear
                    for j in range(risen_states):
                        scale += a[j + 1]
                    product *= scale
                    clear /= scale
                    for j in range(risen_states):
                        a[j + 1] /= scale
                    if step % 32 == 0:
                        logs += log(product)
                        product = 1.0
            value = logs + log(product) + log(max(clear if k == 0 else b[k], np.float32(1e-37)))
            top = max(value, total)
            total = top + log(exp(value - top) + exp(total - top))
        found[p] = total


@njit(cache=True, nogil=True)
def fill_clear_emissions(profiles, shift, cell, found):
    """Fill found (SECTORS,) with `clear_emission` at shifts (SECTORS,), searched from the last `cell` of each on.

    The arrays are taken out of the tuple once: numba counts references at each access, which took two thirds of the
    time.
    """
    first, x, left, right, bend, _, free = profiles
    for s in range(len(shift)):
        k, at = cell[s], shift[s]
        if at >= x[k + 1] or at < x[k]:
            k = cell[s] = cell_at(first, x, s, at, 0)
        value, rise = left[k], right[k] - left[k]
        if rise != 0.0 or bend[k] != 0.0:
            u = min(max((at - x[k]) / (x[k + 1] - x[k]), 0.0), 1.0)
            value += u * rise + u * (1.0 - u) * bend[k]
        found[s] = (1.0 - WRONG_SECTOR) * exp(value - free[s]) + WRONG_SECTOR


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


@njit(cache=True, nogil=True)
def _smooth(e, T):
    """Posterior (SECTORS, STATES) by two rounds forward and backward: the second has forgotten where it began."""
    sectors, states = e.shape
    f, post, a, c = np.zeros((sectors, states)), np.zeros((sectors, states)), np.ones(states), np.ones(states)
    for step in range(2 * sectors):
        a = (a @ T) * e[step % sectors]
        a /= a.sum()
        f[step % sectors] = a
    for step in range(2 * sectors):
        s = sectors - 1 - step % sectors
        post[s] = f[s] * c / (f[s] * c).sum()
        c = T @ (c * e[s])
        c /= c.sum()
    return post


def state_probabilities(profiles: Profiles, shift: Array) -> Array:
    """Probabilities (SECTORS, STATES) of the states where the map's skyline is higher by `shift` (SECTORS,) [rad]."""
    return np.asarray(_smooth(emissions(profiles, shift), transitions()))


def closing_of(states: Array) -> tuple[int, Ints]:
    """The sector where the circle is best cut, and its states that count, by probabilities (SECTORS, STATES)."""
    cut = int(np.argmax(states[:, 0]))
    return cut, np.flatnonzero(states[cut] > CLEAR)
