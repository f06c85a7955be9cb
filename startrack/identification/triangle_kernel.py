"""Kernels of the few triangles of the brightest detections, and of the catalogue's triangles near them."""

from __future__ import annotations

import numpy as np

from startrack.core.kernels import njit


@njit(cache=True)
def sides_of_few(rays, fresh, longest):  # type: ignore[no-untyped-def]
    """Triples (m, 3) of a few dozen rays (n, 3) with sides below `longest` and a vertex from index `fresh` on.

    And their sides (m, 3), which are chords, ascending. Vertices are in the order of the opposite side, as in
    Triangles.
    """
    n, m = len(rays), 0
    chord = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            x, y, z = rays[i, 0] - rays[j, 0], rays[i, 1] - rays[j, 1], rays[i, 2] - rays[j, 2]
            chord[i, j] = np.sqrt(x * x + y * y + z * z)
    most = n * (n - 1) * (n - 2) // 6
    vertices, sides = np.empty((most, 3), np.int64), np.empty((most, 3))
    for i in range(n):
        for j in range(i + 1, n):
            for k in range(max(j + 1, fresh), n):
                if max(chord[i, j], chord[i, k], chord[j, k]) < longest:
                    vertices[m, 0], vertices[m, 1], vertices[m, 2] = i, j, k
                    sides[m, 0], sides[m, 1], sides[m, 2] = chord[j, k], chord[i, k], chord[i, j]
                    for a, b in ((0, 1), (1, 2), (0, 1)):
                        if sides[m, a] > sides[m, b]:
                            sides[m, a], sides[m, b] = sides[m, b], sides[m, a]
                            vertices[m, a], vertices[m, b] = vertices[m, b], vertices[m, a]
                    m += 1
    return vertices[:m], sides[:m]


@njit(cache=True)
def are_same_handed(one, other):  # type: ignore[no-untyped-def]
    """Which of the triples of rays (m, 3, 3) have triple products of the same sign."""
    same = np.empty(len(one), np.bool_)
    for i in range(len(one)):
        same[i] = _triple_product(one[i]) * _triple_product(other[i]) > 0.0
    return same


@njit(inline="always")
def _triple_product(rays):  # type: ignore[no-untyped-def]
    x = rays[1, 1] * rays[2, 2] - rays[1, 2] * rays[2, 1]
    y = rays[1, 2] * rays[2, 0] - rays[1, 0] * rays[2, 2]
    z = rays[1, 0] * rays[2, 1] - rays[1, 1] * rays[2, 0]
    return rays[0, 0] * x + rays[0, 1] * y + rays[0, 2] * z


@njit(cache=True)
def largest_differences(sides, known, row, found, tolerance):  # type: ignore[no-untyped-def]
    """Of pairs (k,) of a row of the `sides` (m, 3) and a triangle of the `known` (n, 3), relative to the shortest side.

    Infinite from the `tolerance` on. `row`, `found` (k,): the pairs.
    """
    off = np.empty(len(row))
    for i in range(len(row)):
        a, b = row[i], found[i]
        largest = max(abs(sides[a, 0] - known[b, 0]), abs(sides[a, 1] - known[b, 1]), abs(sides[a, 2] - known[b, 2]))
        off[i] = largest / sides[a, 0] if largest < tolerance else np.inf
    return off


@njit(cache=True)
def keep_closest(order, off, row, rows, most):  # type: ignore[no-untyped-def]
    """The pairs (k,) of finite differences `off`, in their `order` (k,), that are the first `most` of their row.

    `row` (k,): that of each, of `rows` of them.
    """
    kept, count, k = np.empty(len(row), np.int64), np.zeros(rows, np.int64), 0
    for i in order:
        if off[i] < np.inf and count[row[i]] < most:
            count[row[i]] += 1
            kept[k] = i
            k += 1
    return kept[:k]
