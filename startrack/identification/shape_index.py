"""Index of triangles by shape and rough size, for a lens of unknown scale."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from startrack.identification.triangles import Triangles
from startrack.types import Array, Ints

CELL_LENGTH = 16.0  # range of the logarithm of the size within a cell of the key
SMALLEST_LOG = -12.0


@dataclass(frozen=True)
class ShapeIndex:
    """Catalogue triangles sorted by a key: the cell of their two ratios of sides, then the logarithm of the size."""

    triangles: Triangles
    key: Array  # (n,) ascending
    ratios: NDArray[np.float32]  # (n, 2)
    shape_tolerance: float
    size_tolerance: float  # of the logarithm

    def candidates(self, image: Triangles) -> tuple[Ints, Ints]:
        """Pairs (image triangle, catalogue triangle) that agree, mirror images included; sorted by the first."""
        ratios, log_size = _features(image)
        cell = np.floor(ratios / (2 * self.shape_tolerance) - 0.5).astype(np.int64)
        # The tolerance is half a cell, so that candidates lie in at most four cells.
        cells = cell[:, None] + np.array([(0, 0), (0, 1), (1, 0), (1, 1)])
        keys = _key(cells, log_size[:, None], self.shape_tolerance).ravel()
        first = np.searchsorted(self.key, keys - self.size_tolerance)
        count = np.searchsorted(self.key, keys + self.size_tolerance) - first
        total = np.cumsum(count)
        left = np.repeat(np.arange(len(keys)) // 4, count)
        right = np.arange(total[-1] if len(total) else 0) + np.repeat(first - (total - count), count)
        off = np.abs(self.ratios[right] - ratios.astype(np.float32)[left])
        agree = np.maximum(off[:, 0], off[:, 1]) < self.shape_tolerance
        return left[agree], right[agree]


def shape_index(found: Triangles, shape_tolerance: float, size_tolerance: float) -> ShapeIndex:
    """Index of the triangles; the tolerances are relative."""
    ratios, log_size = _features(found)
    key = _key(np.floor(ratios / (2 * shape_tolerance)).astype(np.int64), log_size, shape_tolerance)
    order = np.argsort(key)
    return ShapeIndex(found.take(order), key[order], ratios[order].astype(np.float32), shape_tolerance, size_tolerance)


def _features(found: Triangles) -> tuple[Array, Array]:
    """The two shorter sides over the longest (n, 2), and its logarithm (n,)."""
    longest = found.sides_rad[:, 2]
    return found.sides_rad[:, :2] / longest[:, None], np.log(longest)


def _key(cell: Ints, log_size: Array, shape_tolerance: float) -> Array:
    """Cells (..., 2) first, sizes (...) within them."""
    cells_in_row = int(1.0 / (2 * shape_tolerance)) + 3
    size = np.clip(log_size - SMALLEST_LOG, 1.0, CELL_LENGTH - 1.0)
    return (cell[..., 0] * cells_in_row + cell[..., 1]) * CELL_LENGTH + size
