"""Skylines as polygons: vertices at a tolerance, and chains of two segments in bins of their shape."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
from numpy.typing import NDArray

from startrack.core.types import SECTORS, Array, Bools, Ints

POLYGON_BLOCK = 4096  # skylines at once
BEARING_BINS = 12  # of the middle vertex around the horizon: 30 degrees, ten sigma of a rough heading
LENGTH_BIN = 12.0  # sectors (18 degrees): noise moves a vertex of a smooth skyline by up to ten degrees
ELEVATION_BIN_RAD = float(np.radians(2.0))
DIGITS = np.array([BEARING_BINS, 32, 32, 64, 64, 64])  # bins of a chain: bearing, two lengths, three elevations


def polygon_vertices(elevation_rad: Array, tolerances_rad: Sequence[float]) -> list[Bools]:
    """Whether the points of closed skylines (n, sectors) are vertices of polygons no farther off than each tolerance.

    A chord is split where it is farthest off, beginning with the one from the highest point round to itself; the
    polygons of a smaller tolerance, which follow those of a larger one in `tolerances_rad`, split them further.
    """
    blocks = [elevation_rad[start : start + POLYGON_BLOCK] for start in range(0, len(elevation_rad), POLYGON_BLOCK)]
    found = [_polygons_of_block(block, tolerances_rad) for block in blocks]
    return [np.concatenate(parts) for parts in zip(*found, strict=True)]


def _polygons_of_block(elevation_rad: Array, tolerances_rad: Sequence[float]) -> list[Bools]:
    rows, count = elevation_rad.shape
    at = (np.argmax(elevation_rad, axis=1)[:, None] + np.arange(count + 1)) % count
    height, found = np.take_along_axis(elevation_rad, at, axis=1).astype(np.float32), []
    vertex = np.zeros((rows, count + 1), dtype=bool)
    vertex[:, [0, count]] = True
    for tolerance in tolerances_rad:
        active = np.arange(rows)
        while len(active):
            new = _farthest_points(height[active], vertex[active], tolerance)
            vertex[active] |= new
            active = active[new.any(axis=1)]
        own = np.zeros((rows, count), dtype=bool)
        np.put_along_axis(own, at[:, :-1], vertex[:, :-1], axis=1)
        found.append(own)
    return found


def _farthest_points(height: NDArray[np.float32], vertex: Bools, tolerance: float) -> Bools:
    """Points (n, m) that are farthest from the chord between the vertices beside them, and beyond the tolerance."""
    column = np.arange(height.shape[1], dtype=np.int32)
    low = np.maximum.accumulate(np.where(vertex, column, 0), axis=1)
    high = np.minimum.accumulate(np.where(vertex, column, column[-1])[:, ::-1], axis=1)[:, ::-1]
    part = (column - low).astype(np.float32) / np.maximum(high - low, 1).astype(np.float32)
    first, last = np.take_along_axis(height, low, axis=1), np.take_along_axis(height, high, axis=1)
    off = np.abs(height - first - part * (last - first)).ravel()
    farthest = np.maximum.reduceat(off, np.flatnonzero(vertex))[np.cumsum(vertex) - 1]
    return ((off == farthest) & (off > tolerance)).reshape(vertex.shape)


def chains_of(elevation_rad: Array, vertices: Bools) -> tuple[Ints, Array]:
    """Chains of two segments of polygons: the skyline (k,) of each, and its shape (k, 6) in units of its bins.

    The shape is the bearing of the middle vertex, the lengths of both segments, and the elevations of three vertices.
    `elevation_rad` and `vertices` (n, sectors).
    """
    row, middle = np.nonzero(vertices)
    first = np.searchsorted(row, row)  # of the same skyline
    last = np.searchsorted(row, row, side="right") - 1
    k = np.arange(len(row))
    before = middle[np.where(k == first, last, k - 1)]
    after = middle[np.where(k == last, first, k + 1)]
    lengths = [(middle - before - 1) % SECTORS + 1, (after - middle - 1) % SECTORS + 1]
    shape = [
        middle * (BEARING_BINS / SECTORS),
        *(one / LENGTH_BIN for one in lengths),
        *(elevation_rad[row, one] / ELEVATION_BIN_RAD for one in (before, middle, after)),
    ]
    return row, np.stack(shape, axis=1)


def keys_of(shape: Array) -> Ints:
    """Keys (k,) of the bins in which the shapes (k, 6) lie, within DIGITS; bearings begin anew after the last one."""
    bins = np.floor(shape).astype(np.int64)
    bins[:, 0] %= BEARING_BINS
    return np.asarray(np.ravel_multi_index(tuple(np.clip(bins, 0, DIGITS - 1).T), tuple(DIGITS)))


def near_keys(shape: Array) -> Ints:
    """Keys (64,) of the bins that are nearest to one shape (6,): two in each of its numbers."""
    low = np.floor(shape - 0.5)
    return keys_of(low + np.array(list(product((0, 1), repeat=len(shape)))))
