"""Horizons by Embree, an independent ray tracer: bisection in elevation between rays that hit and rays that miss.

The surface is that of the terrain's finest map, each bilinear cell as n x n x 2 triangles, finer near the camera: the
camera stands 1.5 m above the ground, and 0.1 m at a distance of 50 m is a tenth of a degree.
"""

from __future__ import annotations

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from startrack.frames import enu_from_latlon
from startrack.terrain import HeightMap

LOWEST, HIGHEST = np.radians(-15.0), np.radians(60.0)
HALVINGS = 22  # to 2e-5 degrees
NEAR_M, NEAR_SIDE_M, FAR_SIDE_M = 900.0, 7.5, 48.0  # sides of the triangles


class EmbreeHorizons:
    """Elevations of the horizon seen from a position on the ground."""

    def __init__(self, terrain: HeightMap, position_m: np.ndarray) -> None:
        up = float(terrain.ground_m(position_m)) + terrain.camera_height_m
        self.eye = np.array([*position_m, up])
        finest = terrain.maps[0]
        rows, columns = (n - 1 for n in finest.heights_m.shape)
        cells = np.stack(np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"), axis=-1).reshape(-1, 2)
        away = np.hypot(*(vertices(terrain, cells + 0.5)[:, :2] - position_m).T)
        self.scene = EmbreeScene(robust=True)
        near = away < NEAR_M
        self.meshes = [
            TriangleMesh(self.scene, *mesh(terrain, cells[which], round(cut), self.eye))
            for which, cut in ((near, finest.post_m / NEAR_SIDE_M), (~near, max(finest.post_m / FAR_SIDE_M, 2)))
        ]

    def horizon_rad(self, azimuths_rad: np.ndarray) -> np.ndarray:
        """(n,) at azimuths (n,)."""
        low, high = np.full(len(azimuths_rad), LOWEST), np.full(len(azimuths_rad), HIGHEST)
        origins = np.zeros((len(low), 3), dtype=np.float32)
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            level = np.cos(middle)
            rays = np.column_stack([level * np.sin(azimuths_rad), level * np.cos(azimuths_rad), np.sin(middle)])
            hit = self.scene.run(origins, rays.astype(np.float32), query="INTERSECT") >= 0
            low, high = np.where(hit, middle, low), np.where(hit, high, middle)
        return (low + high) / 2


def vertices(terrain: HeightMap, row_column: np.ndarray) -> np.ndarray:
    """Points (..., 3) in enu [m] of the finest map's surface at fractional rows and columns."""
    finest = terrain.maps[0]
    latitude, longitude = finest.projection.latlon_from_xy(*finest.xy(row_column))
    return np.asarray(enu_from_latlon(terrain.site, latitude, longitude, finest.sample(row_column)))


def mesh(terrain: HeightMap, cells: np.ndarray, cut: int, eye_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) relative to the camera [m], float32, and triangles (m, 3) of cells (k, 2)."""
    line = np.arange(cut + 1) / cut
    inside = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)
    points = vertices(terrain, cells[:, None, :] + np.minimum(inside, 1 - 1e-9)) - eye_m
    corner = (np.arange(cut)[:, None] * (cut + 1) + np.arange(cut)).ravel()
    two = np.concatenate([
        np.column_stack([corner, corner + 1, corner + cut + 1]),
        np.column_stack([corner + 1, corner + cut + 2, corner + cut + 1]),
    ])  # fmt: skip
    first = np.arange(len(cells))[:, None, None] * len(inside)
    return points.reshape(-1, 3).astype(np.float32), (first + two).reshape(-1, 3).astype(np.int32)
