"""Table of horizons, computed once per map and search area, the errors of the horizon by it, and kernels on all cores.

For each cell of the searched square and each degree of azimuth: bounds of the horizon, its distance, and a line above
and a point below the ground that makes it. Rays go to the kernels one by one, or all azimuths of a point in a row.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import pairwise
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.core.runner import count_cores
from startrack.core.types import SECTORS, Array, Bools, Ints
from startrack.kernels.library import kernel
from startrack.kernels.records import Record, declare_record
from startrack.terrain.ground import merge_blocks

MIN_RAYS_FOR_THREADS = 1500  # fewer take less time than starting threads
MAX_THREADS = 8
AZIMUTH_BINS = 360  # azimuths; the localizer's sectors are 1.5 degrees wide
MIDDLES_RAD = (np.arange(AZIMUTH_BINS) + 0.5) * 2 * np.pi / AZIMUTH_BINS
DISTANCE_STEP_M = 4.0
ANGLE_STEP_RAD = np.pi / 65_000
FIELDS = 11
RISE_STEP = 1e-3
FARTHEST = np.iinfo(np.uint16).max
NOT_KNOWN_M, HIGHEST_M = np.iinfo(np.int16).min, np.iinfo(np.int16).max  # range of fields that hold heights
NEAREST_M = 50.0  # sigmas do not distinguish crests closer by
SLOTS = 2**18  # boxes and azimuths that are kept: 15 MB; a draw on Shackleton's floor traces 20,000 to 110,000
SECTOR_SLOTS = 2**14  # boxes whose bounds in all sectors are kept: 63 MB; a draw there looks 6000 up
NEW = np.uint64(np.iinfo(np.uint64).max)  # a NaN, which no box has


def flatten_rays(points_m: Array, azimuths_rad: Array) -> tuple[tuple[int, ...], Array, Array]:
    """Shape of points (..., 2) broadcast with azimuths (...), and its n points (n, 2) and azimuths (n,)."""
    shape = np.broadcast_shapes(np.shape(points_m)[:-1], np.shape(azimuths_rad))
    return shape, flatten(points_m, (*shape, 2)).reshape(-1, 2), flatten(azimuths_rad, shape).ravel()


def rows_of_rays(points_m: Array, azimuths_rad: Array) -> tuple[tuple[int, ...], Array, Array]:
    """Shape of points (..., 2) broadcast with azimuths, points (n, 2), azimuths: (1, m) of all points, else (n, 1)."""
    if np.ndim(points_m) > 1 and np.shape(points_m)[-2] == 1 and np.ndim(azimuths_rad) == 1:
        shape = (*np.shape(points_m)[:-2], len(azimuths_rad))
        return shape, flatten(points_m, np.shape(points_m)).reshape(-1, 2), np.array(azimuths_rad, np.float64)[None]
    shape, points, azimuths = flatten_rays(points_m, azimuths_rad)
    return shape, points, azimuths[:, None]


def flatten(a: Any, shape: tuple[int, ...]) -> Array:
    """Copy of `a`, broadcast to the `shape`, as one contiguous array: kernels have one layout."""
    return np.array(np.broadcast_to(np.asarray(a, dtype=np.float64), shape), order="C")


def run_in_threads(function: Any, fixed: tuple[Any, ...], arrays: tuple[Array, ...]) -> None:
    """Call the function with the fixed arguments and parts of the arrays, on all cores where rays are many."""
    n, cores = len(arrays[-1]), min(count_cores(), MAX_THREADS)
    if arrays[-1].size < MIN_RAYS_FOR_THREADS or cores == 1:
        function(*fixed, *arrays)
        return
    ends = np.linspace(0, n, cores + 1).astype(int)
    own, *others = [[a[i:j] for a in arrays] for i, j in pairwise(ends)]
    running = [_thread_pool().submit(function, *fixed, *part) for part in others]
    function(*fixed, *own)
    for future in running:
        future.result()


@cache
def _thread_pool() -> ThreadPoolExecutor:
    """Pool of threads beside the calling one, kept: each start takes as long as a thousand rays."""
    return ThreadPoolExecutor(MAX_THREADS)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_thread_pool.cache_clear)  # threads are not copied


@dataclass(frozen=True)
class Square:
    """The searched square, cut into 2^n x 2^n cells; cell (i, j) is the i-th to the east and j-th to the north."""

    reach_m: float
    across: int

    @property
    def half_m(self) -> float:
        """Half the side of a cell [m]."""
        return self.reach_m / self.across

    @property
    def centres_m(self) -> Array:
        """Centres (across^2, 2) [m] of the cells, east and north, the north running fastest."""
        line = self.half_m * (2 * np.arange(self.across) + 1) - self.reach_m
        east, north = np.meshgrid(line, line, indexing="ij")
        return np.stack([east.ravel(), north.ravel()], axis=-1)

    @property
    def cells_within_reach(self) -> Ints:
        """Numbers (n,) of the cells that may hold a position within reach, in the order of `centres_m`."""
        return np.flatnonzero(np.hypot(*self.centres_m.T) < self.reach_m + 1.42 * self.half_m)


class BoxMemory:
    """Bounds of the horizon over boxes that were asked for before: images and draws of one place do so again.

    The search cuts its square at the same lines for every image. It bounds the same parts of sectors in the same boxes,
    and under the sky of one time the same stars, too. What is kept is what was computed, bit for bit; later bounds
    replace earlier ones in the slots.
    """

    def __init__(self, slots: int, numbers: int, azimuths: int) -> None:
        """Keep in `slots` the bounds at `azimuths` azimuths of boxes that are told apart by `numbers` numbers each."""
        self._shape = slots, numbers, azimuths
        self._keys, self._bounds = np.full((slots, numbers), NEW), np.empty((slots, 2, azimuths))
        self._lock = Lock()

    def __reduce__(self) -> tuple[type[BoxMemory], tuple[int, int, int]]:
        return BoxMemory, self._shape  # another process computes for itself

    def fill(self, numbers: Array, low: Array, high: Array, compute: Callable[[Bools], Array]) -> None:
        """Fill bounds `low` and `high` (n, azimuths) of the horizon for boxes of `numbers` (n, numbers).

        `compute` gives the bounds (2, k, azimuths) of the k boxes that are not kept, of which it takes a mask (n,).
        """
        keys = np.ascontiguousarray(numbers).view(np.uint64)
        missing = np.empty(len(low), dtype=np.bool_)
        with self._lock:
            _recall_bounds(self._keys, self._bounds, keys, low, high, missing)
        if not missing.any():
            return
        results = compute(missing)
        low[missing], high[missing] = results
        with self._lock:
            _keep_bounds(self._keys, self._bounds, keys[missing], *results)


@dataclass(frozen=True, eq=False)
class HorizonTable:
    """The cells' horizons, rounded so that bounds stay bounds.

    Fields of each cell and degree: 0, 1 bounds of the elevation [ANGLE_STEP_RAD above -pi/2]; 2, 3 range of the
    horizon's distance, 4 its distance from the middle [DISTANCE_STEP_M]; 5, 6 the line z = a + t s above the ground
    there on the middle line, t as an elevation and a [m], and 9 its largest rise to the side [RISE_STEP]; 7, 8 distance
    and height [m] of a point below the ground, 10 the slope to the side that this point assumes [RISE_STEP].
    """

    square: Square
    values: NDArray[np.uint16]  # (cells, AZIMUTH_BINS, FIELDS)
    unknown_rad: (
        Array  # (AZIMUTH_BINS,) elevation below which ground off the maps might stand, seen from anywhere; or -pi/2
    )

    @cached_property
    def box_memory(self) -> BoxMemory:
        """Bounds over small boxes that were traced with this table before: centre, half side, azimuth, its turn."""
        return BoxMemory(SLOTS, 5, 1)

    @cached_property
    def sector_memory(self) -> BoxMemory:
        """Bounds in the localizer's sectors over boxes that were looked up before: centre and half side."""
        return BoxMemory(SECTOR_SLOTS, 3, SECTORS)

    @cached_property
    def tangents(self) -> Array:
        """Tangents (65536,) of the table's elevations; infinite at the zenith and the nadir."""
        found = np.tan(np.arange(FARTHEST + 1) * ANGLE_STEP_RAD - np.pi / 2)
        found[0], found[round(np.pi / ANGLE_STEP_RAD) :] = -np.inf, np.inf
        return found

    @cached_property
    def record(self) -> Record:
        """Record of the table for the compiled kernels."""
        return Record(
            "table", self.values, self.tangents, np.sin(MIDDLES_RAD), np.cos(MIDDLES_RAD), self.square.across,
            self.square.reach_m, ANGLE_STEP_RAD, DISTANCE_STEP_M, RISE_STEP,
        )  # fmt: skip

    @cached_property
    def pyramid(self) -> list[tuple[NDArray[np.uint16], NDArray[np.uint16]]]:
        """Least and most elevation (n, n, AZIMUTH_BINS) of the cells, then of ever larger blocks of them."""
        n = self.square.across
        cells = self.values.reshape(n, n, AZIMUTH_BINS, FIELDS)
        nowhere = (cells[..., 0] == 0) & (cells[..., 1] == FARTHEST)  # no camera can be there: no part of any block
        levels = [
            (np.where(nowhere, np.uint16(FARTHEST), cells[..., 0]), np.where(nowhere, np.uint16(0), cells[..., 1]))
        ]
        while levels[-1][0].shape[0] > 1:
            low, high = levels[-1]
            levels.append((merge_blocks(low, np.minimum), merge_blocks(high, np.maximum)))
        return levels

    def level_for(self, half_m: float) -> int:
        """Level of the pyramid whose blocks are as wide as a box at least, or the last."""
        level = 0
        while level < len(self.pyramid) - 1 and self.square.half_m * 2**level * (1 + 1e-9) < half_m:
            level += 1
        return level


