"""Bounds from the table of horizons, compiled with numba."""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
import numpy as np

from startrack.core.kernels import njit
from startrack.terrain.block_kernel import FAR_M
from startrack.terrain.bounds_kernel import bounds
from startrack.terrain.ground_kernel import box_height_bounds
from startrack.terrain.horizon_kernel import horizon, surfaces
from startrack.terrain.horizon_table import (
    ANGLE_STEP_RAD,
    AZIMUTH_BINS,
    DISTANCE_STEP_M,
    FARTHEST,
    NOT_KNOWN_M,
    RISE_STEP,
)

BIN_RAD = 2 * np.pi / AZIMUTH_BINS
MIDDLES_RAD = (np.arange(AZIMUTH_BINS) + 0.5) * BIN_RAD
SINES, COSINES = np.sin(MIDDLES_RAD), np.cos(MIDDLES_RAD)
TOUCHING = 1e-9  # of a cell or a bin: what only touches it does not count


@njit(cache=True, inline="always")
def _bounds_by_line(v, tangents, along, aside, wide, low_up, high_up, cell_half):
    """Bounds of tan H, seen from `along` -+ `wide` along the ray from the cell's middle, and so far aside."""
    below, above = tangents[v[0]], tangents[v[1]]
    cos_turn = np.cos(BIN_RAD / 2)
    height = np.int64(v[6])
    height = height - 65_536 if height > 32_767 else height
    near, far = v[2] * DISTANCE_STEP_M - along - wide, v[3] * DISTANCE_STEP_M - along - wide
    if v[3] < FARTHEST and v[2] > 0 and near > 0.0:  # 0: such ground stands behind the cell's middle, too
        tan = tangents[v[5]]
        rise, tan_turn = v[9] * RISE_STEP, np.tan(BIN_RAD / 2)
        width = aside + wide + 2 * cell_half * tan_turn
        top0 = height + tan * v[2] * DISTANCE_STEP_M - low_up + rise * (width + v[2] * DISTANCE_STEP_M * tan_turn)
        top1 = height + tan * v[3] * DISTANCE_STEP_M - low_up + rise * (width + v[3] * DISTANCE_STEP_M * tan_turn)
        top = max(
            top0 / near if top0 > 0.0 else top0 * cos_turn / (near + 2 * wide),
            top1 / far if top1 > 0.0 else top1 * cos_turn / (far + 2 * wide),
        )
        above = min(above, top)
    point = np.int64(v[8])
    point = point - 65_536 if point > 32_767 else point
    s = v[7] * DISTANCE_STEP_M
    if point > NOT_KNOWN_M:
        # The point reckons with the whole cell's width aside, of which the box takes up a part.
        over = point - high_up + v[10] * RISE_STEP * max(cell_half - aside - wide, 0.0)
        if over > 0.0:
            below = max(below, over * cos_turn / (s + DISTANCE_STEP_M - along + wide))
        elif s - along - wide > 0.0:
            below = max(below, over / (s - along - wide))
    return below, max(above, below)


@njit(cache=True, inner=True)
def look_up(values, across, reach, east, north, azimuth, out):
    """Between which distances the horizon stands from a point, and about where [m]; (0, 1e9, 0) off the table."""
    side = 2 * reach / across
    i, j = int(np.floor((east + reach) / side)), int(np.floor((north + reach) / side))
    out[0], out[1], out[2] = 0.0, 1e9, 0.0
    if 0 <= i < across and 0 <= j < across:
        b = int(np.floor(azimuth / BIN_RAD)) % AZIMUTH_BINS
        v = values[i * across + j, b]
        if v[2] <= v[3]:
            middle = (b + 0.5) * BIN_RAD
            along = (east - (i + 0.5) * side + reach) * np.sin(middle)
            along += (north - (j + 0.5) * side + reach) * np.cos(middle)
            margin = 0.01 * side + DISTANCE_STEP_M
            out[0] = max(v[2] * DISTANCE_STEP_M - along - margin, 0.0) if v[2] > 0 else 0.0
            if v[3] < FARTHEST:
                # A ray turned within the bin needs up to 1 / cos of the turn more to get as far.
                out[1] = max((v[3] * DISTANCE_STEP_M - along) / np.cos(BIN_RAD / 2) + margin, 0.0)
            out[2] = max(v[4] * DISTANCE_STEP_M - along, 0.0)


@njit(cache=True)
def horizons(ground, values, across, reach, camera_height, is_own, points, azimuths, tan, at, edge):
    """Fill tan, at and edge (n,) with the horizon of each point at its azimuth; across = 0: there is no table.

    From a table that is not the map's own (`is_own`), but of a similar one, only first sight lines are taken.
    """
    near = np.array([0.0, FAR_M, 0.0])
    up = 0.0
    one = np.empty(1)
    for k in range(len(tan)):
        if k == 0 or points[k, 0] != points[k - 1, 0] or points[k, 1] != points[k - 1, 1]:
            surfaces(ground, points[k : k + 1], one)
            up = one[0] + camera_height
        if across > 0:
            look_up(values, across, reach, points[k, 0], points[k, 1], azimuths[k], near)
            if not is_own:
                near[0], near[1] = 0.0, FAR_M
        tan[k], at[k], edge[k] = horizon(
            ground, points[k, 0], points[k, 1], up, np.sin(azimuths[k]), np.cos(azimuths[k]), near[0], near[1], near[2]
        )


