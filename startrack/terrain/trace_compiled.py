"""Horizons traced ray by ray, compiled with numba: the exact horizon of a point, and bounds over boxes.

A ray leaves the camera's place at an azimuth; s is the horizontal distance along it in enu. The horizon is the largest
tan = (z(s) - z(camera)) / s over the ground's heights z(s) in enu. The ray goes from crossing to crossing of the map's
grid lines; blocks of cells that lie wholly below the sight line to the best horizon so far are stepped over at once.

Helpers have one exit and take plain arrays: numba then needs no reference counts, which cost ten times the arithmetic.
"""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
import numpy as np
from numba import njit

SPHERE_M = 1_737_400.0
LOWEST_TAN = -50.0
NUDGE_M = 0.05  # past a grid line; a kink is missed by that much at most
FIXED_POINT_ROUNDS = 3
SETTLED_M = 0.5  # between rounds, each of which leaves a few per cent of the last one's change
FAR_M = 1e9
SHIFT_HEIGHT_M = 1000.0
ACROSS = 8  # steps along each side of a box
FIRST_GUESS_M, LAST_GUESS_M, GUESS_RATIO = 300.0, 50_000.0, 1.12


@njit(cache=True, nogil=True, inline="always")
def _grid(grid, m, east, north, up):
    """(column, row) on map m of the direction of (east, north, up) from the Moon's centre."""
    v1 = grid[m, 1] * east + grid[m, 2] * north + grid[m, 3] * up
    v2 = grid[m, 4] * east + grid[m, 5] * north + grid[m, 6] * up
    v3 = grid[m, 7] * east + grid[m, 8] * north + grid[m, 9] * up
    kind = grid[m, 0]
    if kind == 2.0:
        x, y = grid[m, 10] * np.arctan2(v2, v1), grid[m, 11] * np.arctan2(v3, np.sqrt(v1 * v1 + v2 * v2))
    else:
        r = np.sqrt(east * east + north * north + up * up)
        k = grid[m, 10] / (r + v3) if kind == 0.0 else grid[m, 10] / r
        x, y = k * v1, k * v2
    return (x - grid[m, 12]) * grid[m, 13], (y - grid[m, 14]) * grid[m, 15]


@njit(cache=True, nogil=True, inline="always")
def _locate(grid, posts, east, north, up):
    """Finest map that reaches a place, and (column, row) there; map -1 where none does."""
    found, column, row = -1, 0.0, 0.0
    for m in range(grid.shape[0]):
        if found < 0:
            column, row = _grid(grid, m, east, north, up)
            if 0.0 <= row < posts[m, 1] - 1 and 0.0 <= column < posts[m, 2] - 1:
                found = m
    return found, column, row


@njit(cache=True, nogil=True, inline="always")
def _height(heights, posts, m, column, row):
    columns = posts[m, 2]
    i, j = int(row), int(column)
    down, right = row - i, column - j
    at = posts[m, 0] + i * columns + j
    top = heights[at] + right * (heights[at + 1] - heights[at])
    bottom = heights[at + columns] + right * (heights[at + columns + 1] - heights[at + columns])
    return top + down * (bottom - top)


@njit(cache=True, nogil=True, inline="always")
def _surface(grid, posts, heights, moon, east, north, guess):
    """Height in enu of the ground at (east, north); the guess where no map reaches."""
    level2 = east * east + north * north
    up, before, rounds = guess, guess + 1.0, 0
    while rounds < FIXED_POINT_ROUNDS and abs(up - before) > SETTLED_M:
        rounds += 1
        before = up
        m, column, row = _locate(grid, posts, east, north, moon + up)
        if m >= 0:
            r = SPHERE_M + _height(heights, posts, m, column, row)
            up = np.sqrt(r * r - level2) - moon
    return up


@njit(cache=True, nogil=True, inline="always")
def _exit(column, row, d_column, d_row, level):
    """Distance to the edge of the block of a level that holds (column, row), going d_column, d_row per metre."""
    size = 1 << level
    j, i = (int(column) >> level) << level, (int(row) >> level) << level
    s = FAR_M
    if d_column > 0.0:
        s = min(s, (j + size - column) / d_column)
    elif d_column < 0.0:
        s = min(s, (j - column) / d_column)
    if d_row > 0.0:
        s = min(s, (i + size - row) / d_row)
    elif d_row < 0.0:
        s = min(s, (i - row) / d_row)
    return max(s, 0.0) + NUDGE_M


@njit(cache=True, nogil=True, inline="always")
def _block(blocks, m, level, column, row):
    return blocks[m, level, 0] + (int(row) >> level) * blocks[m, level, 2] + (int(column) >> level)


