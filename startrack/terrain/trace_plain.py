"""Horizons traced with numpy alone: the same rays as in `trace_compiled.py`, many side by side, cell by cell.

All functions take flat arrays (n,) of rays that advance together; a ray that has arrived drops out. Blocks are stepped
over at one level of the pyramid only, which is what pays for arrays.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from startrack.terrain.pyramid import Ground
from startrack.types import Array, Bools, Ints

SPHERE_M = 1_737_400.0
LOWEST_TAN = -50.0
NUDGE_M = 0.05
ROUNDS = 3
FAR_M = 1e9
SHIFT_HEIGHT_M = 1000.0
SKIP_LEVEL = 3
RAYS_AT_ONCE = 20_000
FIRST_GUESS_M, LAST_GUESS_M, GUESS_RATIO = 300.0, 50_000.0, 1.12


def locate(g: Ground, east: Array, north: Array, up: Array) -> tuple[Ints, Array, Array]:
    """Finest map (n,) that reaches each place (up counted from the Moon's centre), -1: none; column and row there."""
    found = np.full(len(east), -1, dtype=np.int64)
    column, row = np.zeros(len(east)), np.zeros(len(east))
    for m in range(len(g.grid)):
        todo = np.flatnonzero(found < 0)
        c, r = _grid(g, m, east[todo], north[todo], up[todo])
        inside = (r >= 0) & (r < g.posts[m, 1] - 1) & (c >= 0) & (c < g.posts[m, 2] - 1)
        found[todo[inside]], column[todo[inside]], row[todo[inside]] = m, c[inside], r[inside]
    return found, column, row


def _grid(g: Ground, m: int, east: Array, north: Array, up: Array) -> tuple[Array, Array]:
    n = g.grid[m]
    v1, v2, v3 = (n[k] * east + n[k + 1] * north + n[k + 2] * up for k in (1, 4, 7))
    if n[0] == 2.0:
        x, y = n[10] * np.arctan2(v2, v1), n[11] * np.arctan2(v3, np.hypot(v1, v2))
    else:
        r = np.sqrt(east * east + north * north + up * up)
        k = n[10] / (r + v3) if n[0] == 0.0 else n[10] / r
        x, y = k * v1, k * v2
    return (x - n[12]) * n[13], (y - n[14]) * n[15]


def _grid_of(g: Ground, m: Ints, east: Array, north: Array, up: Array) -> tuple[Array, Array]:
    """(column, row) on each ray's own map."""
    column, row = np.zeros(len(m)), np.zeros(len(m))
    for number in range(len(g.grid)):
        own = np.flatnonzero(m == number)
        column[own], row[own] = _grid(g, number, east[own], north[own], up[own])
    return column, row


def surface(g: Ground, east: Array, north: Array, guess: Array) -> Array:
    """Height in enu (n,) of the ground; the guess where no map reaches."""
    level2, up = east * east + north * north, np.array(guess, dtype=np.float64)
    for _ in range(ROUNDS):
        m, column, row = locate(g, east, north, g.radius_m + up)
        on = np.flatnonzero(m >= 0)
        m, column, row = m[on], column[on], row[on]
        i, j = row.astype(np.int64), column.astype(np.int64)
        width = g.posts[m, 2]
        at = g.posts[m, 0] + i * width + j
        h, right, down = g.heights, column - j, row - i
        top = h[at] + right * (h[at + 1] - h[at])
        bottom = h[at + width] + right * (h[at + width + 1] - h[at + width])
        r = SPHERE_M + top + down * (bottom - top)
        up[on] = np.sqrt(r * r - level2[on]) - g.radius_m
    return up


def _exit(column: Array, row: Array, d_column: Array, d_row: Array, level: int) -> Array:
    size = 1 << level
    s = np.full(len(column), FAR_M)
    for at, speed in ((column, d_column), (row, d_row)):
        edge = (at.astype(np.int64) >> level << level) + np.where(speed > 0, size, 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            s = np.where(speed != 0, np.minimum(s, (edge - at) / speed), s)
    return np.maximum(s, 0.0) + NUDGE_M


def _block(g: Ground, m: Ints, level: Any, column: Array, row: Array) -> Ints:
    level = np.minimum(level, g.levels[m] - 1)
    b = g.blocks[m, level]
    return np.asarray(b[:, 0] + (row.astype(np.int64) >> level) * b[:, 2] + (column.astype(np.int64) >> level))


def horizon(
    g: Ground, points: Array, up: Array, sin_a: Array, cos_a: Array, start: Array, end: Array, hint: Array
) -> tuple[Array, Array, Array]:
    """tan, distance, and distance of the maps' end (n,), see `trace_compiled.horizon`."""
    out = [np.empty(len(up)) for _ in range(3)]
    for first in range(0, len(up), RAYS_AT_ONCE):
        part = slice(first, first + RAYS_AT_ONCE)
        found = _horizon(g, points[part], up[part], sin_a[part], cos_a[part], start[part], end[part], hint[part])
        for whole, some in zip(out, found, strict=True):
            whole[part] = some
    return out[0], out[1], out[2]


def _horizon(
    g: Ground, points: Array, up: Array, sin_a: Array, cos_a: Array, start: Array, end: Array, hint: Array
) -> tuple[Array, Array, Array]:
    n, moon = len(up), g.radius_m
    east, north = points[:, 0], points[:, 1]
    tan, at, edge, s = np.full(n, LOWEST_TAN), start.copy(), np.full(n, FAR_M), start.copy()
    _first_sight(g, east, north, up, sin_a, cos_a, start, end, hint, tan, at)
    known_s, known_z = np.full(n, -1.0), up.copy()
    k = np.flatnonzero(s < end)
    while len(k):
        e, nn = east[k] + s[k] * sin_a[k], north[k] + s[k] * cos_a[k]
        z = moon + up[k] + tan[k] * s[k]
        m, column, row = locate(g, e, nn, z)
        r = np.sqrt(e * e + nn * nn + z * z)
        climb = (e * sin_a[k] + nn * cos_a[k] + z * tan[k]) / r
        edge[k[m < 0]] = s[k[m < 0]]
        on = (m >= 0) & ~((climb >= 0) & (r - SPHERE_M >= g.highest_m))
        k, e, nn, z, m, column, row, r, climb = (a[on] for a in (k, e, nn, z, m, column, row, r, climb))
        if not len(k):
            break
        step = g.post_m[m]
        rise = np.maximum(tan[k], -1.0)
        column2, row2 = _grid_of(g, m, e + step * sin_a[k], nn + step * cos_a[k], z + step * rise)
        d_column, d_row = (column2 - column) / step, (row2 - row) / step
        skipped = np.zeros(len(k), dtype=bool)
        for level in (SKIP_LEVEL, 0):
            length = _exit(column, row, d_column, d_row, level)
            below = r - SPHERE_M + np.minimum(climb * length, 0.0) >= g.tops[_block(g, m, level, column, row)]
            below &= ~skipped & (level < g.levels[m])
            s[k[below]] += length[below]
            skipped |= below
        q = np.flatnonzero(~skipped)
        _over_cell(g, k[q], length[q], east, north, up, sin_a, cos_a, s, tan, at, known_s, known_z, z[q] - moon)
        k = k[s[k] < end[k]]
    return tan, at, edge


def _first_sight(
    g: Ground, east: Array, north: Array, up: Array, sin_a: Array, cos_a: Array, start: Array, end: Array, hint: Array,
    tan: Array, at: Array,
) -> None:  # fmt: skip
    guess = np.where(hint > 0, hint, np.maximum(start, FIRST_GUESS_M))
    ratio, z = np.where(hint > 0, FAR_M, GUESS_RATIO), up.copy()
    last = np.minimum(end, np.where(hint > 0, FAR_M, LAST_GUESS_M))
    k = np.flatnonzero((guess > start) & (guess < last))
    while len(k):
        before = z[k]
        z[k] = surface(g, east[k] + guess[k] * sin_a[k], north[k] + guess[k] * cos_a[k], before)
        value = (z[k] - up[k]) / guess[k]
        better = (value > tan[k]) & (z[k] != before)  # no change: the maps do not reach there
        tan[k[better]], at[k[better]] = value[better], guess[k[better]]
        guess[k] *= ratio[k]
        k = k[guess[k] < last[k]]
    k = np.flatnonzero((tan == LOWEST_TAN) & (start > 0))  # a sight line straight down would not get far
    if len(k):
        z[k] = surface(g, east[k] + start[k] * sin_a[k], north[k] + start[k] * cos_a[k], up[k])
        on = k[z[k] != up[k]]
        tan[on], at[on] = (z[on] - up[on]) / start[on], start[on]


def _over_cell(
    g: Ground, k: Ints, length: Array, east: Array, north: Array, up: Array, sin_a: Array, cos_a: Array, s: Array,
    tan: Array, at: Array, known_s: Array, known_z: Array, guess: Array,
) -> None:  # fmt: skip
    """Advance rays k over one cell each, with the heights at its near side, middle and far side."""
    if not len(k):
        return
    stop, half = s[k] + length, s[k] + 0.5 * length
    near = np.where(
        known_s[k] == s[k], known_z[k], surface(g, east[k] + s[k] * sin_a[k], north[k] + s[k] * cos_a[k], guess)
    )
    far = surface(g, east[k] + stop * sin_a[k], north[k] + stop * cos_a[k], near)
    middle = surface(g, east[k] + half * sin_a[k], north[k] + half * cos_a[k], 0.5 * (near + far))
    tan[k], at[k] = best_in_step(tan[k], at[k], s[k], stop, near - up[k], middle - up[k], far - up[k])
    known_s[k], known_z[k], s[k] = stop, far, stop


def best_in_step(tan: Array, at: Array, s0: Array, s2: Array, z0: Array, z1: Array, z2: Array) -> tuple[Array, Array]:
    """The better of (tan, at) and the highest of the parabola through three heights above the camera."""
    half = 0.5 * (s2 - s0)
    middle = s0 + half
    with np.errstate(divide="ignore", invalid="ignore"):
        k = (z0 - 2 * z1 + z2) / (2 * half * half)
        q = (z2 - z0) / (2 * half) - 2 * k * middle
        p = z1 - q * middle - k * middle * middle
        top = np.sqrt(np.where((k < 0) & (p < 0), p / k, -1.0))
        inside = (top > s0) & (top < s2)
        for where, value in ((s0, np.where(s0 > 0, z0 / s0, -np.inf)), (middle, z1 / middle), (s2, z2 / s2),
                             (top, np.where(inside, p / top + q + k * top, -np.inf))):  # fmt: skip
            better: Bools = value > tan
            tan, at = np.where(better, value, tan), np.where(better, where, at)
    return tan, at
