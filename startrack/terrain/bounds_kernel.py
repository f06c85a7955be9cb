"""Bounds of the horizon over boxes, compiled with numba, by the rays of `horizon_kernel`.

A ray from anywhere in a box passes near the middle line, so that steepest slopes to the side bound the ground there.
"""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
import numpy as np
from numba import njit

from startrack.terrain.horizon_kernel import (
    FAR_M,
    LOWEST_TAN,
    SPHERE_M,
    best_in_step,
    block_at,
    exit_of,
    horizon,
    locate,
    on_map,
    surface,
)

SHIFT_HEIGHT_M = 1000.0
ACROSS = 8  # steps along each side of a box


@njit(cache=True, nogil=True, inline="always")
def _steepness(slopes, at, unit, d_column, d_row):
    """Most rise per metre in a block and its neighbours, going (d_column, d_row) per metre."""
    a, b = abs(d_column), abs(d_row)
    if a >= b:
        straight = slopes[at, 4] if d_column > 0.0 else -slopes[at, 0]
    else:
        straight = slopes[at, 5] if d_row > 0.0 else -slopes[at, 1]
    if d_column * d_row >= 0.0:
        slanted = slopes[at, 6] if d_row + d_column > 0.0 else -slopes[at, 2]
    else:
        slanted = slopes[at, 7] if d_row > 0.0 else -slopes[at, 3]
    return unit * (abs(a - b) * straight + min(a, b) * slanted)


@njit(cache=True, nogil=True, inline="always")
def _level_of(levels, m, post_m, moon, width, e, n):
    """Lowest level whose blocks' neighbours reach `width` to the side."""
    shift = SHIFT_HEIGHT_M * np.sqrt(e * e + n * n) / moon  # how far 1 km of height moves a place on the map
    across = (1.05 * width + shift) / post_m[m] + 1e-6
    level = 0
    while (1 << level) < across and level < levels[m] - 1:
        level += 1
    return level


@njit(cache=True, nogil=True, inline="always")
def _most(above, s, reach, cos_turn):
    """Largest tan of a height above the lowest camera, at s from the middle of the box."""
    if above > 0.0:
        tan = above / (s - reach) if s > reach else FAR_M
    else:
        tan = above * cos_turn / (s + reach) if s > -reach else -FAR_M
    return tan


@njit(cache=True, nogil=True, inline="always")
def _least(above, s, reach, cos_turn):
    under = above / (s - reach) if s > reach else LOWEST_TAN
    return above * cos_turn / (s + reach) if above > 0.0 else under


@njit(cache=True, nogil=True)
def standing(ground, east, north, half):
    """Height in enu of the ground in the middle of a box, and the lowest and highest anywhere in it."""
    middle, low, high, _, _ = leaning(ground, east, north, half, False)
    return middle, low, high


