"""Table of horizons, computed once per map and search area, and the errors of the horizon that follow from it.

For each cell of the searched square and each degree of azimuth: bounds of the horizon, its distance, and a line above
and a point below the ground that makes it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from startrack.core.types import Array
from startrack.terrain.ground import merge_blocks
from startrack.terrain.trace_memory import BoxMemory

BINS = 360  # azimuths; the localizer's sectors are 1.5 degrees wide
DISTANCE_STEP_M = 4.0
ANGLE_STEP_RAD = np.pi / 65_000
FIELDS = 11
RISE_STEP = 1e-3
LOW, HIGH, FIRST, LAST, BEST, LINE_TAN, LINE_M, POINT_S, POINT_M, RISE, POINT_RISE = range(11)  # of what tracing finds
FARTHEST = 65_535
NOT_KNOWN_M = -32_768
NEAREST_M = 50.0  # sigmas do not distinguish crests closer by
SIGNS = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])  # of the corners of a box


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
            low, high = levels[-1]
            levels.append((merge_blocks(low, np.minimum), merge_blocks(high, np.maximum)))
        return levels

    def level_for(self, half_m: float) -> int:
        """Level of the pyramid whose blocks are as wide as a box at least, or the last."""
        level = 0
        while level < len(self.pyramid) - 1 and self.square.half_m * 2**level * (1 + 1e-9) < half_m:
            level += 1
        return level


@dataclass(frozen=True, eq=False)
class HorizonSigma:
    """Sigma of the horizon [rad] by cells and degrees of a table: that of a post, times cos^2 H over its distance."""

    table: HorizonTable
    height_sigma_m: float

    def sigma_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """Sigma (...) at the points (..., 2) in these azimuths."""
        square = self.table.square
        n, side = square.across, 2 * square.half_m
        cell = np.clip((np.asarray(points_m) + square.reach_m) / side, 0, n - 1).astype(np.int64)
        b = (np.asarray(azimuths_rad) / (2 * np.pi) * BINS).astype(np.int64) % BINS
        index = np.broadcast_to(
            (cell[..., 0] * n + cell[..., 1]) * BINS + b,
            np.broadcast_shapes(np.shape(points_m)[:-1], np.shape(azimuths_rad)),
        )
        return np.asarray(self.cells_rad.ravel()[index])

    def max_sigma_rad(self, centres_m: Array, half_m: float, azimuths_rad: Array, azimuth_half_rad: float) -> Array:
        """The largest of `sigma_rad` (n,) over boxes and azimuths: it changes from cell to cell of the table."""
        most = self._blocks[self.table.level_for(half_m)]
        reach_m = self.table.square.reach_m
        n, side = len(most), 2 * reach_m / len(most)
        steps = 2 + int(2 * azimuth_half_rad * BINS / (2 * np.pi)) if azimuth_half_rad > 0 else 1
        corners = np.array([centres_m + corner for corner in half_m * (1 - 1e-9) * SIGNS])
        cells = np.clip((corners + reach_m) / side, 0, n - 1).astype(np.int64)
        if (cells == cells[0]).all():  # boxes of the search lie within blocks
            cells = cells[:1]
        found = np.zeros(np.broadcast_shapes(np.shape(centres_m)[:-1], np.shape(azimuths_rad)))
        for turn in np.linspace(-azimuth_half_rad, azimuth_half_rad, steps) * (1 - 1e-9):
            b = np.floor((np.asarray(azimuths_rad) + turn) / (2 * np.pi) * BINS).astype(np.int64) % BINS
            for cell in cells:
                found = np.maximum(found, most[cell[..., 0], cell[..., 1], b])
        return found

    @cached_property
    def cells_rad(self) -> Array:
        """(cells, BINS)."""
        values = self.table.values
        distance = np.maximum(values[..., BEST].astype(np.float32) * DISTANCE_STEP_M, NEAREST_M)
        middle = (values[..., 0].astype(np.float32) + values[..., 1]) / 2 * ANGLE_STEP_RAD - np.pi / 2
        return np.asarray(self.height_sigma_m * np.cos(middle) ** 2 / distance)

    @cached_property
    def _blocks(self) -> list[Array]:
        """(m, m, BINS) the largest sigma of the cells, then of ever larger blocks of them."""
        n = self.table.square.across
        levels = [self.cells_rad.reshape(n, n, BINS)]
        while len(levels[-1]) > 1:
            levels.append(merge_blocks(levels[-1], np.maximum))
        return levels


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
