"""The transitions of the chain of obstacles, and the probabilities of its states around the compass."""

from __future__ import annotations

import numpy as np

from startrack.core.types import Array, Ints
from startrack.kernels.library import kernel
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


def _smooth(e: Array, T: Array) -> Array:
    """Posterior (SECTORS, STATES) by two rounds forward and backward: the second has forgotten where it began."""
    post = np.empty_like(e)
    _smooth_states(e, T, np.empty((e.shape[1] + 2, e.shape[1])), np.empty_like(e), post)
    return post


_smooth_states = kernel(
    "smooth_states", "e: float64[sectors, states]", "T: float64[states, states]",
    "scratch: out float64[states + 2, states]", "f: out float64[sectors, states]",
    "post: out float64[sectors, states]",
)  # fmt: skip


def state_probabilities(likelihoods: Array, moves: Moves = MOVES) -> Array:
    """Probabilities (SECTORS, STATES) of the states by their likelihoods (SECTORS, STATES)."""
    return np.asarray(_smooth(np.ascontiguousarray(likelihoods), transitions(moves)))


def closing_of(states: Array) -> tuple[int, Ints]:
    """The sector where the circle is best cut, and its states that count, by probabilities (SECTORS, STATES)."""
    cut = int(np.argmax(states[:, 0]))
    return cut, np.flatnonzero(states[cut] > CLEAR)
