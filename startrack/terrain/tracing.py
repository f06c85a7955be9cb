"""Calls of the compiled kernels on whole arrays; numba is loaded at the first call."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from startrack.core.types import Array, Ints
from startrack.terrain.horizon_table import BINS, FIELDS, HorizonTable, cpu_count

if TYPE_CHECKING:
    from startrack.terrain.height_map import HeightMap
    from startrack.terrain.horizon_interpolator import HorizonInterpolator

MIN_RAYS_FOR_THREADS = 1500  # fewer take less time than starting threads
MAX_THREADS = 8
NO_VALUES = np.zeros((0, BINS, FIELDS), dtype=np.uint16)


def ground_heights(terrain: HeightMap, points: Array) -> Array:
    """Height (n,) of the ground in enu [m] at the points (n, 2)."""
    from startrack.terrain.horizon_kernel import surfaces

    up = np.empty(len(points))
    surfaces(terrain.ground, np.ascontiguousarray(points), up)
    return up


def trace_horizons(
    terrain: HeightMap, table: HorizonTable | None, points: Array, azimuths: Array
) -> tuple[Array, Array, Array]:
    """tan of the horizon, its distance [m], and the distance of the maps' end [m] (1e9: beyond the horizon), all (n,).

    The table, if there is one, gives the distance of the horizon along the rays (n,).
    """
    from startrack.terrain.table_kernel import horizons

    tan, at, edge = (np.empty(len(azimuths)) for _ in range(3))
    fixed = terrain.ground, *_table_arrays(table), terrain.camera_height_m
    _run_in_threads(horizons, fixed, (points, azimuths, tan, at, edge))
    return tan, at, edge


def trace_cells(terrain: HeightMap, centres: Array, half: float, azimuths: Array, turn: float) -> Array:
    """The fields of the table (cells, azimuths, 11) that `bounds_kernel.bounds` finds, of cells (n, 2)."""
    from startrack.terrain.table_kernel import fill_cells

    found = np.empty((len(centres), len(azimuths), FIELDS))
    fill_cells(terrain.ground, centres, half, terrain.camera_height_m, np.sin(azimuths), np.cos(azimuths), turn, found)
    return found


def trace_box_bounds(terrain: HeightMap, table: HorizonTable, *arrays: Array) -> None:
    """Bounds traced over small boxes: centres (n, 2), half sides, azimuths and their half widths; results low, high."""
    from startrack.terrain.table_kernel import box_bounds

    fixed = terrain.ground, *_table_arrays(table), terrain.camera_height_m
    table.box_memory.fill(lambda *some: _run_in_threads(box_bounds, fixed, some), *arrays)


def look_up_sector_bounds(terrain: HeightMap, table: HorizonTable, *arrays: Array) -> None:
    """Bounds from the table over boxes of one size. Arrays as in `trace_box_bounds`."""
    from startrack.terrain.table_kernel import many_sector_bounds

    values, across, reach = _table_arrays(table)
    lows, highs = table.pyramid[level_for(table, float(arrays[1][0]))]
    many_sector_bounds(terrain.ground, values, lows, highs, across, reach, terrain.camera_height_m, *arrays)


def interpolate(near: HorizonInterpolator, points: Array, column: Ints) -> Array:
    """Interpolated horizons (n,) [rad] at points (n, 2) for the interpolator's azimuths of index `column` (n,)."""
    from startrack.terrain import horizon_kernel

    found = np.empty(len(column))
    where = near.middle_up_m, *near.centre_m, near.half_m
    fill: Any = horizon_kernel.interpolate
    fill(near.whole.ground, near.nodes, near.per_height, *where, points, column, found)
    return found


def interpolate_bounds(near: HorizonInterpolator, centres: Array, half: float, column: Ints) -> tuple[Array, Array]:
    """Bounds (n,), (n,) [rad] of the interpolated horizons over boxes of one half side [m]."""
    from startrack.terrain import horizon_kernel

    low, high = np.empty(len(column)), np.empty(len(column))
    where = near.interpolation_error, near.middle_up_m, *near.centre_m, near.half_m
    fill: Any = horizon_kernel.interpolate_bounds
    fill(near.whole.ground, near.nodes, near.per_height, *where, centres, half, column, low, high)
    return low, high


def bound_horizons(
    terrain: HeightMap,
    table: HorizonTable,
    centres_m: Array,
    half_m: Array,
    azimuths_rad: Array,
    azimuth_half_rad: Array | float,
) -> tuple[Array, Array]:
    """Bounds of the horizon over boxes [rad]: traced for single rays and small boxes, else from the table.

    Arguments and results broadcast, as in `Terrain.horizon_bounds_rad`.
    """
    centres_m = np.asarray(centres_m, dtype=np.float64)
    shape = np.broadcast_shapes(
        centres_m.shape[:-1], np.shape(half_m), np.shape(azimuths_rad), np.shape(azimuth_half_rad)
    )
    centres = flatten(centres_m, (*shape, 2)).reshape(-1, 2)
    half, azimuths, turn = (flatten(a, shape).ravel() for a in (half_m, azimuths_rad, azimuth_half_rad))
    low, high = np.empty(len(half)), np.empty(len(half))
    traced = (turn < 0.25 * 2 * np.pi / BINS) & (half < table.square.half_m)
    if traced.all():
        trace_box_bounds(terrain, table, centres, half, azimuths, turn, low, high)
    elif not traced.any() and np.all(half == half[0]):
        look_up_sector_bounds(terrain, table, centres, half, azimuths, turn, low, high)
    else:
        parts = [(look_up_sector_bounds, ~traced & (half == kind)) for kind in np.unique(half[~traced])]
        for bounds, which in [*parts, (trace_box_bounds, traced)]:
            if which.any():
                some = [np.ascontiguousarray(a[which]) for a in (centres, half, azimuths, turn)]
                results = np.empty((2, len(some[0])))
                bounds(terrain, table, *some, *results)
                low[which], high[which] = results
    return low.reshape(shape), high.reshape(shape)


def flatten(a: Any, shape: tuple[int, ...]) -> Array:
    """The values of `a`, broadcast to the shape, in one contiguous array."""
    return np.ascontiguousarray(np.broadcast_to(np.asarray(a, dtype=np.float64), shape))


def level_for(table: HorizonTable, half: float) -> int:
    """Level of the pyramid whose blocks are as wide as the box at least, or the last."""
    level = 0
    while level < len(table.pyramid) - 1 and table.square.half_m * 2**level * (1 + 1e-9) < half:
        level += 1
    return level


def _run_in_threads(function: Any, fixed: tuple[Any, ...], arrays: tuple[Array, ...]) -> None:
    """Call the function with the fixed arguments and parts of the arrays, on all cores where rays are many."""
    n, cores = len(arrays[-1]), min(cpu_count(), MAX_THREADS)
    if n < MIN_RAYS_FOR_THREADS or cores == 1:
        function(*fixed, *arrays)
        return
    ends = np.linspace(0, n, cores + 1).astype(int)
    with ThreadPoolExecutor(cores) as pool:
        parts = [[a[i:j] for a in arrays] for i, j in pairwise(ends)]
        for future in [pool.submit(function, *fixed, *part) for part in parts]:
            future.result()


def _table_arrays(table: HorizonTable | None) -> tuple[Any, int, float]:
    return (NO_VALUES, 0, 0.0) if table is None else (table.values, table.square.across, table.square.reach_m)
