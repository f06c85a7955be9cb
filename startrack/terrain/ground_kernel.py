"""Slopes and heights of height maps over blocks of cells, bands and boxes, compiled with numba.

Slopes are those of the pyramid's blocks, or taken from the cells that a band touches.
"""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
import numpy as np

from startrack.core.kernels import njit
from startrack.terrain.block_kernel import block_at
from startrack.terrain.horizon_kernel import locate, map_cell, surface

SHIFT_HEIGHT_M = 1000.0  # height of a sight line above the ground that its place on the map allows for
MAX_TOUCHED = 25  # cells of a part
TOUCH_MARGIN = 0.02  # of a cell: more than maps bend over a step
BOX_STEPS = 8  # steps along each side of a box


@njit(cache=True, inline="always")
def steepness(slopes, at, unit, d_column, d_row):
    """Most rise per metre in a block and its neighbours, going (d_column, d_row) per metre."""
    a, b = abs(d_column), abs(d_row)
    if a >= b:
        straight = slopes[at, 4] if d_column > 0.0 else slopes[at, 0]
    else:
        straight = slopes[at, 5] if d_row > 0.0 else slopes[at, 1]
    if d_column * d_row >= 0.0:
        slanted = slopes[at, 6] if d_row + d_column > 0.0 else slopes[at, 2]
    else:
        slanted = slopes[at, 7] if d_row > 0.0 else slopes[at, 3]
    return unit * (abs(a - b) * straight + min(a, b) * slanted)


@njit(cache=True, inline="always")
def level_of(levels, m, post_m, radius, width, e, n):
    """Lowest level whose blocks' neighbours reach `width` to the side."""
    shift = SHIFT_HEIGHT_M * np.sqrt(e * e + n * n) / radius  # how far 1 km of height moves a place on the map
    across = (1.05 * width + shift) / post_m[m] + 1e-6
    level = 0
    while (1 << level) < across and level < levels[m] - 1:
        level += 1
    return level


@njit(cache=True, inner=True)
def slope_range(heights, posts, m, column, row, d_column, d_row, begin, end, to_column, to_row, width):
    """Least and most rise per metre to the side in a band; (1, -1) where it leaves the map or touches many cells.

    The band reaches `width` to each side (`to_column`, `to_row` per metre) of the segment that begins and ends at these
    distances from (column, row) in the direction (d_column, d_row) per metre. The rise in a bilinear cell is linear in
    column and row: its extremes are at the ends of the part of the segment whose band touches the cell.
    """
    columns, rows = posts[m, 2], posts[m, 1]
    side_column, side_row = width * abs(to_column) + TOUCH_MARGIN, width * abs(to_row) + TOUCH_MARGIN
    j0 = int(np.floor(column + min(d_column * begin, d_column * end) - side_column))
    j1 = int(np.floor(column + max(d_column * begin, d_column * end) + side_column))
    i0 = int(np.floor(row + min(d_row * begin, d_row * end) - side_row))
    i1 = int(np.floor(row + max(d_row * begin, d_row * end) + side_row))
    least, most = 1.0, -1.0
    if j0 >= 0 and i0 >= 0 and j1 < columns - 1 and i1 < rows - 1 and (j1 - j0 + 1) * (i1 - i0 + 1) <= MAX_TOUCHED:
        least, most = np.inf, -np.inf
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                x, y = column - j, row - i
                first, last = begin, end
                if abs(d_column) > 1e-12:
                    a, b = (-side_column - x) / d_column, (1 + side_column - x) / d_column
                    first, last = max(first, min(a, b)), min(last, max(a, b))
                if abs(d_row) > 1e-12:
                    a, b = (-side_row - y) / d_row, (1 + side_row - y) / d_row
                    first, last = max(first, min(a, b)), min(last, max(a, b))
                if first <= last:
                    at = posts[m, 0] + i * columns + j
                    corner, across, down = heights[at], heights[at + 1], heights[at + columns]
                    twist = corner - across - down + heights[at + columns + 1]
                    straight = to_column * (across - corner + twist * y) + to_row * (down - corner + twist * x)
                    along = twist * (to_column * d_row + to_row * d_column)
                    aside = 2 * abs(twist * to_column * to_row) * width + abs(twist) * TOUCH_MARGIN * (
                        abs(to_column) + abs(to_row)
                    )
                    least = min(least, straight + min(along * first, along * last) - aside)
                    most = max(most, straight + max(along * first, along * last) + aside)
    return least, most


@njit(cache=True, inner=True)
def box_height_bounds(ground, east, north, half, tilted):
    """Height in enu of the ground in the middle of a box, the lowest and highest anywhere in it, and two slopes.

    With `tilted` heights are relative to the plane through the middle of the box that fits the corners, which rises by
    the two slopes to the east and north. Otherwise the slopes are zero.
    """
    grid, heights, posts, _, _, slopes, blocks, levels, slope_unit, post_m, radius, _, _ = ground
    middle = surface(grid, posts, heights, radius, east, north, 0.0)
    middle = surface(grid, posts, heights, radius, east, north, middle)
    low, high = middle, middle
    map0, cell0, alike = -2, -1, True
    wide_column, wide_row, column0, row0 = 0.0, 0.0, 0.0, 0.0
    slope_e, slope_n = 0.0, 0.0
    for corner in range(4 * (tilted and half > 0.0)):
        to_e, to_n = 2 * (corner & 1) - 1, corner - (corner & 1) - 1
        z = surface(grid, posts, heights, radius, east + half * to_e, north + half * to_n, middle)
        slope_e += to_e * z / (4 * half)
        slope_n += to_n * z / (4 * half)
    for corner in range(4):
        e = east + half * (2 * (corner & 1) - 1)
        n = north + half * (corner - (corner & 1) - 1)
        z = surface(grid, posts, heights, radius, e, n, middle)
        m, column, row = locate(grid, posts, e, n, radius + z)
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
        slack = twist * wide_column * wide_row / 2 + half * half / radius
    else:
        step = 2 * half / BOX_STEPS
        for k in range((BOX_STEPS + 1) * (BOX_STEPS + 1)):
            i = k // (BOX_STEPS + 1)
            e, n = east - half + step * i, north - half + step * (k - i * (BOX_STEPS + 1))
            z = surface(grid, posts, heights, radius, e, n, middle) - slope_e * (e - east) - slope_n * (n - north)
            low, high = min(low, z), max(high, z)
        m, column, row = locate(grid, posts, east, north, radius + middle)
        slack = 2 * half
        if m >= 0:
            level = level_of(levels, m, post_m, radius, 1.5 * half, east, north)
            at = block_at(blocks, m, level, column, row)
            a, b = 0.0, 0.0
            for turn in range(4):  # steepest to the four sides
                to_e, to_n = post_m[m] * (turn == 0) - post_m[m] * (turn == 1), post_m[m] * (turn > 1) * (5 - 2 * turn)
                column2, row2 = map_cell(grid, m, east + to_e, north + to_n, radius + middle)
                rise = steepness(slopes, at, slope_unit[m], (column2 - column) / post_m[m], (row2 - row) / post_m[m])
                if turn < 2:
                    a = max(a, abs(rise - slope_e * (1 - 2 * turn)) + 0.03 * abs(rise))
                else:
                    b = max(b, abs(rise - slope_n * (5 - 2 * turn)) + 0.03 * abs(rise))
            slack = (a + b) * step / 2 + half * half / radius + half * (abs(east) + abs(north)) / radius
    return middle, low - slack, high + slack, slope_e, slope_n