NO_TABLE = HorizonTable(
    Square(0.0, 0), np.zeros((0, AZIMUTH_BINS, FIELDS), dtype=np.uint16), np.full(AZIMUTH_BINS, -np.pi / 2)
)


@dataclass(frozen=True, eq=False)
class HorizonSigma:
    """Sigma of the horizon [rad] by cells and degrees of a table: that of a post, times cos^2 H over its distance."""

    table: HorizonTable
    height_sigma_m: float

    def sigma_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """Sigma (...) [rad] of the horizon at the points (..., 2) [m] in these azimuths (...) [rad]."""
        square = self.table.square
        cell = np.clip((np.asarray(points_m) + square.reach_m) / (2 * square.half_m), 0, square.across - 1)
        cell = cell.astype(np.int64)
        b = (np.asarray(azimuths_rad) / (2 * np.pi) * AZIMUTH_BINS).astype(np.int64) % AZIMUTH_BINS
        return self.blocks_rad[0][cell[..., 0], cell[..., 1], b]

    def max_sigma_rad(self, centres_m: Array, half_m: float, azimuths_rad: Array, azimuth_half_rad: float) -> Array:
        """Largest sigma (...) [rad] over boxes and azimuths: it changes from cell to cell of the table."""
        most = self.blocks_rad[self.table.level_for(half_m)]
        reach_m = self.table.square.reach_m
        n, side = len(most), 2 * reach_m / len(most)
        steps = 2 + int(2 * azimuth_half_rad * AZIMUTH_BINS / (2 * np.pi)) if azimuth_half_rad > 0 else 1
        turns = np.linspace(-azimuth_half_rad, azimuth_half_rad, steps) * (1 - 1e-9)
        shape, centres, azimuths = rows_of_rays(centres_m, azimuths_rad)
        bins = np.floor((azimuths[..., None] + turns) / (2 * np.pi) * AZIMUTH_BINS).astype(np.int64) % AZIMUTH_BINS
        corners = np.stack([centres - half_m * (1 - 1e-9), centres + half_m * (1 - 1e-9)], axis=1)
        cells = np.clip((corners + reach_m) / side, 0, n - 1).astype(np.int64)
        found = np.empty((len(centres), azimuths.shape[1]))
        _largest_of_cells(most, cells, bins, found)
        return found.reshape(shape)

    @cached_property
    def blocks_rad(self) -> list[NDArray[np.float32]]:
        """Sigmas (m, m, AZIMUTH_BINS) [rad] of the cells, then the largest of ever larger blocks of them."""
        n, values = self.table.square.across, self.table.values
        distance = np.maximum(values[..., 4].astype(np.float32) * DISTANCE_STEP_M, NEAREST_M)
        middle = (values[..., 0].astype(np.float32) + values[..., 1]) / 2 * ANGLE_STEP_RAD - np.pi / 2
        sigma = np.float32(self.height_sigma_m) * np.cos(middle) ** 2 / distance
        levels = [np.asarray(sigma).reshape(n, n, AZIMUTH_BINS)]
        while len(levels[-1]) > 1:
            levels.append(merge_blocks(levels[-1], np.maximum))
        return levels


