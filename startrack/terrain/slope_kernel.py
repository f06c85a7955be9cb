"""Slopes of height maps, compiled with numba: of blocks of cells from the pyramid, and of the cells in a band."""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
import numpy as np

from startrack.core.kernels import njit

SHIFT_HEIGHT_M = 1000.0  # height of a sight line above the ground that its place on the map allows for
MAX_TOUCHED = 25  # cells of a part
TOUCH_MARGIN = 0.02  # of a cell: more than maps bend over a step


@njit(cache=True, nogil=True, inline="always")
def steepness(slopes, at, unit, d_column, d_row):
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
def level_of(levels, m, post_m, moon, width, e, n):
    """Lowest level whose blocks' neighbours reach `width` to the side."""
    shift = SHIFT_HEIGHT_M * np.sqrt(e * e + n * n) / moon  # how far 1 km of height moves a place on the map
    across = (1.05 * width + shift) / post_m[m] + 1e-6
    level = 0
    while (1 << level) < across and level < levels[m] - 1:
        level += 1
    return level


@njit(cache=True, nogil=True)
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
