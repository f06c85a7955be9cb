"""Catalogue patterns for an unknown scale: triangles of bright stars by their shape."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.core.limits import check_time
from startrack.core.types import Array, Ints, Stars
from startrack.identification.index import keep_last_few
from startrack.identification.triangles import Triangles, number_runs, separate_bright_stars, triangles

CELL_LENGTH = 16.0  # range of the logarithm of the size within a cell of the key
SMALLEST_LOG = -0.75 * CELL_LENGTH  # most of it for sizes below a radian
MOST_TRIANGLES = 800_000  # of an index, which take half a second
TRIANGLES_1 = 0.0134  # over the cube of the number of stars and the fourth power of the side; of Hipparcos, 3 to 10 deg
MOST_CANDIDATES = 200_000  # pairs of triangles in a cell, a tenth of which agree; beyond it more stars do not decide


@dataclass(frozen=True)
class PatternSizes:
    """Numbers of catalogue patterns for a field of view."""

    stars: int  # brightest of the whole sky
    longest_side_rad: float
    shape_tolerance: float  # of the ratios of sides


@dataclass(frozen=True)
class PatternKind:
    """Patterns of a field of any size."""

    stars_in_field: int
    side_of_field: float  # longest side over the field's diameter
    shape_tolerance: float

    def sizes(self, field_sr: float) -> PatternSizes:
        """The sizes for a field of this solid angle."""
        diameter_rad = float(np.sqrt(4 * field_sr / np.pi))
        side_rad = self.side_of_field * diameter_rad
        most = (MOST_TRIANGLES / TRIANGLES_1 / side_rad**4) ** (1 / 3)
        stars = int(min(self.stars_in_field * 4 * np.pi / field_sr, most))
        return PatternSizes(stars, side_rad, self.shape_tolerance)


BENT = PatternKind(60, 0.278, 0.02)  # of a lens whose bend is not known
STRAIGHT = PatternKind(24, 0.4, 0.004)  # of one that is nearly a pinhole
LONG = PatternKind(10, 0.8, 0.004)  # likewise, where few of the detections are stars


@dataclass(frozen=True)
class ShapeIndex:
    """Catalogue triangles sorted by a key: the cell of their two ratios of sides, then the logarithm of the size."""

    triangles: Triangles
    key: Array  # (n,) ascending
    ratios: NDArray[np.float32]  # (n, 2)
    shape_tolerance: float

    def candidates(self, image: Triangles, log_spread: float) -> tuple[Ints, Ints]:
        """Pairs (image triangle, catalogue triangle) that agree, mirror images included; sorted by the first.

        `log_spread`: largest difference of the logarithms of their sizes. About MOST_CANDIDATES, those of the earliest
        image triangles.
        """
        ratios, log_size = _features(image)
        cell = np.floor(ratios / (2 * self.shape_tolerance) - 0.5).astype(np.int64)
        # The tolerance is half a cell, so that candidates lie in at most four cells.
        cells = cell[:, None] + np.array([(0, 0), (0, 1), (1, 0), (1, 1)])
        keys = _key(cells, log_size[:, None], self.shape_tolerance).ravel()
        first = np.searchsorted(self.key, keys - log_spread)
        count = np.searchsorted(self.key, keys + log_spread) - first
        some = int(np.searchsorted(np.cumsum(count), MOST_CANDIDATES)) + 1
        first, count = first[:some], count[:some]
        left, right = np.repeat(np.arange(len(count)) // 4, count), number_runs(first, count)
        off = np.abs(self.ratios[right] - ratios.astype(np.float32)[left])
        agree = np.maximum(off[:, 0], off[:, 1]) < self.shape_tolerance
        return left[agree], right[agree]


def shape_index(found: Triangles, shape_tolerance: float) -> ShapeIndex:
    """Index of the triangles; the tolerance is relative."""
    ratios, log_size = _features(found)
    key = _key(np.floor(ratios / (2 * shape_tolerance)).astype(np.int64), log_size, shape_tolerance)
    order = np.argsort(key)
    return ShapeIndex(found.take(order), key[order], ratios[order].astype(np.float32), shape_tolerance)


def _features(found: Triangles) -> tuple[Array, Array]:
    """The two shorter sides over the longest (n, 2), and its logarithm (n,)."""
    longest = found.sides_rad[:, 2]
    return found.sides_rad[:, :2] / longest[:, None], np.log(longest)


def _key(cell: Ints, log_size: Array, shape_tolerance: float) -> Array:
    """Numbers (...) that sort by cell (..., 2) first, by the logarithm of the size (...) within a cell."""
    cells_in_row = int(1.0 / (2 * shape_tolerance)) + 3
    size = np.clip(log_size - SMALLEST_LOG, 1.0, CELL_LENGTH - 1.0)
    return (cell[..., 0] * cells_in_row + cell[..., 1]) * CELL_LENGTH + size


@dataclass(frozen=True)
class ShapePatterns:
    """Triangles of the brightest catalogue stars by shape."""

    star: Ints  # (m,) indices in Stars
    rays_icrs: Array  # (m, 3)
    longest_side_rad: float
    index: ShapeIndex


def patterns_for(stars: Stars, sizes: PatternSizes) -> ShapePatterns:
    """Patterns of the stars (sorted, brightest first).

    The last few are kept; the key rounds the stars' directions, so that catalogues of nearby years share them.
    """

    def compute() -> ShapePatterns:
        star = separate_bright_stars(stars, sizes.stars)
        rays = stars.rays_icrs[star]
        found = triangles(rays, sizes.longest_side_rad)
        check_time()
        return ShapePatterns(star, rays, sizes.longest_side_rad, shape_index(found, sizes.shape_tolerance))

    key = (sizes, len(stars), np.round(stars.rays_icrs[:500], 3).tobytes())
    return keep_last_few(_KEPT, key, compute)


_KEPT: OrderedDict[Any, ShapePatterns] = OrderedDict()
