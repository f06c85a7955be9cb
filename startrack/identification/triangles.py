"""Triangles of rays, whose sides do not depend on the attitude; and their index by shape, for an unknown scale."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.core.types import Array, Ints

CELL_LENGTH = 16.0  # range of the logarithm of the size within a cell of the key
SMALLEST_LOG = -12.0


@dataclass(frozen=True, kw_only=True)
class Triangles:
    """Triangles of stars, vertices ordered by the opposite side, shortest first."""

    vertices: Ints  # (n, 3) indices of the rays
    sides_rad: Array  # (n, 3) ascending
    handedness: Array  # (n,) sign of the triple product of the ordered vertices; the mirror image has the other sign

    def __len__(self) -> int:
        return len(self.vertices)

    def take(self, which: Any) -> Triangles:
        """The triangles selected by a mask or index array."""
        return Triangles(
            vertices=self.vertices[which], sides_rad=self.sides_rad[which], handedness=self.handedness[which]
        )


def triangles(rays: Array, longest_rad: float, most: int = 2_000_000) -> Triangles:
    """All triangles of the rays (n, 3) with sides shorter than `longest_rad` (below 90 degrees).

    At most `most`, those of the earliest (brightest) rays first. Flat triangles and those with two nearly equal sides
    are left out: their handedness, or the order of their vertices, is not determined.
    """
    vertices = _triples(rays, 2 * np.sin(longest_rad / 2), most)
    a, b, c = rays[vertices[:, 0]], rays[vertices[:, 1]], rays[vertices[:, 2]]
    return _sort_by_opposite_side(rays, vertices, np.stack([_angle(b, c), _angle(c, a), _angle(a, b)], axis=1))


def sides_of_few(rays: Array, fresh: int = 0) -> tuple[Ints, Array]:
    """All triples (m, 3) of a few dozen rays with a vertex from index `fresh` on, and their opposite sides (m, 3).

    Sides are chords in the order of the vertices; the caller sorts those that it needs.
    """
    i, j, vertices, opposite = _combinations(len(rays), fresh)
    apart = rays[i] - rays[j]
    return vertices, np.sqrt(np.einsum("ni,ni->n", apart, apart))[opposite]


@lru_cache(maxsize=64)
def _combinations(n: int, fresh: int) -> tuple[Ints, Ints, Ints, Ints]:
    """Pairs i < j, triples (m, 3), and for each vertex of a triple the index of the opposite pair."""
    i, j = np.triu_indices(n, 1)
    number = np.zeros((n, n), dtype=np.int64)
    number[i, j] = np.arange(len(i))
    triples = [t for t in combinations(range(n), 3) if t[2] >= fresh]
    a, b, c = np.array(triples, dtype=np.int64).reshape(-1, 3).T
    return i, j, np.stack([a, b, c], axis=1), np.stack([number[b, c], number[a, c], number[a, b]], axis=1)


def triad_attitude(cam: Array, icrs: Array) -> Array:
    """R_cam_icrs (m, 3, 3) from the first two of the rays (m, k, 3): fast, and accurate enough for a comparison.

    Source: Black 1964, AIAA J. 2, 1350 (TRIAD).
    """

    def frame(rays: Array) -> Array:
        a = rays[:, 0]
        c = np.cross(a, rays[:, 1])
        c /= np.linalg.norm(c, axis=1, keepdims=True)
        return np.stack([a, c, np.cross(a, c)], axis=2)

    return frame(cam) @ np.swapaxes(frame(icrs), 1, 2)


def _sort_by_opposite_side(rays: Array, vertices: Ints, sides: Array) -> Triangles:
    """Triangles with vertices (n, 3) sorted by their opposite sides (n, 3); degenerate ones are left out."""
    order = np.argsort(sides, axis=1)
    sides = np.take_along_axis(sides, order, axis=1)
    vertices = np.take_along_axis(vertices, order, axis=1)
    volume = np.linalg.det(rays[vertices])
    good = (np.abs(volume) > 0.05 * sides[:, 2] ** 2 * 0.5) & (np.diff(sides, axis=1).min(axis=1) > 0.01 * sides[:, 2])
    return Triangles(vertices=vertices[good], sides_rad=sides[good], handedness=np.sign(volume[good]))


def _triples(rays: Array, chord: float, most: int) -> Ints:
    """Index triples i < j < k (m, 3) of rays that are pairwise closer than the chord."""
    from scipy.spatial import cKDTree

    pairs = cKDTree(rays).query_pairs(chord, output_type="ndarray").astype(np.int64)
    if not len(pairs):
        return np.zeros((0, 3), dtype=np.int64)
    pairs = np.sort(pairs, axis=1)
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    n = len(rays)
    starts = np.searchsorted(pairs[:, 0], np.arange(n + 1))
    # Each pair (i, j) is extended by every later partner k of i, and kept where (j, k) is a pair too.
    own = np.arange(len(pairs))
    later = starts[pairs[:, 0] + 1] - own - 1
    first = np.repeat(own, later)
    second = np.arange(later.sum()) - np.repeat(np.cumsum(later) - later, later) + first + 1
    j, k = pairs[first, 1], pairs[second, 1]
    keys = pairs[:, 0] * n + pairs[:, 1]
    wanted = j * n + k
    at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    closed = keys[at] == wanted
    triples = np.stack([pairs[first, 0], j, k], axis=1)[closed]
    if len(triples) > most:
        triples = triples[np.argsort(triples.max(axis=1), kind="stable")[:most]]
    return triples


def _angle(a: Array, b: Array) -> Array:
    """Angles (n,) between unit vectors (n, 3), exact at all sizes (Kahan), without a slow cross product."""
    apart, together = a - b, a + b
    short, long = np.einsum("ni,ni->n", apart, apart), np.einsum("ni,ni->n", together, together)
    return 2.0 * np.arctan2(np.sqrt(short), np.sqrt(long))


@dataclass(frozen=True)
class ShapeIndex:
    """Catalogue triangles sorted by a key: the cell of their two ratios of sides, then the logarithm of the size."""

    triangles: Triangles
    key: Array  # (n,) ascending
    ratios: NDArray[np.float32]  # (n, 2)
    shape_tolerance: float
    size_tolerance: float  # of the logarithm

    def candidates(self, image: Triangles) -> tuple[Ints, Ints]:
        """Pairs (image triangle, catalogue triangle) that agree, mirror images included; sorted by the first."""
        ratios, log_size = _features(image)
        cell = np.floor(ratios / (2 * self.shape_tolerance) - 0.5).astype(np.int64)
        # The tolerance is half a cell, so that candidates lie in at most four cells.
        cells = cell[:, None] + np.array([(0, 0), (0, 1), (1, 0), (1, 1)])
        keys = _key(cells, log_size[:, None], self.shape_tolerance).ravel()
        first = np.searchsorted(self.key, keys - self.size_tolerance)
        count = np.searchsorted(self.key, keys + self.size_tolerance) - first
        total = np.cumsum(count)
        left = np.repeat(np.arange(len(keys)) // 4, count)
        right = np.arange(total[-1] if len(total) else 0) + np.repeat(first - (total - count), count)
        off = np.abs(self.ratios[right] - ratios.astype(np.float32)[left])
        agree = np.maximum(off[:, 0], off[:, 1]) < self.shape_tolerance
        return left[agree], right[agree]


def shape_index(found: Triangles, shape_tolerance: float, size_tolerance: float) -> ShapeIndex:
    """Index of the triangles; the tolerances are relative."""
    ratios, log_size = _features(found)
    key = _key(np.floor(ratios / (2 * shape_tolerance)).astype(np.int64), log_size, shape_tolerance)
    order = np.argsort(key)
    return ShapeIndex(found.take(order), key[order], ratios[order].astype(np.float32), shape_tolerance, size_tolerance)


def _features(found: Triangles) -> tuple[Array, Array]:
    """The two shorter sides over the longest (n, 2), and its logarithm (n,)."""
    longest = found.sides_rad[:, 2]
    return found.sides_rad[:, :2] / longest[:, None], np.log(longest)


def _key(cell: Ints, log_size: Array, shape_tolerance: float) -> Array:
    """Cells (..., 2) first, sizes (...) within them."""
    cells_in_row = int(1.0 / (2 * shape_tolerance)) + 3
    size = np.clip(log_size - SMALLEST_LOG, 1.0, CELL_LENGTH - 1.0)
    return (cell[..., 0] * cells_in_row + cell[..., 1]) * CELL_LENGTH + size
