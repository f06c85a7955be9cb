"""Horizons traced ray by ray, or interpolated between traced ones, compiled with numba.

A ray leaves the camera's place at an azimuth; s is the horizontal distance along it in enu. The horizon is the largest
tan = (z(s) - z(camera)) / s over the ground's heights z(s) in enu. The ray goes from crossing to crossing of the map's
grid lines; blocks of cells that lie wholly below the sight line to the best horizon so far are stepped over at once.

Air bends the line of sight: z(s) counts with `sag` s^2 more, half the line's curvature times the squared distance. The
sight line then falls below a straight one by as much. It still bends less than the sphere: seen from the sphere's
centre it is convex, so that its tangent lies below it. On the Moon `sag` is 0.

Helpers have one exit and take plain arrays: numba then needs no reference counts, which cost ten times the arithmetic.
"""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
import numpy as np

from startrack.core.kernels import njit, overload
from startrack.terrain.block_kernel import FAR_M, step_over_blocks

FIRST_COEFFICIENT = 3  # of a map of the Earth in its numbers
LOWEST_TAN = -50.0
FIXED_POINT_ROUNDS = 3
SETTLED_M = 0.5  # between rounds, each of which leaves a few per cent of the last one's change
FIRST_GUESS_M, LAST_GUESS_M, GUESS_RATIO = 300.0, 50_000.0, 1.12
STRAIGHT_M = 150.0  # over which a ray crosses a map in one direction: it climbs 60 m at most and bends by a centimetre


def _cell_by_projection(grid, m, east, north, up):
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


def _cell_by_polynomials(grid, m, east, north, up):
    column, row = -1.0, -1.0
    x, y = (east / up - grid[m, 1, 0]) * grid[m, 2, 0], (north / up - grid[m, 1, 1]) * grid[m, 2, 1]
    if up > 0.0 and abs(x) <= 1.0 and abs(y) <= 1.0:
        column, row, k = 0.0, 0.0, FIRST_COEFFICIENT
        for terms in range(1, int(grid[m, 0, 0]) + 2):  # Horner's rule in x, of polynomials in y
            a, b = 0.0, 0.0
            for _ in range(terms):
                a, b = a * y + grid[m, k, 0], b * y + grid[m, k, 1]
                k += 1
            column, row = column * x + a, row * x + b
    return column, row


def map_cell(grid, m, east, north, up):
    """(column, row) on map m of the direction of (east, north, up) from the sphere's centre.

    grid: `Raster.grid_numbers` of the maps. Off the Earth's maps (-1, -1) where their polynomials do not hold.
    """
    return _choose_map_cell(grid, m, east, north, up)(grid, m, east, north, up)


@overload(map_cell, jit_options={"forceinline": True, "error_model": "numpy"})
def _choose_map_cell(grid, m, east, north, up):
    """The function for a grid of its dimensions: kernels of the Moon's maps are compiled without the Earth's."""
    return _cell_by_projection if grid.ndim == 2 else _cell_by_polynomials


@njit(cache=True, inline="always")
def locate(grid, posts, east, north, up):
    """Finest map that reaches a place, and (column, row) there; map -1 where none does."""
    found, column, row = -1, 0.0, 0.0
    for m in range(grid.shape[0]):
        if found < 0:
            column, row = map_cell(grid, m, east, north, up)
            if 0.0 <= row < posts[m, 1] - 1 and 0.0 <= column < posts[m, 2] - 1:
                found = m
    return found, column, row


@njit(cache=True, inline="always")
def height_at(heights, posts, m, column, row):
    columns = posts[m, 2]
    i, j = int(row), int(column)
    down, right = row - i, column - j
    at = posts[m, 0] + i * columns + j
    top = heights[at] + right * (heights[at + 1] - heights[at])
    bottom = heights[at + columns] + right * (heights[at + columns + 1] - heights[at + columns])
    return top + down * (bottom - top)


