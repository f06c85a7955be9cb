"""Tracing with numba where it is installed, else with numpy alone: the same answers, some ten times later."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from startrack.terrain.horizon_table import BINS, FIELDS, HorizonTable, cpu_count
from startrack.types import Array, Ints

if TYPE_CHECKING:
    from startrack.terrain.height_map import HeightMap
    from startrack.terrain.horizon_interpolator import Nearby

WORTH_THREADS, MOST_THREADS = 1500, 8
NO_VALUES = np.zeros((0, BINS, FIELDS), dtype=np.uint16)


class Tracer(Protocol):
    """What a `HeightMap` asks: all flat arrays (n,), points and centres (n, 2)."""

    compiled: bool

    def surfaces(self, terrain: HeightMap, points: Array) -> Array: ...
    def horizons(
        self, terrain: HeightMap, table: HorizonTable | None, points: Array, azimuths: Array
    ) -> tuple[Array, Array, Array]: ...
    def fill_cells(self, terrain: HeightMap, centres: Array, half: float, azimuths: Array, turn: float) -> Array: ...
    def box_bounds(self, terrain: HeightMap, table: HorizonTable, *arrays: Array) -> None: ...
    def sector_bounds(self, terrain: HeightMap, table: HorizonTable, *arrays: Array) -> None: ...
    def between(self, near: Nearby, points: Array, column: Ints, found: Array) -> None: ...
    def between_bounds(
        self, near: Nearby, centres: Array, half: float, column: Ints, low: Array, high: Array
    ) -> None: ...


def tracer(use_compiled: bool | None = None) -> Tracer:
    """The compiled tracer where numba is installed (None), or as asked."""
    if use_compiled is None:
        use_compiled = find_spec("numba") is not None
    return CompiledTracer() if use_compiled else PlainTracer()


class CompiledTracer:
    """By numba; it lets go of Python's lock."""

    compiled = True

    def surfaces(self, terrain: HeightMap, points: Array) -> Array:
        """Heights in enu (n,)."""
        from startrack.terrain import horizon_kernel as trace_compiled

        up = np.empty(len(points))
        trace_compiled.surfaces(terrain.ground, np.ascontiguousarray(points), up)
        return up

    def horizons(
        self, terrain: HeightMap, table: HorizonTable | None, points: Array, azimuths: Array
    ) -> tuple[Array, Array, Array]:
        """tan, distance, distance of the maps' end (n,)."""
        from startrack.terrain import table_kernel as table_compiled

        tan, at, edge = (np.empty(len(azimuths)) for _ in range(3))
        values, across, reach = _table(table)
        fixed = terrain.ground, values, across, reach, terrain.camera_height_m
        _side_by_side(table_compiled.horizons, fixed, (points, azimuths, tan, at, edge))
        return tan, at, edge

    def fill_cells(self, terrain: HeightMap, centres: Array, half: float, azimuths: Array, turn: float) -> Array:
        """(cells, azimuths, 11), see `bounds_compiled.bounds`."""
        from startrack.terrain import table_kernel as table_compiled

        found = np.empty((len(centres), len(azimuths), FIELDS))
        table_compiled.fill_cells(
            terrain.ground, centres, half, terrain.camera_height_m, np.sin(azimuths), np.cos(azimuths), turn, found
        )
        return found

    def box_bounds(self, terrain: HeightMap, table: HorizonTable, *arrays: Array) -> None:
        """centres, half, azimuths, turn, and the results low, high."""
        from startrack.terrain import table_kernel as table_compiled

        fixed = terrain.ground, *_table(table), terrain.camera_height_m
        _side_by_side(table_compiled.box_bounds, fixed, arrays)

    def sector_bounds(self, terrain: HeightMap, table: HorizonTable, *arrays: Array) -> None:
        """Likewise; all boxes of one size."""
        from startrack.terrain import table_kernel as table_compiled

        values, across, reach = _table(table)
        lows, highs = table.pyramid[level_for(table, float(arrays[1][0]))]
        table_compiled.many_sector_bounds(
            terrain.ground, values, lows, highs, across, reach, terrain.camera_height_m, *arrays
        )

    def between(self, near: Nearby, points: Array, column: Ints, found: Array) -> None:
        """Interpolated horizons into found (n,)."""
        from startrack.terrain import interpolator_kernel as nearby_compiled

        where = near.middle_up_m, *near.centre_m, near.half_m
        fill: Any = nearby_compiled.between
        fill(near.ground, near.nodes, near.per_height, *where, points, column, found)

    def between_bounds(self, near: Nearby, centres: Array, half: float, column: Ints, low: Array, high: Array) -> None:
        """Bounds of the interpolated horizons into low and high (n,)."""
        from startrack.terrain import interpolator_kernel as nearby_compiled

        where = near.rough, near.middle_up_m, *near.centre_m, near.half_m
        fill: Any = nearby_compiled.between_bounds
        fill(near.ground, near.nodes, near.per_height, *where, centres, half, column, low, high)


