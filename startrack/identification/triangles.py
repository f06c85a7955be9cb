"""Triangles of rays: the pattern that no lens, rotation or scale of the image changes once pixels are rays."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from typing import Any

import numpy as np

from startrack.types import Array, Ints


@dataclass(frozen=True, kw_only=True)
class Triangles:
    """Triangles of stars, vertices ordered by the opposite side, shortest first."""

    vertices: Ints  # (n, 3) indices of the rays
    sides_rad: Array  # (n, 3) ascending
    handed: Array  # (n,) sign of the triple product of the ordered vertices: tells a sky from its mirror image

    def __len__(self) -> int:
        return len(self.vertices)

    def take(self, which: Any) -> Triangles:
        """The triangles selected by a mask or index array."""
        return Triangles(vertices=self.vertices[which], sides_rad=self.sides_rad[which], handed=self.handed[which])


def triangles(rays: Array, reach_rad: float, most: int = 2_000_000) -> Triangles:
    """All triangles of the rays (n, 3) whose sides are all shorter than the reach [rad] (below 90 degrees).

    At most `most`, those of the earliest (brightest) rays first. Flat triangles and those with two nearly equal sides
    are left out: their vertices cannot be ordered or their handedness told.
    """
    vertices = _triples(rays, 2 * np.sin(reach_rad / 2), most)
    a, b, c = rays[vertices[:, 0]], rays[vertices[:, 1]], rays[vertices[:, 2]]
    return _ordered(rays, vertices, np.stack([_angle(b, c), _angle(c, a), _angle(a, b)], axis=1))


def sides_of_few(rays: Array, fresh: int = 0) -> tuple[Ints, Array]:
    """All triples (m, 3) of a few dozen rays with a member from number `fresh` on, and for each its opposite side.

    Sides are chords, in the order of the vertices: a search sorts only what it needs.
    """
    i, j, vertices, opposite = _combinations(len(rays), fresh)
    apart = rays[i] - rays[j]
    return vertices, np.sqrt(np.einsum("ni,ni->n", apart, apart))[opposite]


@lru_cache(maxsize=64)
def _combinations(n: int, fresh: int) -> tuple[Ints, Ints, Ints, Ints]:
    """Pairs i < j, triples (m, 3), and for each vertex of a triple the number of the pair opposite to it."""
    i, j = np.triu_indices(n, 1)
    number = np.zeros((n, n), dtype=np.int64)
    number[i, j] = np.arange(len(i))
    triples = [t for t in combinations(range(n), 3) if t[2] >= fresh]
    a, b, c = np.array(triples, dtype=np.int64).reshape(-1, 3).T
    return i, j, np.stack([a, b, c], axis=1), np.stack([number[b, c], number[a, c], number[a, b]], axis=1)


def triad(cam: Array, icrs: Array) -> Array:
    """R_cam_icrs (m, 3, 3) from the first two of the rays (m, k, 3): quick, and good enough to be compared."""

    def frame(rays: Array) -> Array:
        a = rays[:, 0]
        c = np.cross(a, rays[:, 1])
        c /= np.linalg.norm(c, axis=1, keepdims=True)
        return np.stack([a, c, np.cross(a, c)], axis=2)

    return frame(cam) @ np.swapaxes(frame(icrs), 1, 2)


def _ordered(rays: Array, vertices: Ints, sides: Array) -> Triangles:
    """Vertices (n, 3) sorted by their opposite sides (n, 3); doubtful triangles left out."""
    order = np.argsort(sides, axis=1)
    sides = np.take_along_axis(sides, order, axis=1)
    vertices = np.take_along_axis(vertices, order, axis=1)
    volume = np.linalg.det(rays[vertices])
    good = (np.abs(volume) > 0.05 * sides[:, 2] ** 2 * 0.5) & (np.diff(sides, axis=1).min(axis=1) > 0.01 * sides[:, 2])
    return Triangles(vertices=vertices[good], sides_rad=sides[good], handed=np.sign(volume[good]))


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
    # Every pair (i, j) is extended by each later partner k of i; kept where (j, k) is a pair too.
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
    """Angles (n,) between unit vectors (n, 3), exact at all sizes (Kahan): without a cross product, which is slow."""
    apart, together = a - b, a + b
    short, long = np.einsum("ni,ni->n", apart, apart), np.einsum("ni,ni->n", together, together)
    return 2.0 * np.arctan2(np.sqrt(short), np.sqrt(long))