@njit(cache=True, inner=True)
def surface_place(grid, posts, heights, radius, east, north, guess):
    """As `surface`, and where on the maps that is: the map, -1 where none reaches, column and row."""
    level2 = east * east + north * north
    up, before, rounds = guess, guess + 1.0, 0
    m, column, row = -1, 0.0, 0.0
    while rounds < FIXED_POINT_ROUNDS and abs(up - before) > SETTLED_M:
        rounds += 1
        before = up
        m, column, row = locate(grid, posts, east, north, radius + up)
        if m >= 0:
            r = radius + height_at(heights, posts, m, column, row)
            up = np.sqrt(r * r - level2) - radius
    return up, (m, column, row)


@njit(cache=True, inner=True)
def surface(grid, posts, heights, radius, east, north, guess):
    """Height in enu of the ground at (east, north); the guess where no map reaches."""
    return surface_place(grid, posts, heights, radius, east, north, guess)[0]


@njit(cache=True, inline="always")
def height_on_line(heights, posts, radius, place, d_column, d_row, east, north, sin_a, cos_a, s):
    """Height in enu of the ground at s along the ray from `place` (map, column, row), which is at (east, north).

    The ray goes d_column, d_row per metre there.
    """
    e, n = east + s * sin_a, north + s * cos_a
    column, row = place[1] + s * d_column, place[2] + s * d_row
    r = radius + height_at(heights, posts, place[0], column, row)
    return np.sqrt(r * r - e * e - n * n) - radius


@njit(cache=True, inline="always")
def best_in_step(tan, at, s0, s2, z0, z1, z2):
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


@njit(cache=True)
def horizon(ground, east, north, up, sin_a, cos_a, start_m, end_m, hint_m):
    """tan of the horizon, the distance it stands at, and the distance at which the maps end or have a void (1e9: not
    reached).

    Ground nearer than `start_m` or farther than `end_m` is left out. `hint_m` says about where the horizon may stand
    (0: a row of places is tried): a first sight line over the ground there lets most blocks be stepped over.
    """
    grid, heights, posts, tops, _, _, blocks, levels, _, post_m, radius, highest, sag = ground
    tan, at, s, level, edge = LOWEST_TAN, start_m, start_m, 0, FAR_M
    guess, z = hint_m, up
    if hint_m <= 0.0:
        guess = max(start_m, FIRST_GUESS_M)
    while start_m < guess < min(end_m, LAST_GUESS_M if hint_m <= 0.0 else FAR_M):
        before = z
        z = surface(grid, posts, heights, radius, east + guess * sin_a, north + guess * cos_a, z)
        z = before if np.isnan(z) else z  # a void
        above = z - up + sag * guess * guess
        if z != before and above > tan * guess:  # no change: the maps do not reach there
            tan, at = above / guess, guess
        guess = guess * GUESS_RATIO if hint_m <= 0.0 else FAR_M
    if tan == LOWEST_TAN and start_m > 0.0:  # a sight line straight down would not get far
        before = z
        z = surface(grid, posts, heights, radius, east + start_m * sin_a, north + start_m * cos_a, z)
        if z != before and not np.isnan(z):
            tan, at = (z - up) / start_m + sag * start_m, start_m
    known_s, known_z, known = -1.0, up, (-1, 0.0, 0.0)  # the last place where the ground's height was worked out
    d_column, d_row, straight_map, straight_to, straight_tan = 0.0, 0.0, -1, -1.0, tan
    running = True
    while running and s < end_m:
        e, n = east + s * sin_a, north + s * cos_a
        z = radius + up + tan * s - sag * s * s  # of the sight line, from the sphere's centre
        m, column, row = locate(grid, posts, e, n, z)
        r = np.sqrt(e * e + n * n + z * z)
        climb = (e * sin_a + n * cos_a + z * (tan - 2 * sag * s)) / r
        if m < 0:
            edge = s
            running = False
        elif climb >= 0.0 and r - radius >= highest:
            running = False
        else:
            if s > straight_to or m != straight_map or tan != straight_tan:
                step, rise = post_m[m], max(tan, -1.0)
                column2, row2 = map_cell(grid, m, e + step * sin_a, n + step * cos_a, z + step * rise)
                d_column, d_row = (column2 - column) / step, (row2 - row) / step
                straight_map, straight_tan, straight_to = m, tan, s + STRAIGHT_M
            level = min(level, levels[m] - 1)
            is_over, level, length = step_over_blocks(
                tops, blocks, m, level, column, row, d_column, d_row, r - radius, climb, 0.0
            )
            if is_over:
                s += length
            else:
                stop = s + length
                if known_s != s:
                    known_z, known = surface_place(grid, posts, heights, radius, e, n, z - radius)
                half = 0.5 * length
                there_z, there = surface_place(
                    grid, posts, heights, radius, e + length * sin_a, n + length * cos_a, known_z
                )
                if there[0] == known[0] and there[0] >= 0:
                    run_column, run_row = (there[1] - known[1]) / length, (there[2] - known[2]) / length
                    c = height_on_line(heights, posts, radius, known, run_column, run_row, e, n, sin_a, cos_a, half)
                else:
                    c = surface(
                        grid, posts, heights, radius, e + half * sin_a, n + half * cos_a, 0.5 * (known_z + there_z)
                    )
                if np.isnan(known_z + c + there_z):  # a void: as where the maps end
                    edge = s
                    running = False
                else:
                    middle = s + half
                    a, b, c = known_z + sag * s * s, there_z + sag * stop * stop, c + sag * middle * middle
                    tan, at = best_in_step(tan, at, s, stop, a - up, c - up, b - up)
                    known_s, known_z, known, s = stop, there_z, there, stop
    return tan, at, edge


