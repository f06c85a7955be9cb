"""Standard deviation of the horizon from the posts' errors: the highest post moves the crest by its own error."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from startrack.core.types import Array
from startrack.terrain.horizon_table import ANGLE_STEP_RAD, BEST, BINS, DISTANCE_STEP_M, HorizonTable
from startrack.terrain.tracing import level_for

NEAREST_M = 50.0  # the table does not distinguish crests closer by
CORNERS = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])


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
        most = self._blocks[level_for(self.table, half_m)]
        reach_m = self.table.square.reach_m
        n, side = len(most), 2 * reach_m / len(most)
        steps = 2 + int(2 * azimuth_half_rad * BINS / (2 * np.pi)) if azimuth_half_rad > 0 else 1
        corners = np.array([centres_m + corner for corner in half_m * (1 - 1e-9) * CORNERS])
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
            a = levels[-1]
            levels.append(np.maximum(np.maximum(a[::2, ::2], a[1::2, ::2]), np.maximum(a[::2, 1::2], a[1::2, 1::2])))
        return levels
