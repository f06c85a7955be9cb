"""Table of horizons, computed once per map and search area.

For each cell of the searched square and each degree of azimuth: bounds of the horizon, its distance, and a line above
and a point below the ground that makes it.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from startrack.core.types import Array, Bools, Ints
from startrack.terrain.protocol import Progress

if TYPE_CHECKING:
    from startrack.terrain.trace_memory import BoxMemory

BINS = 360  # azimuths; the localizer's sectors are 1.5 degrees wide
DISTANCE_STEP_M = 4.0
ANGLE_STEP_RAD = np.pi / 65_000
FIELDS = 11
RISE_STEP = 1e-3
LOW, HIGH, FIRST, LAST, BEST, LINE_TAN, LINE_M, POINT_S, POINT_M, RISE, POINT_RISE = range(11)  # of what tracing finds
FARTHEST = 65_535
NOT_KNOWN_M = -32_768


@dataclass(frozen=True)
class Square:
    """The searched square, cut into 2^n x 2^n cells; cell (i, j) is the i-th to the east and j-th to the north."""

    reach_m: float
    across: int

    @property
    def half_m(self) -> float:
        return self.reach_m / self.across

    @property
    def centres_m(self) -> Array:
        """(across^2, 2), the north running fastest."""
        line = self.half_m * (2 * np.arange(self.across) + 1) - self.reach_m
        east, north = np.meshgrid(line, line, indexing="ij")
        return np.stack([east.ravel(), north.ravel()], axis=-1)


@dataclass(frozen=True, eq=False)
class HorizonTable:
    """The cells' horizons, rounded so that bounds stay bounds.

    Fields of each cell and degree: 0, 1 bounds of the elevation [ANGLE_STEP_RAD above -pi/2]; 2, 3 range of the
    horizon's distance, 4 its distance from the middle [DISTANCE_STEP_M]; 5, 6 the line z = a + t s above the ground
    there on the middle line, t as an elevation and a [m], and 9 its largest rise to the side [RISE_STEP]; 7, 8 distance
    and height [m] of a point below the ground, 10 the slope to the side that this point assumes [RISE_STEP].
    """

    square: Square
    values: NDArray[np.uint16]  # (cells, BINS, 11)
    unknown_rad: Array  # (BINS,) elevation below which ground off the maps might stand, seen from anywhere; or -pi/2

    @cached_property
    def box_memory(self) -> BoxMemory:
        """Bounds over small boxes that were traced with this table before."""
        from startrack.terrain.trace_memory import BoxMemory

        return BoxMemory()

    @cached_property
    def pyramid(self) -> list[tuple[NDArray[np.uint16], NDArray[np.uint16]]]:
        """Least and most elevation (n, n, BINS) of the cells, then of ever larger blocks of them."""
        n = self.square.across
        cells = self.values.reshape(n, n, BINS, FIELDS)
        nowhere = (cells[..., 0] == 0) & (cells[..., 1] == FARTHEST)  # no camera can be there: no part of any block
        levels = [
            (np.where(nowhere, np.uint16(FARTHEST), cells[..., 0]), np.where(nowhere, np.uint16(0), cells[..., 1]))
        ]
        while levels[-1][0].shape[0] > 1:
            levels.append((_quarters(levels[-1][0], np.minimum), _quarters(levels[-1][1], np.maximum)))
        return levels


def _quarters(a: NDArray[np.uint16], choose: np.ufunc) -> NDArray[np.uint16]:
    return np.asarray(choose(choose(a[::2, ::2], a[1::2, ::2]), choose(a[::2, 1::2], a[1::2, 1::2])))


def quantize_fields(found: Array) -> NDArray[np.uint16]:
    """The fields (..., 11) that tracing found, rounded so that every bound still holds."""
    out = np.empty(found.shape, dtype=np.uint16)
    out[..., 0] = np.clip(np.floor((np.arctan(found[..., LOW]) + np.pi / 2) / ANGLE_STEP_RAD), 0, FARTHEST)
    out[..., 1] = np.clip(np.ceil((np.arctan(found[..., HIGH]) + np.pi / 2) / ANGLE_STEP_RAD), 0, FARTHEST)
    for to, name, rounded in ((2, FIRST, np.floor), (3, LAST, np.ceil), (4, BEST, np.round), (7, POINT_S, np.floor)):
        out[..., to] = np.clip(rounded(found[..., name] / DISTANCE_STEP_M), 0, FARTHEST)
    tilt = np.round((np.arctan(found[..., LINE_TAN]) + np.pi / 2) / ANGLE_STEP_RAD)
    out[..., 5] = np.clip(tilt, 0, FARTHEST)
    flatter = np.maximum(found[..., LINE_TAN] - np.tan(tilt * ANGLE_STEP_RAD - np.pi / 2), 0.0)
    line = np.ceil(found[..., LINE_M] + flatter * np.maximum(found[..., LAST], 0.0))
    out[..., 6] = np.clip(line, NOT_KNOWN_M, 32_767).astype(np.int16).view(np.uint16)
    low = np.floor(found[..., POINT_M])
    out[..., 8] = np.where(low < NOT_KNOWN_M, NOT_KNOWN_M, np.minimum(low, 32_767)).astype(np.int16).view(np.uint16)
    out[..., 9] = np.clip(np.ceil(found[..., RISE] / RISE_STEP), 0, FARTHEST)
    out[..., 10] = np.clip(np.floor(found[..., POINT_RISE] / RISE_STEP), 0, FARTHEST)
    # A line beyond the range of its field is left out, and so is a point so far down.
    out[..., 3] = np.where((line > 32_767) | (found[..., LAST] > FARTHEST * DISTANCE_STEP_M), FARTHEST, out[..., 3])
    return out


def build_table(
    square: Square, wanted: Bools, fill: Callable[[Ints], Array], unknown_rad: Array, progress: Progress | None = None
) -> HorizonTable:
    """The table; `fill(cells)` traces some cells (n, BINS, 11). Cells that are not `wanted` have bounds of -+ pi/2.

    Cells are traced on all cores: the kernels release Python's lock.
    """
    from concurrent.futures import ThreadPoolExecutor

    values = np.zeros((square.across**2, BINS, FIELDS), dtype=np.uint16)
    values[..., 1] = values[..., 3] = FARTHEST
    values[..., 8] = np.array(NOT_KNOWN_M, dtype=np.int16).view(np.uint16)
    cells = np.flatnonzero(wanted)
    parts = np.array_split(cells, max(1, len(cells) // 64))
    done = 0

    def work(part: Ints) -> int:
        values[part] = quantize_fields(fill(part))
        return len(part)

    pool = ThreadPoolExecutor(cpu_count())
    try:
        for count in pool.map(work, parts):
            done += count
            if progress is not None:
                progress(done, len(cells))
    finally:
        pool.shutdown(cancel_futures=True)  # an interrupted build does not wait for the other parts
    return HorizonTable(square, values, unknown_rad)


def cpu_count() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
