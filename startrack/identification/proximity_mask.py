"""Mask of the celestial sphere: whether a bright star is near a direction, by one look-up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from startrack.core.types import Array, Bools


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
        _mark_runs(edges, row[inside][touched], star_ascension[inside][touched], half)
    near = np.cumsum(edges[:, :-1], axis=1) > 0
    weight = np.cos(((np.arange(rows) + 0.5) / rows - 0.5) * np.pi)
    return ProximityMask(near, float(near.mean(axis=1) @ weight / weight.sum()))


def _mark_runs(edges: NDArray[np.int32], row: NDArray[np.int64], ascension: Array, half: Array) -> None:
    """Mark where runs of cells (right ascension +- half, modulo a full circle) begin (+1) and end (-1)."""
    columns = edges.shape[1] - 1
    first = np.ceil(((ascension - half) / (2 * np.pi) + 0.5) * columns - 0.5).astype(np.int64)
    last = np.floor(((ascension + half) / (2 * np.pi) + 0.5) * columns - 0.5).astype(np.int64) + 1
    for wrap in (-columns, 0, columns):
        a, b = np.clip(first + wrap, 0, columns), np.clip(last + wrap, 0, columns)
        some = b > a
        np.add.at(edges, (row[some], a[some]), 1)
        np.add.at(edges, (row[some], b[some]), -1)