@njit(cache=True)
def box_bounds(ground, values, across, reach, camera_height, centres, half, azimuths, turn, low, high):
    """Fill low and high (n,) [rad] with bounds over small boxes and narrow azimuths, traced anew."""
    near, around, found = np.empty(3), np.empty(3), np.empty(11)
    middle, lowest, highest, slope_e, slope_n = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(len(low)):
        if k == 0 or centres[k, 0] != centres[k - 1, 0] or centres[k, 1] != centres[k - 1, 1] or half[k] != half[k - 1]:
            middle, lowest, highest, slope_e, slope_n = box_height_bounds(
                ground, centres[k, 0], centres[k, 1], half[k], True
            )
        near[0], near[1], near[2] = 0.0, FAR_M, 0.0
        if across > 0:
            near[0], near[1] = FAR_M, 0.0
            for c in range(4):
                east = centres[k, 0] + half[k] * (2 * (c & 1) - 1)
                north = centres[k, 1] + half[k] * (c - (c & 1) - 1)
                for side in range(1 if turn[k] == 0.0 else 2):
                    look_up(values, across, reach, east, north, azimuths[k] + turn[k] * (2 * side - 1), around)
                    near[0], near[1] = min(near[0], around[0]), max(near[1], around[1])
            wide = 2.0 * half[k]
            near[0] = max(near[0] - wide, 0.0)
            near[1] += wide
            near[2] = around[2]
        bounds(
            ground, centres[k, 0], centres[k, 1], camera_height, middle + camera_height, lowest + camera_height,
            highest + camera_height, slope_e, slope_n, half[k], np.sin(azimuths[k]), np.cos(azimuths[k]), turn[k],
            near[0], near[1], near[2], True, found,
        )  # fmt: skip
        low[k], high[k] = np.arctan(found[0]), np.arctan(found[1])


@njit(cache=True)
def sector_bounds(
    ground, values, lows, highs, across, reach, camera_height, tangents, azimuths, turn, centres, half, low, high
):
    """Fill low and high (n, m) [rad] with bounds over boxes at centres (n, 2), and azimuths (n, m) within `turn`.

    Azimuths and turn (1, m) are those of all boxes. lows, highs: of the level that fits. Boxes smaller than a cell take
    the lines and points of the cells they touch, larger ones the bounds of the level's blocks.
    """
    n = lows.shape[0]
    side = 2 * reach / n
    low_up, high_up = 0.0, 0.0
    for k in range(len(low)):
        east, north, wide = centres[k, 0], centres[k, 1], half[k]
        fine = n == across and wide < 0.5 * side
        new = k == 0 or east != centres[k - 1, 0] or north != centres[k - 1, 1] or wide != half[k - 1]
        if fine and new:
            _, low_up, high_up, _, _ = box_height_bounds(ground, east, north, wide, False)
            low_up, high_up = low_up + camera_height, high_up + camera_height
        i0 = min(max(int(np.floor((east - wide + reach) / side + TOUCHING)), 0), n - 1)
        i1 = min(max(int(np.ceil((east + wide + reach) / side - TOUCHING)) - 1, i0), n - 1)
        j0 = min(max(int(np.floor((north - wide + reach) / side + TOUCHING)), 0), n - 1)
        j1 = min(max(int(np.ceil((north + wide + reach) / side - TOUCHING)) - 1, j0), n - 1)
        row = min(k, len(azimuths) - 1)
        for m in range(low.shape[1]):
            first = int(np.floor((azimuths[row, m] - turn[row, m]) / BIN_RAD + TOUCHING))
            last = max(int(np.ceil((azimuths[row, m] + turn[row, m]) / BIN_RAD - TOUCHING)) - 1, first)
            last = min(last, first + AZIMUTH_BINS - 1)
            least, most = FARTHEST, 0
            tan_low, tan_high = np.inf, -np.inf
            for i in range(i0, i1 + 1):
                for j in range(j0, j1 + 1):
                    for bin_number in range(first, last + 1):
                        b = bin_number % AZIMUTH_BINS
                        if fine:
                            from_east, from_north = east - (i + 0.5) * side + reach, north - (j + 0.5) * side + reach
                            below, above = _bounds_by_line(
                                values[i * across + j, b], tangents, from_east * SINES[b] + from_north * COSINES[b],
                                abs(from_east * COSINES[b] - from_north * SINES[b]),
                                wide * (abs(SINES[b]) + abs(COSINES[b])), low_up, high_up, 0.5 * side,
                            )  # fmt: skip
                            tan_low, tan_high = min(tan_low, below), max(tan_high, above)
                        else:
                            least, most = min(least, lows[i, j, b]), max(most, highs[i, j, b])
            if fine:
                low[k, m], high[k, m] = np.arctan(tan_low), np.arctan(tan_high)
            else:
                low[k, m], high[k, m] = least * ANGLE_STEP_RAD - np.pi / 2, most * ANGLE_STEP_RAD - np.pi / 2


@njit(cache=True)
def fill_cells(ground, centres, half, camera_height, sin_a, cos_a, turn, found):
    """Fill found (cells, azimuths, 11) with `bounds` of each cell and azimuth."""
    for k in range(len(centres)):
        middle, low, high, _, _ = box_height_bounds(ground, centres[k, 0], centres[k, 1], half, False)
        guess = 0.0
        for j in range(len(sin_a)):
            bounds(
                ground, centres[k, 0], centres[k, 1], camera_height, middle + camera_height, low + camera_height,
                high + camera_height, 0.0, 0.0, half, sin_a[j], cos_a[j], turn, 0.0, FAR_M, guess, False, found[k, j],
            )  # fmt: skip
            guess = found[k, j, 4]