class PlainTracer:
    """By numpy alone."""

    compiled = False

    def surfaces(self, terrain: HeightMap, points: Array) -> Array:
        """Heights in enu (n,)."""
        from startrack.terrain.trace_plain import surface

        z = surface(terrain.ground, points[:, 0], points[:, 1], np.zeros(len(points)))
        return surface(terrain.ground, points[:, 0], points[:, 1], z)

    def horizons(
        self, terrain: HeightMap, table: HorizonTable | None, points: Array, azimuths: Array
    ) -> tuple[Array, Array, Array]:
        """tan, distance, distance of the maps' end (n,)."""
        from startrack.terrain.table_plain import look_up
        from startrack.terrain.trace_plain import horizon

        places, of = np.unique(points, axis=0, return_inverse=True)
        up = (self.surfaces(terrain, places) + terrain.camera_height_m)[of.ravel()]
        start, end, hint = look_up(table, points, azimuths)
        return horizon(terrain.ground, points, up, np.sin(azimuths), np.cos(azimuths), start, end, hint)

    def fill_cells(self, terrain: HeightMap, centres: Array, half: float, azimuths: Array, turn: float) -> Array:
        """(cells, azimuths, 11), see `bounds_compiled.bounds`."""
        n, bins = len(centres), len(azimuths)
        found = self._bounds(
            terrain, np.repeat(centres, bins, axis=0), np.full(n * bins, half), np.tile(azimuths, n),
            np.full(n * bins, turn), np.zeros(n * bins), np.full(n * bins, 1e9),
        )  # fmt: skip
        return found.reshape(n, bins, FIELDS)

    def box_bounds(self, terrain: HeightMap, table: HorizonTable, *arrays: Array) -> None:
        """centres, half, azimuths, turn, and the results low, high."""
        from startrack.terrain.table_plain import look_up_boxes

        centres, half, azimuths, turn, low, high = arrays
        start, end = look_up_boxes(table, centres, half, azimuths, turn)
        found = self._bounds(terrain, centres, half, azimuths, turn, start, end)
        low[:], high[:] = np.arctan(found[:, 0]), np.arctan(found[:, 1])

    def sector_bounds(self, terrain: HeightMap, table: HorizonTable, *arrays: Array) -> None:
        """Likewise; all boxes of one size."""
        from startrack.terrain.table_plain import sector_bounds

        centres, half, azimuths, turn, low, high = arrays
        lowest, highest = self._standing(terrain, centres, half)[1:] if half[0] < table.square.half_m else (half, half)
        level = level_for(table, float(half[0]))
        low[:], high[:] = sector_bounds(table, level, centres, half, lowest, highest, azimuths, turn)

    def between(self, near: Nearby, points: Array, column: Ints, found: Array) -> None:
        """Interpolated horizons into found (n,)."""
        from startrack.terrain import nearby_plain

        nearby_plain.between(near, points, column, found)

    def between_bounds(self, near: Nearby, centres: Array, half: float, column: Ints, low: Array, high: Array) -> None:
        """Bounds of the interpolated horizons into low and high (n,)."""
        from startrack.terrain import nearby_plain

        nearby_plain.between_bounds(near, centres, half, column, low, high)

    def _standing(self, terrain: HeightMap, centres: Array, half: Array) -> tuple[Array, Array, Array]:
        """Heights of the camera (n,): in the middle of boxes, lowest and highest."""
        from startrack.terrain.bounds_plain import standing

        boxes, of = np.unique(np.column_stack([centres, half]), axis=0, return_inverse=True)
        found = standing(terrain.ground, boxes[:, :2], boxes[:, 2])
        middle, low, high = (a[of.ravel()] + terrain.camera_height_m for a in found)
        return middle, low, high

    def _bounds(
        self,
        terrain: HeightMap,
        centres: Array,
        half: Array,
        azimuths: Array,
        turn: Array,
        start: Array,
        end: Array,
    ) -> Array:
        from startrack.terrain.bounds_plain import bounds

        up, low, high = self._standing(terrain, centres, half)
        sin_a, cos_a = np.sin(azimuths), np.cos(azimuths)
        return bounds(terrain.ground, centres, up, low, high, half, sin_a, cos_a, turn, start, end)


def _side_by_side(function: Any, fixed: tuple[Any, ...], arrays: tuple[Array, ...]) -> None:
    """Call the function with the fixed arguments and parts of the arrays, on all cores where that is worth while."""
    n, cores = len(arrays[-1]), min(cpu_count(), MOST_THREADS)
    if n < WORTH_THREADS or cores == 1:
        function(*fixed, *arrays)
        return
    ends = np.linspace(0, n, cores + 1).astype(int)
    with ThreadPoolExecutor(cores) as pool:
        parts = [[a[i:j] for a in arrays] for i, j in pairwise(ends)]
        for future in [pool.submit(function, *fixed, *part) for part in parts]:
            future.result()


def level_for(table: HorizonTable, half: float) -> int:
    """Level of the pyramid whose blocks are as wide as the box at least, or the last."""
    level = 0
    while level < len(table.pyramid) - 1 and table.square.half_m * 2**level * (1 + 1e-9) < half:
        level += 1
    return level


def _table(table: HorizonTable | None) -> tuple[Any, int, float]:
    return (NO_VALUES, 0, 0.0) if table is None else (table.values, table.square.across, table.square.reach_m)
