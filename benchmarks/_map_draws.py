"""Ground that differs from its map, and positions on it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from startrack.core.types import Array
from startrack.terrain import HeightMap


def draw_ground(terrain: HeightMap, sigma_m: float, rng: np.random.Generator) -> HeightMap:
    """The map with an independent error at every post."""
    maps = [
        replace(one, heights_m=(one.heights_m + rng.normal(0.0, sigma_m, one.heights_m.shape)).astype(np.float32))
        for one in terrain.maps
    ]
    return replace(terrain, maps=tuple(maps), name="ground")


def draw_position(terrain: HeightMap, radius_m: float, slope_rad: float, rng: np.random.Generator) -> Array:
    """A position (2,) [m], uniform in a circle, where the map is not steeper than a slope."""
    while True:
        position = rng.uniform(-radius_m, radius_m, 2)
        if np.hypot(*position) < radius_m and terrain.slope_rad(position) < slope_rad:
            return position
