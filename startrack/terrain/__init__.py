"""Ground that hides stars: one kind of terrain per file, behind one protocol."""

from startrack.terrain.checks import require_bounds, require_horizons, require_terrain
from startrack.terrain.cylinder import Cylinder
from startrack.terrain.io import load_terrain, terrain_from_dict
from startrack.terrain.protocol import ForwardingTerrain, Terrain
from startrack.terrain.shape import ShapeError

__all__ = [
    "Cylinder", "ForwardingTerrain", "ShapeError", "Terrain", "load_terrain", "require_bounds", "require_horizons",
    "require_terrain", "terrain_from_dict",
]  # fmt: skip
