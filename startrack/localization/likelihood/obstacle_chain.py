"""The skyline around the compass as a Markov chain: the map's, above it, below it, or nothing seen.

In each sector the skyline is the map's (state 0), stands above it by one of the levels of LEVELS_RAD (something on no
map), hides everything, or lies below it by one of the levels of NOTCH_LEVELS_RAD (a gap that the map has filled, a
crest that it has too high). Where the sky's light has an edge of its own over a part of the circle, all states below
the map's mean that instead: stars at the map's skyline, light at its own edge. An obstacle or a notch pays once to
begin and little to continue; its level stays, moves to a neighbour or, seldom, jumps. Besides, each sector may show a
skyline that is anywhere. The likelihood is the trace of the product of transitions and emissions around the circle.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from startrack.core.types import SECTORS, Array, Ints
from startrack.kernels.library import kernel
from startrack.localization.likelihood.skyline_profiles import HIGH_RAD, Profiles, declare, take

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
    """Group of the states `first` to `last`, of which one begins with the probability `start`."""
    count = last - first + 1
    return Group(first, last, start / count, (1 - STOP) * (1 - KEEP - NEAR) / count)


def _moves(sunk_start: float) -> Moves:
    """Moves of the chain, in which a state below the map's skyline begins with the probability `sunk_start`."""
    risen, sunk = _group(1, RISEN, START), _group(RISEN + 1, STATES - 1, sunk_start)
    return Moves(risen, sunk, STOP, (1 - STOP) * KEEP, 0.5 * (1 - STOP) * NEAR)


MOVES = _moves(NOTCH_START)
LIT_MOVES = _moves(LIT_START)  # where all states below the map's skyline are that of light with its own edge


class Levels(NamedTuple):
    """Emissions of all states but the first at shifts of the map's skyline, on nodes closer to each other about 0."""

    reach: Array  # (SECTORS,) largest shift
    table: NDArray[np.float32]  # (SECTORS, STATES - 1, NODES)
    stars: Profiles  # of the stars alone, where the light may have its own edge; else of all rows, and not used
    light: Array  # (SECTORS,) likelihood of light with its own edge; (0,): it has none


def prepare_levels(profiles: Profiles, reach: Array) -> NDArray[np.float32]:
    """Emissions (SECTORS, STATES - 1, NODES) of the states but the first at shifts up to `reach` (SECTORS,).

    As in `emissions`, in float32; the cells are met in the order of the nodes.
    """
    table = np.empty((len(reach), STATES - 1, NODES), np.float32)
    _prepare_levels(
        *take(profiles, _SUMS), HIGH_RAD, WRONG_SECTOR, np.ascontiguousarray(reach), EDGES_RAD, LOWER_EDGE, UPPER_EDGE,
        FROM_RAD, TO_RAD, RISEN, np.empty((len(EDGES_RAD) + 1, NODES)), table,
    )  # fmt: skip
    return table


def clear_emissions(profiles: Profiles, shifts: Array, gains: Array | None = None) -> Array:
    """Likelihoods (n, SECTORS) of sectors whose skyline is the map's, at shifts (n, SECTORS) [rad].

    `gains` (n, SECTORS) are those of the light, see `gains_of_light`; None: 0.
    """
    found = np.empty(shifts.shape[::-1])
    more = np.zeros((0, len(shifts))) if gains is None else np.ascontiguousarray(gains.T)
    _clear_emissions(*take(profiles, _VALUES), HIGH_RAD, WRONG_SECTOR, np.ascontiguousarray(shifts.T), more, found)
    return found.T


def gains_of_light(light: Profiles, shifts: Array, lifts: Array) -> Array:
    """What F of the `light` gains (n, SECTORS) where it stands higher than a skyline at `shifts` by `lifts` [rad]."""
    found = np.empty(shifts.shape)
    _gains_of_light(
        *take(light, _LIGHT), HIGH_RAD, np.ascontiguousarray(shifts), np.ascontiguousarray(lifts), found
    )  # fmt: skip
    return found


