"""Blocks of the cells of height maps along a ray, compiled with numba: those below a sight line are stepped over."""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
from startrack.core.kernels import njit

NUDGE_M = 0.05  # past a grid line; a kink is missed by that much at most
FAR_M = 1e9


@njit(cache=True, inline="always")
def exit_of(column, row, d_column, d_row, level):
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


@njit(cache=True, inline="always")
def block_at(blocks, m, level, column, row):
    return blocks[m, level, 0] + (int(row) >> level) * blocks[m, level, 2] + (int(column) >> level)


@njit(cache=True, inline="always")
def step_over_blocks(tops, blocks, m, level, column, row, d_column, d_row, height, climb, raised):
    """Whether ground `raised` [m] above the map is below a sight line over a block; the next level, and the way out.

    Blocks are tried from `level` down. The sight line is at a `height` and climbs by `climb` per metre. The way [m] is
    that to the edge of the block that is stepped over, else of the cell.
    """
    is_over, length = False, 0.0
    while not is_over and level >= 0:
        length = exit_of(column, row, d_column, d_row, level)
        is_over = height + min(climb * length, 0.0) >= tops[block_at(blocks, m, level, column, row)] + raised
        level += 1 if is_over else -1
    return is_over, max(level, 0), length
