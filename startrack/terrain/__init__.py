"""Ground that hides stars: one kind of terrain per file, behind one protocol."""

from startrack.terrain.cylinder import Cylinder
from startrack.terrain.io import load_terrain, terrain_from_dict
from startrack.terrain.protocol import Terrain

__all__ = ["Cylinder", "Terrain", "load_terrain", "terrain_from_dict"]
