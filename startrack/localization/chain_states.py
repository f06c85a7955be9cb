"""The transitions of the chain of obstacles, and the probabilities of its states around the compass."""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
import numpy as np

from startrack.core.kernels import njit
from startrack.core.types import Array, Ints
from startrack.localization.obstacle_chain import MOVES, STATES, Moves

CLEAR = 1e-3  # least probability of a state over which the circle is closed


def transitions(moves: Moves = MOVES) -> Array:
    """The transitions (STATES, STATES) of the chain, from rows to columns."""
    T = np.zeros((STATES, STATES))
    T[0, 0], T[1:, 0] = 1.0, moves.stop
    for group in (moves.risen, moves.sunk):
        own = np.arange(group.first, group.last + 1)
        T[0, own], T[np.ix_(own, own)] = group.start, group.jump
        T[0, 0] -= group.start * len(own)
        T[own, own] += moves.keep
        for j in own:
            neighbours = [i for i in (j - 1, j + 1) if i in own]
            T[j, neighbours] += 2.0 * moves.near / len(neighbours)
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


def state_probabilities(likelihoods: Array, moves: Moves = MOVES) -> Array:
    """Probabilities (SECTORS, STATES) of the states by their likelihoods (SECTORS, STATES)."""
    return np.asarray(_smooth(likelihoods, transitions(moves)))


def closing_of(states: Array) -> tuple[int, Ints]:
    """The sector where the circle is best cut, and its states that count, by probabilities (SECTORS, STATES)."""
    cut = int(np.argmax(states[:, 0]))
    return cut, np.flatnonzero(states[cut] > CLEAR)
