"""Horizons of packed height maps: the compiled kernels, called on whole arrays."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from startrack.core.types import Array
from startrack.terrain.ground import Ground
from startrack.terrain.horizon_kernel import surfaces
from startrack.terrain.horizon_table import AZIMUTH_BINS, FIELDS, HorizonTable
from startrack.terrain.table_kernel import box_bounds, fill_cells, horizons, many_sector_bounds

MIN_RAYS_FOR_THREADS = 1500  # fewer take less time than starting threads
MAX_THREADS = 8
MAX_TRACED_TURN_RAD = 0.25 * 2 * np.pi / AZIMUTH_BINS  # half widths of azimuths: bounds over wider ones are looked up
NO_VALUES = np.zeros((0, AZIMUTH_BINS, FIELDS), dtype=np.uint16)


class Tracer(NamedTuple):
    """Horizons seen by a camera at a height above the ground. A table, where there is one, shortens the traces."""

    ground: Ground
    camera_height_m: float

    def heights_m(self, points: Array) -> Array:
        """Height (n,) of the ground in enu [m] at the points (n, 2)."""
        up = np.empty(len(points))
        surfaces(self.ground, np.ascontiguousarray(points), up)
        return up

    def horizons(self, table: HorizonTable | None, points_m: Array, azimuths_rad: Array) -> tuple[Array, Array, Array]:
        """tan of the horizon, its distance [m], and the distance of the maps' end [m] (1e9: beyond the horizon).

        Seen from the points (..., 2) at the azimuths (...). The table gives the distance of the horizon along a ray.
        """
        shape = np.broadcast_shapes(np.shape(points_m)[:-1], np.shape(azimuths_rad))
        points, azimuths = flatten(points_m, (*shape, 2)).reshape(-1, 2), flatten(azimuths_rad, shape).ravel()
        tan, at, edge = (np.empty(len(azimuths)) for _ in range(3))
        _run_in_threads(horizons, self._kernel_arguments(table), (points, azimuths, tan, at, edge))
        return tan.reshape(shape), at.reshape(shape), edge.reshape(shape)

    def cell_fields(self, centres: Array, half: float, azimuths: Array, turn: float) -> Array:
        """The fields of a table (cells, azimuths, FIELDS) that `bounds_kernel.bounds` finds, of cells (n, 2)."""
        found = np.empty((len(centres), len(azimuths), FIELDS))
        fill_cells(self.ground, centres, half, self.camera_height_m, np.sin(azimuths), np.cos(azimuths), turn, found)
        return found

    def horizon_bounds_rad(
        self, table: HorizonTable, centres_m: Array, half_m: Array, azimuths_rad: Array,
        azimuth_half_rad: Array | float,
    ) -> tuple[Array, Array]:  # fmt: skip
        """Bounds of the horizon over boxes [rad]: traced for single rays and small boxes, else from the table.

        Arguments and results broadcast, as in `Terrain.horizon_bounds_rad`.
        """
        shape = np.broadcast_shapes(
            np.shape(centres_m)[:-1], np.shape(half_m), np.shape(azimuths_rad), np.shape(azimuth_half_rad)
        )
        centres = flatten(centres_m, (*shape, 2)).reshape(-1, 2)
        half, azimuths, turn = (flatten(a, shape).ravel() for a in (half_m, azimuths_rad, azimuth_half_rad))
        low, high = np.empty(len(half)), np.empty(len(half))
        traced = (turn < MAX_TRACED_TURN_RAD) & (half < table.square.half_m)
        if traced.all():
            self._trace_bounds(table, centres, half, azimuths, turn, low, high)
        elif not traced.any() and np.all(half == half[0]):
            self._look_up_bounds(table, centres, half, azimuths, turn, low, high)
        else:
            parts = [(self._look_up_bounds, ~traced & (half == kind)) for kind in np.unique(half[~traced])]
            for bounds, which in [*parts, (self._trace_bounds, traced)]:
                if which.any():
                    some = [np.ascontiguousarray(a[which]) for a in (centres, half, azimuths, turn)]
                    results = np.empty((2, len(some[0])))
                    bounds(table, *some, *results)
                    low[which], high[which] = results
        return low.reshape(shape), high.reshape(shape)

    def _trace_bounds(self, table: HorizonTable, *arrays: Array) -> None:
        """Bounds over small boxes: centres (n, 2), half sides, azimuths and their half widths; results low, high."""
        fixed = self._kernel_arguments(table)
        table.box_memory.fill(lambda *some: _run_in_threads(box_bounds, fixed, some), *arrays)

    def _look_up_bounds(self, table: HorizonTable, *arrays: Array) -> None:
        """Bounds from the table over boxes of one size; arrays as in `_trace_bounds`."""
        ground, values, *square = self._kernel_arguments(table)
        many_sector_bounds(ground, values, *table.pyramid[table.level_for(float(arrays[1][0]))], *square, *arrays)

    def _kernel_arguments(self, table: HorizonTable | None) -> tuple[Any, ...]:
        """The first arguments of kernels: maps, table, number of its cells and half its side, height of the camera."""
        cells = (NO_VALUES, 0, 0.0) if table is None else (table.values, table.square.across, table.square.reach_m)
        return self.ground, *cells, self.camera_height_m


def flatten(a: Any, shape: tuple[int, ...]) -> Array:
    """The values of `a`, broadcast to the shape, in one contiguous array."""
    return np.ascontiguousarray(np.broadcast_to(np.asarray(a, dtype=np.float64), shape))


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


def cpu_count() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