def emissions(profiles: Profiles, shift: Array, gain: Array) -> Array:
    """Likelihoods (SECTORS, STATES) of the states at shifts (SECTORS,) [rad] of the map's skyline.

    `gain` (SECTORS,) is that of the light, see `gains_of_light`.
    """
    found = np.empty((len(shift), STATES))
    _emissions(
        *take(profiles, _ALL), HIGH_RAD, WRONG_SECTOR, np.ascontiguousarray(shift), np.ascontiguousarray(gain),
        FROM_RAD, TO_RAD, RISEN, found,
    )  # fmt: skip
    return found


def chain_log_likelihoods(
    profiles: Profiles, levels: Levels, moves: Moves, shifts: Array, cut: int, closing: Ints, found: Array,
    gains: Array | None = None,
) -> None:  # fmt: skip
    """Fill found (n,) with the log-likelihoods at shifts (n, SECTORS) of the map's skyline.

    The circle is cut at the sector `cut` and closed over its states `closing`. Blocks of points go from sector to
    sector together, in float32, which is right to 1e-5 nats. `gains` (n, SECTORS) of the map's skyline are those of the
    light, see `gains_of_light`; None: 0.
    """
    risen, sunk = moves.risen, moves.sunk
    _chain(
        *take(profiles, _VALUES), *take(levels.stars, _VALUES), HIGH_RAD, WRONG_SECTOR, levels.reach, levels.table,
        levels.light, RISEN, risen.start, risen.jump, sunk.start, sunk.jump, moves.stop, moves.keep, moves.near,
        np.ascontiguousarray(shifts), np.zeros((0, shifts.shape[1])) if gains is None else gains, cut, closing,
        np.empty((2 * (STATES + 2), 64), np.float32), np.empty((4, shifts.shape[1], 64)), found,
    )  # fmt: skip


_VALUES = "first x left right bend free guide scale"
_LIGHT = "first x left right bend free guide"
_SUMS = "first x integral free guide scale hidden"
_ALL = "first x left right bend integral free guide scale hidden"
_WINDOW = ("highest: float64", "wrong: float64")
_BANDS = ("from: float64[levels]", "until: float64[levels]", "risen: int64")
_prepare_levels = kernel(
    "prepare_levels", *declare(_SUMS), *_WINDOW, "reach: float64[sectors]", "edge: float64[edges]",
    "lower: int64[levels]", "upper: int64[levels]", *_BANDS, "scratch: out float64[edges + 1, nodes]",
    "table: out float32[sectors, levels, nodes]",
)  # fmt: skip
_clear_emissions = kernel(
    "clear_emissions", *declare(_VALUES), *_WINDOW, "shifts: float64[sectors, n]", "gain: float64[gained, n]",
    "found: out float64[sectors, n]",
)  # fmt: skip
_gains_of_light = kernel(
    "gains_of_light", *declare(_LIGHT), _WINDOW[0], "shifts: float64[n, sectors]", "lifts: float64[n, sectors]",
    "found: out float64[n, sectors]",
)  # fmt: skip
_emissions = kernel(
    "emissions", *declare(_ALL), *_WINDOW, "shift: float64[sectors]", "gain: float64[sectors]", *_BANDS,
    "found: out float64[sectors, states]",
)  # fmt: skip
_MOVES = ("risen_start", "risen_jump", "sunk_start", "sunk_jump", "stop", "keep", "near")
_chain = kernel(
    "chain_log_likelihoods", *declare(_VALUES), *declare(_VALUES, "star_", "star_cells"), *_WINDOW,
    "reach: float64[sectors]", "table: float32[sectors, levels, nodes]", "light: float64[lights]", "risen: int64",
    *(f"{name}: float64" for name in _MOVES), "shifts: float64[n, sectors]", "gains: float64[gained, sectors]",
    "cut: int64", "closing: int64[closings]", "states: out float32[rows, 64]", "scratch: out float64[4, sectors, 64]",
    "found: out float64[n]",
)  # fmt: skip


CLEAR = 1e-3  # least probability of a state over which the circle is closed


def transitions(moves: Moves = MOVES) -> Array:
    """Probabilities (STATES, STATES) of the chain's transitions, from rows to columns."""
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
