"""Catalogue patterns for an unknown scale: triangles of bright stars by shape, and a mask of the sky near them."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.core.time_limit import check_time
from startrack.core.types import Array, Bools, Ints, Stars
from startrack.estimation.false_alarm import log_p_value
from startrack.identification.index import keep_last_few
from startrack.identification.triangles import Triangles, number_runs, separate_bright_stars, triangles

CELL_LENGTH = 16.0  # range of the logarithm of the size within a cell of the key
SMALLEST_LOG = -0.75 * CELL_LENGTH  # most of it for sizes below a radian
HEMISPHERE_SR = 2 * np.pi
STARS_OF_HEMISPHERE = 200  # pattern stars of the whole sky for a lens with half of it in view
MAX_PATTERN_STARS = 25_000
SIDE_OF_HEMISPHERE_RAD = np.radians(45.0)
NEAR_OF_HEMISPHERE_RAD = np.radians(1.5)
NARROWEST_NEAR_RAD = NEAR_OF_HEMISPHERE_RAD / 10
MAX_DETECTIONS = 100  # of which patterns are made


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
        left, right = np.repeat(np.arange(len(keys)) // 4, count), number_runs(first, count)
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


@dataclass(frozen=True)
class ProximityMask:
    """Cells of declination and right ascension that are near a star."""

    near: NDArray[np.bool_]  # (rows, columns)
    sky_fraction: float  # of the sphere that is near a star

    def __call__(self, rays_icrs: Array) -> Bools:
        """Whether a star is near the unit vectors (..., 3)."""
        rows, columns = self.near.shape
        row = ((np.arcsin(np.clip(rays_icrs[..., 2], -1, 1)) / np.pi + 0.5) * rows).astype(np.int64)
        column = ((np.arctan2(rays_icrs[..., 1], rays_icrs[..., 0]) / (2 * np.pi) + 0.5) * columns).astype(np.int64)
        return self.near[np.minimum(row, rows - 1), np.minimum(column, columns - 1)]


def proximity_mask(rays_icrs: Array, radius_rad: float) -> ProximityMask:
    """Mask of the stars (n, 3): cells of half the radius whose centre is within the radius of a star.

    Filled row by row: at declination d a cap about d0 spans cos(x) = (cos radius - sin d sin d0) / (cos d cos d0) in
    right ascension to both sides.
    """
    rows = int(np.ceil(2 * np.pi / radius_rad))
    columns = 2 * rows
    star_declination = np.arcsin(np.clip(rays_icrs[:, 2], -1, 1))
    star_ascension = np.arctan2(rays_icrs[:, 1], rays_icrs[:, 0])
    edges = np.zeros((rows, columns + 1), dtype=np.int16)
    middle_row = np.floor((star_declination / np.pi + 0.5) * rows).astype(np.int64)
    for offset in range(-3, 4):
        row = middle_row + offset
        inside = (row >= 0) & (row < rows)
        declination = ((row[inside] + 0.5) / rows - 0.5) * np.pi
        at = star_declination[inside]
        cosine = (np.cos(radius_rad) - np.sin(declination) * np.sin(at)) / (np.cos(declination) * np.cos(at))
        touched = cosine < 1
        half = np.arccos(np.clip(cosine[touched], -1, 1))
        # Runs of cells (right ascension +- half, modulo a full circle) begin with +1 and end with -1.
        row, ascension = row[inside][touched], star_ascension[inside][touched]
        first = np.ceil(((ascension - half) / (2 * np.pi) + 0.5) * columns - 0.5).astype(np.int64)
        last = np.floor(((ascension + half) / (2 * np.pi) + 0.5) * columns - 0.5).astype(np.int64) + 1
        for wrap in (-columns, 0, columns):
            a, b = np.clip(first + wrap, 0, columns), np.clip(last + wrap, 0, columns)
            some = b > a
            np.add.at(edges, (row[some], a[some]), 1)
            np.add.at(edges, (row[some], b[some]), -1)
    near = np.cumsum(edges[:, :-1], axis=1, dtype=np.int16) > 0
    weight = np.cos(((np.arange(rows) + 0.5) / rows - 0.5) * np.pi)
    return ProximityMask(near, float(near.mean(axis=1) @ weight / weight.sum()))


@dataclass(frozen=True)
class ShapePatterns:
    """Triangles of the brightest catalogue stars by shape, and a mask of the sky near these stars."""

    star: Ints  # (m,) indices in Stars
    rays_icrs: Array  # (m, 3)
    longest_side_rad: float
    triangles: ShapeIndex
    mask: ProximityMask

    @cached_property
    def log_p_table(self) -> Array:
        """log P(at least k of n random directions near a bright star), [n, k]."""
        n, k = np.meshgrid(np.arange(MAX_DETECTIONS + 1), np.arange(MAX_DETECTIONS + 1), indexing="ij")
        return log_p_value(k, n, self.mask.sky_fraction, free=0)


@dataclass(frozen=True)
class PatternSizes:
    """Numbers of catalogue patterns for a field of view."""

    stars: int  # brightest of the whole sky
    longest_side_rad: float
    near_rad: float  # a detection this close to a bright star is a hit
    shape_tolerance: float
    size_tolerance: float


def wide_sizes(field_sr: float) -> PatternSizes:
    """Sizes for an unknown distorting lens: few stars, wide tolerances."""
    fraction = min(field_sr / HEMISPHERE_SR, 1.0)
    stars = int(min(STARS_OF_HEMISPHERE / fraction, MAX_PATTERN_STARS))
    side, near = SIDE_OF_HEMISPHERE_RAD * np.sqrt(fraction), NEAR_OF_HEMISPHERE_RAD * np.sqrt(fraction)
    return PatternSizes(stars, float(side), float(max(near, NARROWEST_NEAR_RAD)), 0.02, 0.13)


def narrow_sizes(field_sr: float, stars_in_field: int, side_of_field: float) -> PatternSizes:
    """Sizes for a lens close to a pinhole: narrow tolerances.

    `stars_in_field`: pattern stars in a field; `side_of_field`: longest side over the field's diameter.
    """
    diameter = float(np.sqrt(4 * field_sr / np.pi))
    stars = int(min(stars_in_field * 4 * np.pi / field_sr, MAX_PATTERN_STARS))
    near = max(0.015 * diameter, NARROWEST_NEAR_RAD)
    return PatternSizes(stars, side_of_field * diameter, float(near), 0.004, 0.12)


def patterns_for(stars: Stars, sizes: PatternSizes) -> ShapePatterns:
    """Patterns of the stars (sorted, brightest first).

    The last few are kept; the key rounds the stars' directions, so that catalogues of nearby years share them.
    """

    def compute() -> ShapePatterns:
        star = separate_bright_stars(stars, sizes.stars)
        rays = stars.rays_icrs[star]
        found = triangles(rays, sizes.longest_side_rad * (1 + sizes.size_tolerance))
        check_time()
        index = shape_index(found, sizes.shape_tolerance, sizes.size_tolerance)
        check_time()
        return ShapePatterns(star, rays, sizes.longest_side_rad, index, proximity_mask(rays, sizes.near_rad))

    key = (sizes, len(stars), np.round(stars.rays_icrs[:500], 3).tobytes())
    return keep_last_few(_KEPT, key, compute)


_KEPT: OrderedDict[Any, ShapePatterns] = OrderedDict()
