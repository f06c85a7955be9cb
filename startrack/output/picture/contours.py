"""Contours of a grid of values by marching squares."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.core.types import Array, Bools

CORNERS = (0, 0), (0, 1), (1, 1), (1, 0)  # of a square of four values, clockwise: row and column; a side begins at each


def contour_lines(values: NDArray[Any], level: float, inside: Bools) -> list[Array]:
    """Contours of `values` (H, W) at a `level`, each as places (n, 2), column and row; a closed one ends as it begins.

    They cross the squares of values that are all in the mask `inside` (H, W); at a saddle the low values are joined.
    Marching squares, after Lorensen and Cline, "Marching Cubes" (SIGGRAPH 1987).
    """
    height, width = values.shape

    def corners(of_all: Bools) -> list[Bools]:
        return [of_all[row : height - 1 + row, column : width - 1 + column] for row, column in CORNERS]

    high, whole = corners(values > level), np.logical_and.reduce(corners(inside))
    sides = np.array([0, values.size + 1, width, values.size])  # numbers of a square's sides, less that of its corner
    following = dict[int, int]()
    for k in range(4):  # a line enters at a side from high to low, clockwise, and leaves at the next one back
        row, column = np.nonzero(whole & high[k] & ~high[k - 3])
        back = np.where(~high[k - 1], 1, np.where(~high[k - 2], 2, 3))[row, column]
        number = row * width + column
        following |= zip((number + sides[k]).tolist(), (number + sides[k - back]).tolist(), strict=True)
    lines = []
    for begin in [*(following.keys() - set(following.values())), *following]:  # open lines, then closed ones
        line = [begin]
        while line[-1] in following:
            line.append(following.pop(line[-1]))
        if len(line) > 1:
            lines.append(_crossings(values, level, np.array(line)))
    return lines


def _crossings(values: NDArray[Any], level: float, side: NDArray[np.int64]) -> Array:
    """Where a level crosses sides (n,), which are numbered by their first value, those down a column after the rest."""
    down, first = np.divmod(side, values.size)
    row, column = np.divmod(first, values.shape[1])
    a, b = values[row, column].astype(float), values[row + down, column + 1 - down]
    part = (level - a) / (b - a)
    return np.stack([column + part * (1 - down), row + part * down], axis=-1)
