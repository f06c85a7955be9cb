"""Look-ups in the table of horizons with numpy alone, as `table_compiled.py` has them."""

from __future__ import annotations

import numpy as np

from startrack.terrain.horizon_table import (
    ANGLE_STEP_RAD,
    BINS,
    DISTANCE_STEP_M,
    FARTHEST,
    NOT_KNOWN_M,
    RISE_STEP,
    HorizonTable,
)
from startrack.types import Array, Bools, Ints

BIN_RAD = 2 * np.pi / BINS
EDGE = 1e-9


def look_up(table: HorizonTable | None, points: Array, azimuths: Array) -> tuple[Array, Array, Array]:
    """Between which distances (n,) the horizon stands from points, and about where [m]; 0, 1e9, 0 off the table."""
    start, end, hint = np.zeros(len(azimuths)), np.full(len(azimuths), 1e9), np.zeros(len(azimuths))
    if table is None:
        return start, end, hint
    n, side = table.square.across, 2 * table.square.half_m
    i, j = (np.floor((points[:, k] + table.square.reach_m) / side).astype(np.int64) for k in (0, 1))
    b = np.floor(azimuths / BIN_RAD).astype(np.int64) % BINS
    on = np.flatnonzero((i >= 0) & (i < n) & (j >= 0) & (j < n))
    v = table.values[i[on] * n + j[on], b[on]].astype(np.float64)
    known = v[:, 2] <= v[:, 3]
    on, v = on[known], v[known]
    along = _along(table, i[on], j[on], b[on], points[on])
    margin = 0.01 * side + DISTANCE_STEP_M
    start[on] = np.where(v[:, 2] > 0, np.maximum(v[:, 2] * DISTANCE_STEP_M - along - margin, 0.0), 0.0)
    last = np.maximum((v[:, 3] * DISTANCE_STEP_M - along) / np.cos(BIN_RAD / 2) + margin, 0.0)
    end[on] = np.where(v[:, 3] < FARTHEST, last, 1e9)
    hint[on] = np.maximum(v[:, 4] * DISTANCE_STEP_M - along, 0.0)
    return start, end, hint


def look_up_boxes(
    table: HorizonTable, centres: Array, half: Array, azimuths: Array, turn: Array
) -> tuple[Array, Array]:
    """Between which distances (n,) of the boxes' middles the horizon of all their places stands."""
    start, end = np.full(len(half), 1e9), np.zeros(len(half))
    for corner in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        for side in (-1, 1):
            first, last, _ = look_up(table, centres + half[:, None] * np.array(corner), azimuths + side * turn)
            start, end = np.minimum(start, first), np.maximum(end, last)
    return np.maximum(start - 2 * half, 0.0), end + 2 * half


def sector_bounds(
    table: HorizonTable, level: int, centres: Array, half: Array, low_up: Array, high_up: Array, azimuths: Array,
    turn: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """Bounds (n,) of the elevation over boxes and the azimuths within `turn`."""
    lows, highs = table.pyramid[level]
    n, reach = lows.shape[0], table.square.reach_m
    side = 2 * reach / n
    fine = level == 0 and bool(half[0] < 0.5 * side)
    low_cell = np.clip(np.floor((centres - half[:, None] + reach) / side + EDGE).astype(np.int64), 0, n - 1)
    high_cell = np.ceil((centres + half[:, None] + reach) / side - EDGE).astype(np.int64) - 1
    high_cell = np.maximum(np.minimum(high_cell, n - 1), low_cell)
    first = np.floor((azimuths - turn) / BIN_RAD + EDGE).astype(np.int64)
    last = np.maximum(np.ceil((azimuths + turn) / BIN_RAD - EDGE).astype(np.int64) - 1, first)
    last = np.minimum(last, first + BINS - 1)
    low, high = np.full(len(half), np.inf), np.full(len(half), -np.inf)
    wide = int((high_cell - low_cell).max(initial=0)) + 1
    for di in range(wide):
        for dj in range(wide):
            i, j = np.minimum(low_cell[:, 0] + di, high_cell[:, 0]), np.minimum(low_cell[:, 1] + dj, high_cell[:, 1])
            for db in range(int((last - first).max(initial=0)) + 1):
                b = np.minimum(first + db, last) % BINS
                if fine:
                    below, above = _of_lines(table, i, j, b, centres, half, low_up, high_up)
                else:
                    below, above = (a[i, j, b] * ANGLE_STEP_RAD - np.pi / 2 for a in (lows, highs))
                low, high = np.minimum(low, below), np.maximum(high, above)
    return low, high


def _along(table: HorizonTable, i: Ints, j: Ints, b: Ints, points: Array, aside: bool = False) -> Array:
    """How far points (n,) lie along their bins' azimuths from the cells' middles, or to the side."""
    side, reach = 2 * table.square.half_m, table.square.reach_m
    middle = (b + 0.5) * BIN_RAD
    east, north = points[:, 0] - (i + 0.5) * side + reach, points[:, 1] - (j + 0.5) * side + reach
    if aside:
        return np.asarray(east * np.cos(middle) - north * np.sin(middle))
    return np.asarray(east * np.sin(middle) + north * np.cos(middle))


def _of_lines(
    table: HorizonTable, i: Ints, j: Ints, b: Ints, centres: Array, half: Array, low_up: Array, high_up: Array
) -> tuple[Array, Array]:
    """Bounds (n,) from a cell's line above and point below the ground, for boxes inside it."""
    v = table.values[i * table.square.across + j, b]
    middle, cos_turn = (b + 0.5) * BIN_RAD, np.cos(BIN_RAD / 2)
    along = _along(table, i, j, b, centres)
    wide = half * (np.abs(np.sin(middle)) + np.abs(np.cos(middle)))
    below, above = (v[:, k] * ANGLE_STEP_RAD - np.pi / 2 for k in (0, 1))
    height = v[:, 6].view(np.int16).astype(np.float64)
    tan = np.tan(v[:, 5] * ANGLE_STEP_RAD - np.pi / 2)
    s = [v[:, k].astype(np.float64) * DISTANCE_STEP_M for k in (2, 3)]
    aside, tan_turn = np.abs(_along(table, i, j, b, centres, aside=True)), np.tan(BIN_RAD / 2)
    width = aside + wide + 2 * table.square.half_m * tan_turn
    height = height + v[:, 9] * RISE_STEP * width
    tan = tan + v[:, 9] * RISE_STEP * tan_turn
    top = np.maximum(*(_seen(height + tan * at - low_up, at - along - wide, at - along + wide, cos_turn) for at in s))
    usable: Bools = (v[:, 3] < FARTHEST) & (s[0] - along - wide > 0)
    above = np.where(usable, np.minimum(above, np.arctan(top)), above)
    point, at = v[:, 8].view(np.int16).astype(np.float64), v[:, 7].astype(np.float64) * DISTANCE_STEP_M
    over = point - high_up + v[:, 10] * RISE_STEP * np.maximum(table.square.half_m - aside - wide, 0.0)
    farthest = at + DISTANCE_STEP_M - along + wide
    tan_low = np.where(
        over > 0, over * cos_turn / np.maximum(farthest, 1.0), over / np.maximum(at - along - wide, 1e-9)
    )
    known = (point > NOT_KNOWN_M) & ((over > 0) | (at - along - wide > 0))
    below = np.where(known, np.maximum(below, np.arctan(tan_low)), below)
    return below, np.maximum(above, below)


def _seen(over: Array, nearest: Array, farthest: Array, cos_turn: float) -> Array:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(over > 0, over / np.maximum(nearest, 1e-9), over * cos_turn / farthest))
