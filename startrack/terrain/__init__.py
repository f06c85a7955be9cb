"""Ground that hides stars: one kind of terrain per file, behind one protocol."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from startrack.terrain.checks import require_bounds, require_horizons, require_place, require_site, require_terrain
from startrack.terrain.cylinder import Cylinder
from startrack.terrain.ground_brightness import GroundBrightness
from startrack.terrain.io import KEYS as TERRAIN_KEYS
from startrack.terrain.io import MAKERS, files_of_terrain, load_terrain, site_of_terrain, terrain_from_dict
from startrack.terrain.projection import EQUIRECTANGULAR, STEREOGRAPHIC, Projection
from startrack.terrain.protocol import ForwardingTerrain, Rim, Terrain, TerrainFile
from startrack.terrain.raster import Raster
from startrack.terrain.shape import DIAMETER, NO_POST, WAVES, ExpectedCrests, GroundErrors, ShapeError

if TYPE_CHECKING:
    from startrack.terrain.array_map import Grid, map_of_array
    from startrack.terrain.earth_projection import EarthProjection
    from startrack.terrain.ground import cell_posts
    from startrack.terrain.height_map import HeightMap
    from startrack.terrain.import_map import import_maps
    from startrack.terrain.map_reading import read_map
    from startrack.terrain.map_writing import can_write_maps, write_bands, write_map
    from startrack.terrain.plain_tiff import is_geotiff
    from startrack.terrain.state_file import StateableError, state_errors, stateable_errors

__all__ = [
    "DIAMETER", "EQUIRECTANGULAR", "MAKERS", "NO_POST", "STEREOGRAPHIC", "TERRAIN_KEYS", "WAVES", "Cylinder",
    "EarthProjection", "ExpectedCrests", "ForwardingTerrain", "Grid", "GroundBrightness", "GroundErrors", "HeightMap",
    "Projection", "Raster", "Rim", "ShapeError", "StateableError", "Terrain", "TerrainFile", "can_write_maps",
    "cell_posts", "files_of_terrain", "import_maps", "is_geotiff", "load_terrain", "map_of_array", "read_map",
    "require_bounds", "require_horizons", "require_place", "require_site", "require_terrain", "site_of_terrain",
    "state_errors", "stateable_errors", "terrain_from_dict", "write_bands", "write_map",
]  # fmt: skip
_LAZY_MODULES = {  # of names that few programs use: imported at the first use
    "EarthProjection": "earth_projection", "Grid": "array_map", "HeightMap": "height_map",
    "StateableError": "state_file", "can_write_maps": "map_writing", "cell_posts": "ground",
    "import_maps": "import_map", "is_geotiff": "plain_tiff", "map_of_array": "array_map", "read_map": "map_reading",
    "state_errors": "state_file", "stateable_errors": "state_file", "write_bands": "map_writing",
    "write_map": "map_writing",
}  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in _LAZY_MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_LAZY_MODULES[name]}"), name)
