"""Ground that hides stars: one kind of terrain per file, behind one protocol."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from startrack.terrain.cylinder import Cylinder
from startrack.terrain.io import (
    GROUNDS,
    GroundBrightness,
    StateableError,
    files_of_terrain,
    load_terrain,
    site_of_terrain,
    state_errors,
    stateable_errors,
    terrain_from_dict,
)
from startrack.terrain.io import KEYS as TERRAIN_KEYS
from startrack.terrain.maps.projections import EQUIRECTANGULAR, STEREOGRAPHIC, EarthProjection, Projection
from startrack.terrain.maps.raster import Raster
from startrack.terrain.protocol import (
    ForwardingTerrain,
    Rim,
    Terrain,
    TerrainFile,
    require_bounds,
    require_horizons,
    require_place,
    require_site,
    require_terrain,
)
from startrack.terrain.shape import DIAMETER, NO_POST, WAVES, ExpectedCrests, GroundErrors, ShapeError

if TYPE_CHECKING:
    from startrack.terrain.ground import cell_posts
    from startrack.terrain.height_map import HeightMap
    from startrack.terrain.imports.import_map import import_maps
    from startrack.terrain.maps.reading import Grid, is_geotiff, map_of_array, read_map
    from startrack.terrain.maps.writing import can_write_maps, write_bands, write_map

__all__ = [
    "DIAMETER", "EQUIRECTANGULAR", "GROUNDS", "NO_POST", "STEREOGRAPHIC", "TERRAIN_KEYS", "WAVES", "Cylinder",
    "EarthProjection", "ExpectedCrests", "ForwardingTerrain", "Grid", "GroundBrightness", "GroundErrors", "HeightMap",
    "Projection", "Raster", "Rim", "ShapeError", "StateableError", "Terrain", "TerrainFile", "can_write_maps",
    "cell_posts", "files_of_terrain", "import_maps", "is_geotiff", "load_terrain", "map_of_array", "read_map",
    "require_bounds", "require_horizons", "require_place", "require_site", "require_terrain", "site_of_terrain",
    "state_errors", "stateable_errors", "terrain_from_dict", "write_bands", "write_map",
]  # fmt: skip
_LAZY_MODULES = {  # of names that few programs use: imported at the first use
    "Grid": "maps.reading", "HeightMap": "height_map",
    "can_write_maps": "maps.writing", "cell_posts": "ground", "import_maps": "imports.import_map",
    "is_geotiff": "maps.reading", "map_of_array": "maps.reading", "read_map": "maps.reading",
    "write_bands": "maps.writing", "write_map": "maps.writing",
}  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in _LAZY_MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_LAZY_MODULES[name]}"), name)
