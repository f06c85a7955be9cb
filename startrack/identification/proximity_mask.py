"""A map of the sky that tells at once whether a bright star is near a direction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from startrack.types import Array, Bools


@dataclass(frozen=True)
class SkyMap:
    """Cells of declination and right ascension: is a star of the list near?"""

    near: NDArray[np.bool_]  # (rows, columns)
    covered: float  # part of the sphere

    def __call__(self, rays_icrs: Array) -> Bools:
        """Whether a star is near the unit vectors (..., 3)."""
        rows, columns = self.near.shape
        row = ((np.arcsin(np.clip(rays_icrs[..., 2], -1, 1)) / np.pi + 0.5) * rows).astype(np.int64)
        column = ((np.arctan2(rays_icrs[..., 1], rays_icrs[..., 0]) / (2 * np.pi) + 0.5) * columns).astype(np.int64)
        return self.near[np.minimum(row, rows - 1), np.minimum(column, columns - 1)]


def sky_map(rays_icrs: Array, radius_rad: float) -> SkyMap:
    """The map of the stars (n, 3): cells of half the radius, those whose middle is within the radius of a star.

    Painted row by row: a cap reaches over cos(x) = (cos radius - sin d sin d0) / (cos d cos d0) in right ascension.
    """
    rows = int(np.ceil(2 * np.pi / radius_rad))
    columns = 2 * rows
    star_declination = np.arcsin(np.clip(rays_icrs[:, 2], -1, 1))
    star_ascension = np.arctan2(rays_icrs[:, 1], rays_icrs[:, 0])
    edges = np.zeros((rows, columns + 1), dtype=np.int32)
    middle_row = np.floor((star_declination / np.pi + 0.5) * rows).astype(np.int64)
    for offset in range(-3, 4):
        row = middle_row + offset
        inside = (row >= 0) & (row < rows)
        declination = ((row[inside] + 0.5) / rows - 0.5) * np.pi
        at = star_declination[inside]
        cosine = (np.cos(radius_rad) - np.sin(declination) * np.sin(at)) / (np.cos(declination) * np.cos(at))
        touched = cosine < 1
        half = np.arccos(np.clip(cosine[touched], -1, 1))
        _paint(edges, row[inside][touched], star_ascension[inside][touched], half)
    near = np.cumsum(edges[:, :-1], axis=1) > 0
    weight = np.cos(((np.arange(rows) + 0.5) / rows - 0.5) * np.pi)
    return SkyMap(near, float(near.mean(axis=1) @ weight / weight.sum()))


def _paint(edges: NDArray[np.int32], row: NDArray[np.int64], ascension: Array, half: Array) -> None:
    """Mark where runs of cells (middle +- half, going round the sky) begin (+1) and end (-1)."""
    columns = edges.shape[1] - 1
    first = np.ceil(((ascension - half) / (2 * np.pi) + 0.5) * columns - 0.5).astype(np.int64)
    last = np.floor(((ascension + half) / (2 * np.pi) + 0.5) * columns - 0.5).astype(np.int64) + 1
    for turn in (-columns, 0, columns):
        a, b = np.clip(first + turn, 0, columns), np.clip(last + turn, 0, columns)
        some = b > a
        np.add.at(edges, (row[some], a[some]), 1)
        np.add.at(edges, (row[some], b[some]), -1)
