"""Ground that hides stars: one kind of terrain per file, behind one protocol."""

from startrack.terrain.cylinder import Cylinder
from startrack.terrain.io import load_terrain, terrain_from_dict
from startrack.terrain.protocol import ForwardingTerrain, Terrain, require_bounds, require_horizons, require_terrain

__all__ = [
    "Cylinder", "ForwardingTerrain", "Terrain", "load_terrain", "require_bounds", "require_horizons", "require_terrain",
    "terrain_from_dict",
]  # fmt: skip