@njit(cache=True, nogil=True)
def leaning(ground, east, north, half, lean):
    """Height in enu of the ground in the middle of a box, the lowest and highest anywhere in it, and two slopes.

    With `lean` heights are reckoned from a plane through the middle of the box, which rises by the two slopes returned
    to the east and north: the one that fits the corners. Without, the slopes are zero.
    """
    grid, heights, posts, _, _, slopes, blocks, levels, slope_unit, post_m, moon, _ = ground
    middle = surface(grid, posts, heights, moon, east, north, 0.0)
    middle = surface(grid, posts, heights, moon, east, north, middle)
    low, high = middle, middle
    map0, cell0, alike = -2, -1, True
    wide_column, wide_row, column0, row0 = 0.0, 0.0, 0.0, 0.0
    slope_e, slope_n = 0.0, 0.0
    for corner in range(4 * (lean and half > 0.0)):
        to_e, to_n = 2 * (corner & 1) - 1, corner - (corner & 1) - 1
        z = surface(grid, posts, heights, moon, east + half * to_e, north + half * to_n, middle)
        slope_e += to_e * z / (4 * half)
        slope_n += to_n * z / (4 * half)
    for corner in range(4):
        e = east + half * (2 * (corner & 1) - 1)
        n = north + half * (corner - (corner & 1) - 1)
        z = surface(grid, posts, heights, moon, e, n, middle)
        m, column, row = locate(grid, posts, e, n, moon + z)
        z -= slope_e * (e - east) + slope_n * (n - north)
        low, high = min(low, z), max(high, z)
        cell = int(row) * posts[m, 2] + int(column) if m >= 0 else -1
        if corner == 0:
            map0, cell0, column0, row0 = m, cell, column, row
        wide_column, wide_row = max(wide_column, abs(column - column0)), max(wide_row, abs(row - row0))
        alike = alike and m == map0 and cell == cell0 and m >= 0
    if alike:  # one bilinear patch: nothing inside exceeds the corners by more than its twist allows
        at = posts[map0, 0] + cell0
        columns = posts[map0, 2]
        twist = abs(heights[at] - heights[at + 1] - heights[at + columns] + heights[at + columns + 1])
        slack = twist * wide_column * wide_row / 2 + half * half / moon
    else:
        step = 2 * half / ACROSS
        for k in range((ACROSS + 1) * (ACROSS + 1)):
            i = k // (ACROSS + 1)
            e, n = east - half + step * i, north - half + step * (k - i * (ACROSS + 1))
            z = surface(grid, posts, heights, moon, e, n, middle) - slope_e * (e - east) - slope_n * (n - north)
            low, high = min(low, z), max(high, z)
        m, column, row = locate(grid, posts, east, north, moon + middle)
        slack = 2 * half
        if m >= 0:
            level = _level_of(levels, m, post_m, moon, 1.5 * half, east, north)
            at = block_at(blocks, m, level, column, row)
            a, b = 0.0, 0.0
            for turn in range(4):  # steepest to the four sides
                to_e, to_n = post_m[m] * (turn == 0) - post_m[m] * (turn == 1), post_m[m] * (turn > 1) * (5 - 2 * turn)
                column2, row2 = on_map(grid, m, east + to_e, north + to_n, moon + middle)
                rise = _steepness(slopes, at, slope_unit[m], (column2 - column) / post_m[m], (row2 - row) / post_m[m])
                if turn < 2:
                    a = max(a, abs(rise - slope_e * (1 - 2 * turn)) + 0.03 * abs(rise))
                else:
                    b = max(b, abs(rise - slope_n * (5 - 2 * turn)) + 0.03 * abs(rise))
            slack = (a + b) * step / 2 + half * half / moon + half * (abs(east) + abs(north)) / moon
    return middle, low - slack, high + slack, slope_e, slope_n


