"""Bounds of the ground's height over a box, compiled with numba."""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
from startrack.core.kernels import njit
from startrack.terrain.horizon_kernel import block_at, locate, on_map, surface
from startrack.terrain.slope_kernel import level_of, steepness

ACROSS = 8  # steps along each side of a box


@njit(cache=True, nogil=True)
def box_height_bounds(ground, east, north, half, tilted):
    """Height in enu of the ground in the middle of a box, the lowest and highest anywhere in it, and two slopes.

    With `tilted` heights are relative to the plane through the middle of the box that fits the corners, which rises by
    the two slopes to the east and north. Otherwise the slopes are zero.
    """
    grid, heights, posts, _, _, slopes, blocks, levels, slope_unit, post_m, moon, _ = ground
    middle = surface(grid, posts, heights, moon, east, north, 0.0)
    middle = surface(grid, posts, heights, moon, east, north, middle)
    low, high = middle, middle
    map0, cell0, alike = -2, -1, True
    wide_column, wide_row, column0, row0 = 0.0, 0.0, 0.0, 0.0
    slope_e, slope_n = 0.0, 0.0
    for corner in range(4 * (tilted and half > 0.0)):
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
            level = level_of(levels, m, post_m, moon, 1.5 * half, east, north)
            at = block_at(blocks, m, level, column, row)
            a, b = 0.0, 0.0
            for turn in range(4):  # steepest to the four sides
                to_e, to_n = post_m[m] * (turn == 0) - post_m[m] * (turn == 1), post_m[m] * (turn > 1) * (5 - 2 * turn)
                column2, row2 = on_map(grid, m, east + to_e, north + to_n, moon + middle)
                rise = steepness(slopes, at, slope_unit[m], (column2 - column) / post_m[m], (row2 - row) / post_m[m])
                if turn < 2:
                    a = max(a, abs(rise - slope_e * (1 - 2 * turn)) + 0.03 * abs(rise))
                else:
                    b = max(b, abs(rise - slope_n * (5 - 2 * turn)) + 0.03 * abs(rise))
            slack = (a + b) * step / 2 + half * half / moon + half * (abs(east) + abs(north)) / moon
    return middle, low - slack, high + slack, slope_e, slope_n
