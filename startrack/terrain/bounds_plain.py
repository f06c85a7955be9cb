"""Bounds of the horizon over boxes with numpy alone: as `bounds_compiled.py`, cell by cell for many rays at once."""

from __future__ import annotations

import numpy as np

from startrack.terrain.pyramid import Ground
from startrack.terrain.trace_plain import (
    FAR_M,
    LOWEST_TAN,
    SHIFT_HEIGHT_M,
    SPHERE_M,
    _block,
    _exit,
    _grid_of,
    horizon,
    locate,
    surface,
)
from startrack.types import Array, Ints

AT_ONCE = 20_000
ACROSS = 8


def standing(g: Ground, centres: Array, half: Array) -> tuple[Array, Array, Array]:
    """Height in enu (n,) of the ground in the middle of boxes, and the lowest and highest anywhere in them."""
    line = np.linspace(-1.0, 1.0, ACROSS + 1)
    offsets = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    points = centres[:, None, :] + half[:, None, None] * offsets
    flat = points.reshape(-1, 2)
    z = surface(g, flat[:, 0], flat[:, 1], np.zeros(len(flat)))
    z = surface(g, flat[:, 0], flat[:, 1], z).reshape(len(half), -1)
    middle = z[:, len(offsets) // 2]
    east, north = centres[:, 0], centres[:, 1]
    zero, one = np.zeros(len(half)), np.ones(len(half))
    steep = np.zeros(len(half))
    for a, b in ((one, zero), (zero, one)):
        _, rise, back = _slopes(g, east, north, middle, a, b, 1.5 * half)
        steep += np.maximum(np.maximum(rise, back), 0.0)
    slack = steep * 1.03 * half / ACROSS + half * (half + np.abs(east) + np.abs(north)) / g.radius_m
    return middle, z.min(axis=1) - slack, z.max(axis=1) + slack


def _slopes(
    g: Ground, east: Array, north: Array, z: Array, sin_a: Array, cos_a: Array, width: Array
) -> tuple[Ints, Array, Array]:
    """Map (n,), and the most rise per metre within `width` of places, along an azimuth and against it."""
    m, column, row = locate(g, east, north, g.radius_m + z)
    on = np.maximum(m, 0)
    shift = SHIFT_HEIGHT_M * np.hypot(east, north) / g.radius_m
    across = (1.05 * width + shift) / g.post_m[on] + 1e-6
    level = np.minimum(np.ceil(np.log2(np.maximum(across, 1.0))).astype(np.int64), g.levels[on] - 1)
    step = g.post_m[on]
    column2, row2 = _grid_of(g, on, east + step * sin_a, north + step * cos_a, g.radius_m + z)
    inside = m >= 0
    at = _block(g, on, level, np.where(inside, column, 0), np.where(inside, row, 0))
    d_column, d_row = (column2 - column) / step, (row2 - row) / step
    rise, back = (_steepness(g, at, on, k * d_column, k * d_row) for k in (1, -1))
    return m, np.where(inside, rise, 1.0), np.where(inside, back, 1.0)


def _steepness(g: Ground, at: Ints, m: Ints, d_column: Array, d_row: Array) -> Array:
    s = g.slopes[at].astype(np.float64)
    a, b = np.abs(d_column), np.abs(d_row)
    along_columns = np.where(d_column > 0, s[:, 4], -s[:, 0])
    along_rows = np.where(d_row > 0, s[:, 5], -s[:, 1])
    same = np.where(d_row + d_column > 0, s[:, 6], -s[:, 2])
    other = np.where(d_row > 0, s[:, 7], -s[:, 3])
    straight, slanted = np.where(a >= b, along_columns, along_rows), np.where(d_column * d_row >= 0, same, other)
    return np.asarray(g.slope_unit[m] * (np.abs(a - b) * straight + np.minimum(a, b) * slanted))


def bounds(
    g: Ground, centres: Array, up: Array, low_up: Array, high_up: Array, half: Array, sin_a: Array, cos_a: Array,
    turn: Array, start: Array, end: Array,
) -> Array:  # fmt: skip
    """What `bounds_compiled.bounds` finds (n, 11), for each box and azimuth."""
    out = np.empty((len(up), 11))
    for first in range(0, len(up), AT_ONCE):
        part = slice(first, first + AT_ONCE)
        arrays = (a[part] for a in (centres, up, low_up, high_up, half, sin_a, cos_a, turn, start, end))
        out[part] = _bounds(g, *arrays)
    return out


def _bounds(
    g: Ground, centres: Array, up: Array, low_up: Array, high_up: Array, half: Array, sin_a: Array, cos_a: Array,
    turn: Array, start: Array, end: Array,
) -> Array:  # fmt: skip
    n = len(up)
    reach = half * (np.abs(sin_a) + np.abs(cos_a))
    east, north = centres[:, 0], centres[:, 1]
    aside = np.abs(east * cos_a - north * sin_a)
    tan_turn, cos_turn = np.tan(turn), np.cos(turn)
    begin = np.maximum(start, 0.0)
    middle_tan, best_at, _ = horizon(g, centres, up, sin_a, cos_a, begin, end, np.zeros(n))
    found = np.empty((n, 11))
    low, first, last = np.full(n, LOWEST_TAN), np.full(n, FAR_M), np.full(n, -FAR_M)
    high, line_from = low.copy(), np.full(n, -FAR_M)
    low_s, low_z = np.zeros(n), np.full(n, -1e9)
    most_rise = np.zeros(n)
    steepest = np.full(n, -FAR_M)  # along the ray, from the box's near side on
    probes = (np.where(best_at > reach, best_at, 12 * reach + 1), 12 * reach + 1)
    z = up.copy()
    for s in probes:
        z, slack = _strip(g, east, north, s, sin_a, cos_a, z, reach + (s + reach) * tan_turn, aside)
        _raise_low(low, low_s, low_z, slice(None), s, z - slack, high_up, reach, cos_turn)
    s = np.where(start <= 0, -reach, start)
    k = np.arange(n)
    z = up.copy()
    while len(k):
        e, nn = east[k] + s[k] * sin_a[k], north[k] + s[k] * cos_a[k]
        width = reach[k] + (np.abs(s[k]) + reach[k]) * tan_turn[k]
        far = np.where(low[k] >= 0, np.maximum(s[k] - reach[k], 0.0), (np.abs(s[k]) + reach[k]) / cos_turn[k])
        line = g.radius_m + low_up[k] + low[k] * far
        m, column, row = locate(g, e, nn, line)
        r = np.sqrt(e * e + nn * nn + line * line)
        climb = (e * sin_a[k] + nn * cos_a[k] + line * low[k]) / r
        floor = r - SPHERE_M - (aside[k] + width) / g.radius_m * width
        on = (m >= 0) & (s[k] < end[k]) & ~((climb >= 0) & (floor >= g.highest_m) & (s[k] > reach[k]))
        k, e, nn, line, m, column, row, climb, floor, width = (
            a[on] for a in (k, e, nn, line, m, column, row, climb, floor, width)
        )
        if not len(k):
            break
        step = g.post_m[m]
        column2, row2 = _grid_of(
            g, m, e + step * sin_a[k], nn + step * cos_a[k], line + step * np.maximum(low[k], -1.0)
        )
        d_column, d_row = (column2 - column) / step, (row2 - row) / step
        length = _exit(column, row, d_column, d_row, 0)
        stop = s[k] + length
        width = width + length * tan_turn[k]
        near_top = g.tops[_block(g, m, 0, column, row)]
        _, slack = _strip(g, east[k], north[k], s[k], sin_a[k], cos_a[k], z[k], width, aside[k])
        skip = (floor + np.minimum(climb * length, 0.0) >= near_top + slack) & (s[k] > 6 * reach[k])
        q = np.flatnonzero(~skip)
        if len(q):
            kq, half_s = k[q], s[k[q]] + 0.5 * length[q]
            heights = [
                surface(g, east[kq] + at * sin_a[kq], north[kq] + at * cos_a[kq], z[kq])
                for at in (s[kq], half_s, stop[q])
            ]
            bulge = np.maximum(2 * heights[1] - heights[0] - heights[2], 0.0) / 8
            top = np.full(len(q), -FAR_M)
            for at, height in zip((s[kq], half_s, stop[q]), heights, strict=True):
                over = height + slack[q] + bulge
                top = np.maximum(top, _most(over - low_up[kq], at, reach[kq], cos_turn[kq]))
                _raise_low(low, low_s, low_z, kq, at, height - slack[q], high_up[kq], reach[kq], cos_turn[kq])
            near = np.flatnonzero((start[kq] <= 0) & (s[kq] < 6 * reach[kq]))
            if len(near):
                kn = kq[near]
                steepest[kn] = np.maximum(
                    steepest[kn],
                    _climb(g, e[q][near], nn[q][near], heights[0][near], sin_a[kn], cos_a[kn], width[q][near]),
                )
                top[near] = np.minimum(top[near], steepest[kn])
            kept = (top >= low[kq]) & (stop[q] > -reach[kq])
            kk = kq[kept]
            first[kk], last[kk] = np.minimum(first[kk], s[kk]), np.maximum(last[kk], stop[q][kept])
            high[kk] = np.maximum(high[kk], top[kept])
            most_rise[kk] = np.maximum(most_rise[kk], (slack[q] / width[q])[kept])
            for at, height in zip((s[kq], half_s, stop[q]), heights, strict=True):
                over = (height + bulge - middle_tan[kq] * at)[kept]
                line_from[kk] = np.maximum(line_from[kk], over)
            z[kq] = heights[2]
        s[k] = stop
    found[:, 0], found[:, 1], found[:, 2], found[:, 3], found[:, 4] = low, np.maximum(high, low), first, last, best_at
    found[:, 5], found[:, 6], found[:, 7], found[:, 8] = middle_tan, line_from, low_s, low_z
    found[:, 9], found[:, 10] = most_rise, 0.0
    return found


def _strip(
    g: Ground, east: Array, north: Array, s: Array, sin_a: Array, cos_a: Array, guess: Array, width: Array, aside: Array
) -> tuple[Array, Array]:
    """Height of the ground on the middle line at s, and how far it may differ to the sides."""
    e, n = east + s * sin_a, north + s * cos_a
    z = surface(g, e, n, guess)
    _, rise, back = _slopes(g, e, n, z, cos_a, -sin_a, width)
    bend = np.hypot(e, n) / g.radius_m
    steep = np.maximum(np.maximum(rise, back), 0.0) * (1.005 + 2 * bend)
    return z, np.asarray((steep + (aside + width) / g.radius_m) * width)


def _climb(g: Ground, e: Array, n: Array, z: Array, sin_a: Array, cos_a: Array, width: Array) -> Array:
    """Most rise per metre along the ray, in enu."""
    _, along, _ = _slopes(g, e, n, z, sin_a, cos_a, width)
    bend = np.hypot(e, n) / g.radius_m
    return np.asarray(along + np.abs(along) * (0.01 + 2 * bend) + bend + width / g.radius_m)


def _raise_low(
    low: Array, low_s: Array, low_z: Array, k: slice | Ints, s: Array, z: Array, high_up: Array, reach: Array,
    cos_turn: Array,
) -> None:  # fmt: skip
    over = z - high_up
    with np.errstate(divide="ignore"):
        value = np.where(over > 0, over * cos_turn / (s + reach), np.where(s > reach, over / (s - reach), LOWEST_TAN))
    better = (value > low[k]) & (s > 0)
    where = np.arange(len(low))[k][better]
    low[where], low_s[where], low_z[where] = value[better], s[better], z[better]


def _most(above: Array, s: Array, reach: Array, cos_turn: Array) -> Array:
    with np.errstate(divide="ignore", invalid="ignore"):
        over = np.where(s > reach, above / (s - reach), FAR_M)
        under = np.where(s > -reach, above * cos_turn / (s + reach), -FAR_M)
    return np.asarray(np.where(above > 0, over, under))