@njit(cache=True, nogil=True)
def bounds(
    ground, east, north, up, low_up, high_up, slope_e, slope_n, half, sin_a, cos_a, turn, start_m, end_m, hint_m, found
):  # fmt: skip
    """Bounds of the horizon over a box. Fills `found` with what can be said of it, see below.

    The box reaches `half` to each side of (east, north), the camera stands between low_up and high_up there (at `up` in
    the middle), and azimuths reach `turn` to each side. Ground nearer than start_m or beyond end_m does not matter.
    A ray from the box passes the middle line's point s within w = r + (s + r) tan(turn) to the side, at a distance
    between s - r and (s + r) / cos(turn) of its own, r the half width of the box seen along the ray. There the ground
    is within w times the steepest slope to the side of what it is on the middle line. Close to the box the horizon is
    no higher than the steepest slope along the ray, as the camera stands above the ground.

    All heights (low_up and high_up too) may be reckoned from a plane through the middle of the box that rises by
    slope_e to the east and slope_n to the north: a tan then is less by the plane's own rise along the ray. On a
    slope, camera and nearby ground go up and down together, and bounds that reckon from the slope are far closer.

    found: 0, 1: bounds of tan; 2, 3: between which s the ground stands that may be the horizon; 4: where the middle's
    horizon stands; 5: its tan t; 6: a such that this ground is no higher than a + t s on the middle line, and 9: g such
    that it is no higher than that and g w at w aside; 7, 8: an s and a height that the ground nowhere falls short of
    there, and 10: the slope to the side that this reckons with. 5 to 10 are only meant where the slopes are zero.
    """
    grid, heights, posts, tops, wide_tops, slopes, blocks, levels, slope_unit, post_m, moon, highest = ground
    reach = half * (abs(sin_a) + abs(cos_a))
    tan_turn, cos_turn = np.tan(turn), np.cos(turn)
    aside = abs(east * cos_a - north * sin_a)
    along_rise, side_rise = slope_e * sin_a + slope_n * cos_a, slope_e * cos_a - slope_n * sin_a  # of the plane
    tilted = abs(side_rise)
    whole = start_m <= 0.0
    low, high = LOWEST_TAN, LOWEST_TAN
    middle_tan, best_at, _ = horizon(ground, east, north, up, sin_a, cos_a, max(start_m, 0.0), end_m, hint_m)
    first, last = FAR_M, -FAR_M
    line_from = -FAR_M
    low_s, low_z, low_rise = 0.0, low_up - FAR_M, 0.0
    most_rise = 0.0
    steepest = -FAR_M  # along the ray, from the box's near side on
    begin = -reach if whole else start_m
    s = best_at if best_at > reach else 12.0 * reach + 1.0
    level, known_z = 0, up
    probing, running = True, True  # one step at the middle's own horizon gives a lower bound that lets much be skipped
    while running:
        e, n = east + s * sin_a, north + s * cos_a
        width = reach + (abs(s) + reach) * tan_turn
        if probing:
            known_z = surface(grid, posts, heights, moon, e, n, known_z)
            line = moon + known_z
        else:
            line = moon + low_up + low * (max(s - reach, 0.0) if low >= 0.0 else (abs(s) + reach) / cos_turn)
            line += along_rise * s - tilted * width
        m, column, row = locate(grid, posts, e, n, line)
        r = np.sqrt(e * e + n * n + line * line)
        climb = (e * sin_a + n * cos_a + line * (low + along_rise - tilted * tan_turn)) / r
        floor = r - SPHERE_M - (aside + width) / moon * width
        if m < 0 or (not probing and (s >= end_m or (climb >= 0.0 and floor >= highest and s > reach))):
            running = probing
            if probing:
                probing, s, known_z = False, begin, up
        else:
            step = post_m[m]
            rise = max(low + along_rise, -1.0)
            column2, row2 = on_map(grid, m, e + step * sin_a, n + step * cos_a, line + rise * step)
            d_column, d_row = (column2 - column) / step, (row2 - row) / step
            least_level = _level_of(levels, m, post_m, moon, width, e, n)
            near = whole and s < 6.0 * reach and not probing
            level = least_level if near or probing else min(max(level, least_level), levels[m] - 1)
            descending, skipped = not (near or probing), False
            while descending:
                length = exit_of(column, row, d_column, d_row, level)
                if floor + min(climb * length, 0.0) >= wide_tops[block_at(blocks, m, level, column, row)]:
                    s += length
                    level += 1
                    descending, skipped = False, True
                elif level <= least_level:
                    descending = False
                else:
                    level -= 1
            slack, rise_aside, bend, stop = 0.0, 0.0, np.sqrt(e * e + n * n) / moon, s
            if not skipped:
                at = block_at(blocks, m, least_level, column, row)
                length = exit_of(column, row, d_column, d_row, 0)
                stop = s + length
                side_column, side_row = on_map(grid, m, e + step * cos_a, n - step * sin_a, line)
                to_column, to_row = (side_column - column) / step, (side_row - row) / step
                right = _steepness(slopes, at, slope_unit[m], to_column, to_row)
                left = _steepness(slopes, at, slope_unit[m], -to_column, -to_row)
                to_side = max(right - side_rise, left + side_rise, 0.0)
                steep = max(abs(right), abs(left))
                floor += tilted * width
                width += length * tan_turn
                rise_aside = to_side + steep * (0.005 + 2 * bend) + (aside + width) / moon
                slack = rise_aside * width
                if near:
                    along = _steepness(slopes, at, slope_unit[m], d_column, d_row) - along_rise
                    along += (abs(along + along_rise) * (0.01 + 2 * bend) + bend + width / moon) + steep * tan_turn
                    steepest = max(steepest, along)
                elif not probing:
                    top_here = tops[block_at(blocks, m, 0, column, row)] + slack
                    if floor + min(climb * length, 0.0) >= top_here:
                        s, skipped = stop, True
            if not skipped:
                half_s = s + 0.5 * length
                z0 = surface(grid, posts, heights, moon, e, n, known_z)
                z2 = surface(grid, posts, heights, moon, east + stop * sin_a, north + stop * cos_a, z0)
                z1 = surface(grid, posts, heights, moon, east + half_s * sin_a, north + half_s * cos_a, 0.5 * (z0 + z2))
                next_z = z2
                z0, z1, z2 = z0 - along_rise * s, z1 - along_rise * half_s, z2 - along_rise * stop
                over = slack + max(2 * z1 - z0 - z2, 0.0) / 8
                if min(z0, z1, z2) + slack > low_up and s > reach:
                    rest = slack - low_up
                    top, _ = best_in_step(-FAR_M, 0.0, s - reach, stop - reach, z0 + rest, z1 + rest, z2 + rest)
                else:
                    top = max(
                        _most(z0 + over - low_up, s, reach, cos_turn),
                        _most(z1 + over - low_up, half_s, reach, cos_turn),
                        _most(z2 + over - low_up, stop, reach, cos_turn),
                    )
                rest = slack + high_up
                if min(z0, z1, z2) > rest and s > 0.0:
                    tan, at_s = best_in_step(-FAR_M, 0.0, s + reach, stop + reach, z0 - rest, z1 - rest, z2 - rest)
                    if tan * cos_turn > low:
                        low, low_s = tan * cos_turn, at_s - reach
                        low_z = tan * at_s + high_up
                        low_rise = rise_aside
                else:
                    for k in range(3):
                        s_k = s if k == 0 else half_s if k == 1 else stop
                        z_k = (z0 if k == 0 else z1 if k == 1 else z2) - slack
                        if s_k > 0.0 and _least(z_k - high_up, s_k, reach, cos_turn) > low:
                            low, low_s, low_z = _least(z_k - high_up, s_k, reach, cos_turn), s_k, z_k
                            low_rise = rise_aside
                if near:
                    top = min(top, steepest)
                if probing:
                    probing, s, known_z = False, begin, up
                else:
                    if top >= low and stop > -reach:
                        first, last = min(first, s), max(last, stop)
                        high = max(high, top)
                        most_rise = max(most_rise, rise_aside)
                        over -= slack + middle_tan * s
                        line_from = max(line_from, z0 + over, z1 + over - middle_tan * 0.5 * length)
                        line_from = max(line_from, z2 + over - middle_tan * length)
                    known_z, s = next_z, stop
    # What the plane itself rises along a ray that is turned by up to `turn`.
    turned = abs(along_rise) * (1.0 - cos_turn) + tilted * np.sqrt(1.0 - cos_turn * cos_turn)
    found[0], found[1], found[2], found[3], found[4] = low, max(high, low), first, last, best_at
    found[0] += along_rise - turned
    found[1] += along_rise + turned
    found[5], found[6], found[7], found[8] = middle_tan, line_from, low_s, low_z
    found[9], found[10] = most_rise, low_rise