def quantize_fields(found: Array) -> NDArray[np.uint16]:
    """The fields (..., FIELDS) that tracing found, rounded so that every bound still holds."""
    low, high, first, last, best, line_tan, line_m, point_s, point_m, rise, point_rise = np.moveaxis(found, -1, 0)

    def steps(values: Array, step: float, rounded: np.ufunc) -> Array:
        return np.asarray(np.clip(rounded(values / step), 0, FARTHEST))

    def angles(tan: Array, rounded: np.ufunc) -> Array:
        return steps(np.arctan(tan) + np.pi / 2, ANGLE_STEP_RAD, rounded)

    def heights(metres: Array) -> NDArray[np.uint16]:
        return np.clip(metres, NOT_KNOWN_M, HIGHEST_M).astype(np.int16).view(np.uint16)

    tilt = angles(line_tan, np.rint)
    flatter = np.maximum(line_tan - np.tan(tilt * ANGLE_STEP_RAD - np.pi / 2), 0.0)
    line = np.ceil(line_m + flatter * np.maximum(last, 0.0))
    # A line beyond the range of its field is left out, and so is a point so far down.
    beyond = (line > HIGHEST_M) | (last > FARTHEST * DISTANCE_STEP_M)
    fields = [
        angles(low, np.floor), angles(high, np.ceil), steps(first, DISTANCE_STEP_M, np.floor),
        np.where(beyond, FARTHEST, steps(last, DISTANCE_STEP_M, np.ceil)), steps(best, DISTANCE_STEP_M, np.rint),
        tilt, heights(line), steps(point_s, DISTANCE_STEP_M, np.floor), heights(np.floor(point_m)),
        steps(rise, RISE_STEP, np.ceil), steps(point_rise, RISE_STEP, np.floor),
    ]  # fmt: skip
    return np.stack(fields, axis=-1).astype(np.uint16)