@njit(cache=True)
def surfaces(ground, points, up):
    """Fill up (n,) with the height in enu of the ground at points (n, 2)."""
    grid, heights, posts, _, _, _, _, _, _, _, radius, _, _ = ground
    for k in range(len(up)):
        z = surface(grid, posts, heights, radius, points[k, 0], points[k, 1], 0.0)
        up[k] = surface(grid, posts, heights, radius, points[k, 0], points[k, 1], z)


@njit(cache=True, inline="always")
def bilinear(nodes, k, x, y):
    """Azimuth k's value at (x, y) [steps from the first node]; beyond the nodes it goes on as at the edge."""
    across = nodes.shape[1]
    i, j = min(max(int(np.floor(x)), 0), across - 2), min(max(int(np.floor(y)), 0), across - 2)
    west = nodes[k, i, j] + (y - j) * (nodes[k, i, j + 1] - nodes[k, i, j])
    east = nodes[k, i + 1, j] + (y - j) * (nodes[k, i + 1, j + 1] - nodes[k, i + 1, j])
    return west + (x - i) * (east - west)


@njit(cache=True)
def interpolate(ground, near, points, column, found):
    """Fill found (n, m) with the horizon [rad] at points (n, 2) and columns (n, m), or (1, m) for all points.

    near: `derived_maps.Nodes`.
    """
    nodes, per_height, middle, east, north, half = near
    scale = (nodes.shape[1] - 1) / (2 * half)
    up = np.empty(1)
    for k in range(len(found)):
        if k == 0 or points[k, 0] != points[k - 1, 0] or points[k, 1] != points[k - 1, 1]:
            surfaces(ground, points[k : k + 1], up)
        x, y = (points[k, 0] - east + half) * scale, (points[k, 1] - north + half) * scale
        row = min(k, len(column) - 1)
        for m in range(found.shape[1]):
            c = column[row, m]
            found[k, m] = np.arctan(bilinear(nodes, c, x, y) - (up[0] - middle) * per_height[c])