@njit(cache=True, nogil=True, inline="always")
def _best_in_step(tan, at, s0, s2, z0, z1, z2):
    """The better of (tan, at) and the highest of the parabola through three heights above the camera."""
    half = 0.5 * (s2 - s0)
    if s0 > 0.0 and z0 > tan * s0:
        tan, at = z0 / s0, s0
    if z1 > tan * (s0 + half):
        tan, at = z1 / (s0 + half), s0 + half
    if z2 > tan * s2:
        tan, at = z2 / s2, s2
    # z = p + q s + k s^2 is seen highest where s^2 = p / k.
    k = (z0 - 2 * z1 + z2) / (2 * half * half)
    if k < 0.0:
        middle = s0 + half
        q = (z2 - z0) / (2 * half) - 2 * k * middle
        p = z1 - q * middle - k * middle * middle
        if p < 0.0:
            top = np.sqrt(p / k)
            if s0 < top < s2 and p / top + q + k * top > tan:
                tan, at = p / top + q + k * top, top
    return tan, at


@njit(cache=True, nogil=True)
def horizon(ground, east, north, up, sin_a, cos_a, start_m, end_m, hint_m):
    """tan of the horizon, the distance it stands at, and the distance at which the maps end (1e9: not reached).

    Ground nearer than `start_m` or farther than `end_m` is left out. `hint_m` says about where the horizon may stand
    (0: a row of places is tried): a first sight line over the ground there lets most blocks be stepped over.
    """
    grid, heights, posts, tops, _, _, blocks, levels, _, post_m, moon, highest = ground
    tan, at, s, level, edge = LOWEST_TAN, start_m, start_m, 0, FAR_M
    guess, z = hint_m, up
    if hint_m <= 0.0:
        guess = max(start_m, FIRST_GUESS_M)
    while start_m < guess < min(end_m, LAST_GUESS_M if hint_m <= 0.0 else FAR_M):
        before = z
        z = _surface(grid, posts, heights, moon, east + guess * sin_a, north + guess * cos_a, z)
        if z != before and z - up > tan * guess:  # no change: the maps do not reach there
            tan, at = (z - up) / guess, guess
        guess = guess * GUESS_RATIO if hint_m <= 0.0 else FAR_M
    if tan == LOWEST_TAN and start_m > 0.0:  # a sight line straight down would not get far
        before = z
        z = _surface(grid, posts, heights, moon, east + start_m * sin_a, north + start_m * cos_a, z)
        if z != before:
            tan, at = (z - up) / start_m, start_m
    known_s, known_z = -1.0, up  # the last place where the ground's height was worked out
    running = True
    while running and s < end_m:
        e, n = east + s * sin_a, north + s * cos_a
        z = moon + up + tan * s  # of the sight line, from the Moon's centre
        m, column, row = _locate(grid, posts, e, n, z)
        r = np.sqrt(e * e + n * n + z * z)
        climb = (e * sin_a + n * cos_a + z * tan) / r
        if m < 0:
            edge = s
            running = False
        elif climb >= 0.0 and r - SPHERE_M >= highest:
            running = False
        else:
            step = post_m[m]
            rise = max(tan, -1.0)
            column2, row2 = _grid(grid, m, e + step * sin_a, n + step * cos_a, z + step * rise)
            d_column, d_row = (column2 - column) / step, (row2 - row) / step
            level = min(level, levels[m] - 1)
            descending = True
            length = 0.0
            while descending:
                length = _exit(column, row, d_column, d_row, level)
                lowest = r - SPHERE_M + min(climb * length, 0.0)
                if lowest >= tops[_block(blocks, m, level, column, row)]:
                    s += length
                    level += 2
                    descending = False
                elif level == 0:
                    descending = False
                level -= 1
            if level < 0:
                level = 0
                stop = s + length
                a = known_z
                if known_s != s:
                    a = _surface(grid, posts, heights, moon, e, n, z - moon)
                b = _surface(grid, posts, heights, moon, east + stop * sin_a, north + stop * cos_a, a)
                half = s + 0.5 * length
                c = _surface(grid, posts, heights, moon, east + half * sin_a, north + half * cos_a, 0.5 * (a + b))
                tan, at = _best_in_step(tan, at, s, stop, a - up, c - up, b - up)
                known_s, known_z, s = stop, b, stop
    return tan, at, edge


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
    middle = _surface(grid, posts, heights, moon, east, north, 0.0)
    middle = _surface(grid, posts, heights, moon, east, north, middle)
    low, high = middle, middle
    map0, cell0, alike = -2, -1, True
    wide_column, wide_row, column0, row0 = 0.0, 0.0, 0.0, 0.0
    slope_e, slope_n = 0.0, 0.0
    for corner in range(4 * (lean and half > 0.0)):
        to_e, to_n = 2 * (corner & 1) - 1, corner - (corner & 1) - 1
        z = _surface(grid, posts, heights, moon, east + half * to_e, north + half * to_n, middle)
        slope_e += to_e * z / (4 * half)
        slope_n += to_n * z / (4 * half)
    for corner in range(4):
        e = east + half * (2 * (corner & 1) - 1)
        n = north + half * (corner - (corner & 1) - 1)
        z = _surface(grid, posts, heights, moon, e, n, middle)
        m, column, row = _locate(grid, posts, e, n, moon + z)
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
            z = _surface(grid, posts, heights, moon, e, n, middle) - slope_e * (e - east) - slope_n * (n - north)
            low, high = min(low, z), max(high, z)
        m, column, row = _locate(grid, posts, east, north, moon + middle)
        slack = 2 * half
        if m >= 0:
            level = _level_of(levels, m, post_m, moon, 1.5 * half, east, north)
            at = _block(blocks, m, level, column, row)
            a, b = 0.0, 0.0
            for turn in range(4):  # steepest to the four sides
                to_e, to_n = post_m[m] * (turn == 0) - post_m[m] * (turn == 1), post_m[m] * (turn > 1) * (5 - 2 * turn)
                column2, row2 = _grid(grid, m, east + to_e, north + to_n, moon + middle)
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
            known_z = _surface(grid, posts, heights, moon, e, n, known_z)
            line = moon + known_z
        else:
            line = moon + low_up + low * (max(s - reach, 0.0) if low >= 0.0 else (abs(s) + reach) / cos_turn)
            line += along_rise * s - tilted * width
        m, column, row = _locate(grid, posts, e, n, line)
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
            column2, row2 = _grid(grid, m, e + step * sin_a, n + step * cos_a, line + rise * step)
            d_column, d_row = (column2 - column) / step, (row2 - row) / step
            least_level = _level_of(levels, m, post_m, moon, width, e, n)
            near = whole and s < 6.0 * reach and not probing
            level = least_level if near or probing else min(max(level, least_level), levels[m] - 1)
            descending, skipped = not (near or probing), False
            while descending:
                length = _exit(column, row, d_column, d_row, level)
                if floor + min(climb * length, 0.0) >= wide_tops[_block(blocks, m, level, column, row)]:
                    s += length
                    level += 1
                    descending, skipped = False, True
                elif level <= least_level:
                    descending = False
                else:
                    level -= 1
            slack, rise_aside, bend, stop = 0.0, 0.0, np.sqrt(e * e + n * n) / moon, s
            if not skipped:
                at = _block(blocks, m, least_level, column, row)
                length = _exit(column, row, d_column, d_row, 0)
                stop = s + length
                side_column, side_row = _grid(grid, m, e + step * cos_a, n - step * sin_a, line)
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
                    top_here = tops[_block(blocks, m, 0, column, row)] + slack
                    if floor + min(climb * length, 0.0) >= top_here:
                        s, skipped = stop, True
            if not skipped:
                half_s = s + 0.5 * length
                z0 = _surface(grid, posts, heights, moon, e, n, known_z)
                z2 = _surface(grid, posts, heights, moon, east + stop * sin_a, north + stop * cos_a, z0)
                z1 = _surface(
                    grid, posts, heights, moon, east + half_s * sin_a, north + half_s * cos_a, 0.5 * (z0 + z2)
                )
                next_z = z2
                z0, z1, z2 = z0 - along_rise * s, z1 - along_rise * half_s, z2 - along_rise * stop
                over = slack + max(2 * z1 - z0 - z2, 0.0) / 8
                if min(z0, z1, z2) + slack > low_up and s > reach:
                    rest = slack - low_up
                    top, _ = _best_in_step(-FAR_M, 0.0, s - reach, stop - reach, z0 + rest, z1 + rest, z2 + rest)
                else:
                    top = max(
                        _most(z0 + over - low_up, s, reach, cos_turn),
                        _most(z1 + over - low_up, half_s, reach, cos_turn),
                        _most(z2 + over - low_up, stop, reach, cos_turn),
                    )
                rest = slack + high_up
                if min(z0, z1, z2) > rest and s > 0.0:
                    tan, at_s = _best_in_step(-FAR_M, 0.0, s + reach, stop + reach, z0 - rest, z1 - rest, z2 - rest)
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


@njit(cache=True, nogil=True)
def fill_cells(ground, centres, half, camera_height, sin_a, cos_a, turn, found):
    """Fill found (cells, azimuths, 11) with `bounds` of each cell and azimuth."""
    for k in range(len(centres)):
        middle, low, high = standing(ground, centres[k, 0], centres[k, 1], half)
        guess = 0.0
        for j in range(len(sin_a)):
            bounds(
                ground, centres[k, 0], centres[k, 1], middle + camera_height, low + camera_height,
                high + camera_height, 0.0, 0.0, half, sin_a[j], cos_a[j], turn, 0.0, FAR_M, guess, found[k, j],
            )  # fmt: skip
            guess = found[k, j, 4]


@njit(cache=True, nogil=True)
def surfaces(ground, points, up):
    """Fill up (n,) with the height in enu of the ground at points (n, 2)."""
    grid, heights, posts, _, _, _, _, _, _, _, moon, _ = ground
    for k in range(len(up)):
        z = _surface(grid, posts, heights, moon, points[k, 0], points[k, 1], 0.0)
        up[k] = _surface(grid, posts, heights, moon, points[k, 0], points[k, 1], z)
