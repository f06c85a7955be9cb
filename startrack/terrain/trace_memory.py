"""Horizons and their bounds that were traced before: images and draws of one place ask for them again.

The search cuts its square at the same lines for every image. Under the sky of one time the same stars meet the same
boxes, and a bound that is kept costs a hundredth of one that is traced. What is kept is what was traced, bit for bit.
"""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
from collections.abc import Callable
from threading import Lock

import numpy as np

from startrack.kernels import njit
from startrack.types import Array

SLOTS = 2**17  # boxes and azimuths that are kept: 6 MB; a draw on Shackleton's floor traces 10,000 to 40,000
NEW = np.uint64(0xFFFF_FFFF_FFFF_FFFF)  # a NaN, which no box has
MIX_1, MIX_2, SHIFT = np.uint64(0x9E37_79B9_7F4A_7C15), np.uint64(0xBF58_476D_1CE4_E5B9), np.uint64(29)
MIN_AZIMUTHS, MAX_AZIMUTHS, MAX_SKYLINES = 100, 20_000, 16  # of skylines that are kept: at most 0.7 MB each
Horizons = tuple[Array, Array, Array]  # see `trace_horizons`
Trace = Callable[[Array, Array, Array, Array, Array], None]  # centres, half sides, azimuths; fills low and high


class SkylineMemory:
    """Horizons of single points at many azimuths, the last few."""

    def __init__(self) -> None:
        self._kept: dict[tuple[bytes, bytes], Horizons] = {}
        self._lock = Lock()

    def __reduce__(self) -> tuple[type[SkylineMemory], tuple[()]]:
        return SkylineMemory, ()

    def horizons(self, trace: Callable[[Array, Array], Horizons], points: Array, azimuths: Array) -> Horizons:
        """What `trace` finds at points (n, 2) and azimuths (n,); kept if all points are the same."""
        if not MIN_AZIMUTHS <= len(points) <= MAX_AZIMUTHS or (points != points[0]).any():
            return trace(points, azimuths)
        key = points[0].tobytes(), azimuths.tobytes()
        found = self._kept.get(key)
        if found is None:
            found = trace(points, azimuths)
            with self._lock:
                while len(self._kept) >= MAX_SKYLINES:
                    self._kept.pop(next(iter(self._kept)))
                self._kept[key] = found
        tan, distance, edge = found
        return tan.copy(), distance.copy(), edge.copy()


class BoxMemory:
    """Two numbers by box and azimuth in a table of fixed size, in which later ones replace earlier ones."""

    def __init__(self) -> None:
        self._keys, self._bounds = np.full((SLOTS, 4), NEW), np.empty((SLOTS, 2))
        self._lock = Lock()

    def __reduce__(self) -> tuple[type[BoxMemory], tuple[()]]:
        return BoxMemory, ()  # another process traces for itself

    def fill(self, trace: Trace, centres: Array, half: Array, azimuths: Array, low: Array, high: Array) -> None:
        """Fill low and high (n,) for boxes at centres (n, 2); `trace` fills those that are not kept."""
        keys = np.column_stack([centres, half, azimuths]).view(np.uint64)
        missing = np.empty(len(low), dtype=np.bool_)
        with self._lock:
            _recall(self._keys, self._bounds, keys, low, high, missing)
        if not missing.any():
            return
        results = np.empty((2, np.count_nonzero(missing)))
        trace(centres[missing], half[missing], azimuths[missing], *results)
        low[missing], high[missing] = results
        with self._lock:
            _keep(self._keys, self._bounds, keys[missing], *results)


@njit(cache=True, nogil=True, inline="always")
def _slot(keys, k):
    mixed = keys[k, 0] * MIX_1
    for axis in range(1, 4):
        mixed = ((mixed ^ (mixed >> SHIFT)) + keys[k, axis]) * (MIX_2 if axis & 1 else MIX_1)
    return (mixed ^ (mixed >> SHIFT)) % np.uint64(SLOTS)


@njit(cache=True, nogil=True)
def _recall(kept, bounds, keys, low, high, missing) -> None:
    for k in range(len(low)):
        s = _slot(keys, k)
        missing[k] = False
        for axis in range(4):
            missing[k] |= kept[s, axis] != keys[k, axis]
        low[k], high[k] = bounds[s, 0], bounds[s, 1]


@njit(cache=True, nogil=True)
def _keep(kept, bounds, keys, low, high) -> None:
    for k in range(len(low)):
        s = _slot(keys, k)
        for axis in range(4):
            kept[s, axis] = keys[k, axis]
        bounds[s, 0], bounds[s, 1] = low[k], high[k]
