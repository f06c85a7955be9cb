"""Bounds of the horizon over boxes that were traced before: images and draws of one place ask for them again.

The search cuts its square at the same lines for every image. It bounds the same parts of sectors in the same boxes,
and under the sky of one time the same stars, too. What is kept is what was traced, bit for bit.
"""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
from collections.abc import Callable
from threading import Lock

import numpy as np

from startrack.core.kernels import njit
from startrack.core.types import Array

SLOTS = 2**18  # boxes and azimuths that are kept: 15 MB; a draw on Shackleton's floor traces 20,000 to 110,000
NUMBERS = 5  # of a box and its azimuths
NEW = np.uint64(0xFFFF_FFFF_FFFF_FFFF)  # a NaN, which no box has
MIX_1, MIX_2, SHIFT = np.uint64(0x9E37_79B9_7F4A_7C15), np.uint64(0xBF58_476D_1CE4_E5B9), np.uint64(29)
Trace = Callable[..., None]  # of centres, half sides, azimuths, their half widths; fills low and high


class BoxMemory:
    """Bounds by box and azimuths in a table of fixed size, in which later ones replace earlier ones."""

    def __init__(self) -> None:
        self._keys, self._bounds = np.full((SLOTS, NUMBERS), NEW), np.empty((SLOTS, 2))
        self._lock = Lock()

    def __reduce__(self) -> tuple[type[BoxMemory], tuple[()]]:
        return BoxMemory, ()  # another process traces for itself

    def fill(
        self, trace: Trace, centres: Array, half: Array, azimuths: Array, turn: Array, low: Array, high: Array
    ) -> None:
        """Fill low and high (n,) for boxes at centres (n, 2), azimuths and their half widths (n,).

        `trace` fills those that are not kept.
        """
        keys = np.column_stack([centres, half, azimuths, turn]).view(np.uint64)
        missing = np.empty(len(low), dtype=np.bool_)
        with self._lock:
            _recall(self._keys, self._bounds, keys, low, high, missing)
        if not missing.any():
            return
        results = np.empty((2, np.count_nonzero(missing)))
        trace(centres[missing], half[missing], azimuths[missing], turn[missing], *results)
        low[missing], high[missing] = results
        with self._lock:
            _keep(self._keys, self._bounds, keys[missing], *results)


@njit(cache=True, nogil=True, inline="always")
def _slot(keys, k):
    mixed = keys[k, 0] * MIX_1
    for number in range(1, NUMBERS):
        mixed = ((mixed ^ (mixed >> SHIFT)) + keys[k, number]) * (MIX_2 if number & 1 else MIX_1)
    return (mixed ^ (mixed >> SHIFT)) % np.uint64(SLOTS)


@njit(cache=True, nogil=True)
def _recall(kept, bounds, keys, low, high, missing) -> None:
    for k in range(len(low)):
        s = _slot(keys, k)
        missing[k] = False
        for number in range(NUMBERS):
            missing[k] |= kept[s, number] != keys[k, number]
        low[k], high[k] = bounds[s, 0], bounds[s, 1]


@njit(cache=True, nogil=True)
def _keep(kept, bounds, keys, low, high) -> None:
    for k in range(len(low)):
        s = _slot(keys, k)
        for number in range(NUMBERS):
            kept[s, number] = keys[k, number]
        bounds[s, 0], bounds[s, 1] = low[k], high[k]