declare_record(
    "table", f"values: uint16[cells, bins, {FIELDS}]", f"tangents: float64[{FARTHEST + 1}]", "sines: float64[bins]",
    "cosines: float64[bins]", "across: int64", "reach: float64", "angle_step: float64", "distance_step: float64",
    "rise_step: float64",
)  # fmt: skip
trace_horizons = kernel(
    "trace_horizons", "ground: ground", "table: table", "camera_height: float64", "is_own: bool",
    "points: float64[n, 2]", "azimuths: float64[n]", "tan: out float64[n]", "distance: out float64[n]",
    "edge: out float64[n]",
)  # fmt: skip
box_bounds = kernel(
    "box_bounds", "ground: ground", "table: table", "camera_height: float64", "centres: float64[n, 2]",
    "half: float64[n]", "azimuths: float64[n]", "turn: float64[n]", "low: out float64[n]", "high: out float64[n]",
)  # fmt: skip
sector_bounds = kernel(
    "sector_bounds", "ground: ground", "table: table", "lows: uint16[blocks, blocks, bins]",
    "highs: uint16[blocks, blocks, bins]", "camera_height: float64", "azimuths: float64[rows, m]",
    "turn: float64[rows, m]", "centres: float64[n, 2]", "half: float64[n]", "low: out float64[n, m]",
    "high: out float64[n, m]",
)  # fmt: skip
fill_table = kernel(
    "fill_table", "ground: ground", "centres: float64[n, 2]", "half: float64", "camera_height: float64",
    "sines: float64[m]", "cosines: float64[m]", "turn: float64", f"found: out float64[n, m, {FIELDS}]",
)  # fmt: skip
_recall_bounds = kernel(
    "recall_bounds", "kept: uint64[slots, numbers]", "bounds: float64[slots, 2, azimuths]", "keys: uint64[n, numbers]",
    "low: out float64[n, azimuths]", "high: out float64[n, azimuths]", "missing: out bool[n]",
)  # fmt: skip
_keep_bounds = kernel(
    "keep_bounds", "kept: out uint64[slots, numbers]", "bounds: out float64[slots, 2, azimuths]",
    "keys: uint64[n, numbers]", "low: float64[n, azimuths]", "high: float64[n, azimuths]",
)  # fmt: skip
_largest_of_cells = kernel(
    "largest_of_cells", "values: float32[across, across, bins]", "cells: int64[n, 2, 2]",
    "bin: int64[rows, m, turns]", "found: out float64[n, m]",
)  # fmt: skip
