"""Height maps in terrain files: the keys of [dem], and the terrain that they describe."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from startrack.core.declaration import Either, Flag, List, Number, Table, Text
from startrack.core.limits import check_memory
from startrack.terrain import shape
from startrack.terrain.protocol import Terrain

FILE = Text(max_chars=4000, is_path=True)
HEIGHT = Number(low=-shape.MAX_LENGTH_M, high=shape.MAX_LENGTH_M)
SLOPES = List(each=Number(low=-600.0, high=600.0), count=2)
DEM_TABLE = Table(
    description="Height maps on the Moon's sphere or the Earth's ellipsoid; heights above it, posts at pixel "
                "centres, bilinear between.",
    keys={
        "file": Either(kinds=(FILE, List(each=FILE, least=1, most=100)), required=True,
                       description="finest first"),
        "height_sigma_m": replace(shape.AMOUNT, description="of single posts, independent of each other; if "
                                  "absent 0, with a warning"),
        **{fact.key: fact.limits for fact in (shape.BIAS, shape.STRETCH, shape.VERTICAL)},
        shape.WAVES.key: shape.WAVES_LIMITS,
        shape.OFFSETS.key: shape.OFFSETS.limits,
        "scale": Number(low=-1e6, high=1e6, description="metres per unit, in place of what the files state"),
        "offset_m": Number(low=-shape.MAX_LENGTH_M, high=shape.MAX_LENGTH_M,
                           description="height of value 0, in place of what the files state"),
        "unusual_heights": Flag(description="the heights are right, though flatter, higher or lower than the "
                                "body's ground; no value is taken for a void that the file does not state"),
        "cut_out_m": replace(shape.AMOUNT, description="voids up to so wide are roofs and trees that were cut "
                             "out of the maps: the ground there is interpolated between the posts around"),
        "geoid_m": Either(kinds=(HEIGHT, List(each=HEIGHT, least=1, most=100)), description="height of the "
                          "geoid above the ellipsoid at the origin, if heights are above the geoid; a list: "
                          "of each map, 0 where they are above the ellipsoid; earth only"),
        "geoid_slope_arcsec": Either(kinds=(SLOPES, List(each=SLOPES, least=1, most=100)), description="rise "
                                     "of the geoid above the ellipsoid to the east and to the north; a list of "
                                     "pairs: of each map; earth only"),
        "highest_beyond_m": replace(HEIGHT, description="ground off the maps is no higher; if absent 8850 on "
                                    "the earth, and on the moon the highest of the maps"),
    },
)  # fmt: skip


def make_height_map(keys: dict[str, Any], folder: Path, **shared: Any) -> Terrain:
    """The terrain of the checked `keys` of a file with a [dem]; see `io.Kind`. Raises BadInput bad_terrain."""
    from startrack.terrain.height_map import HeightMap
    from startrack.terrain.maps.reading import read_map, require_origin

    check_memory()  # its kernels come later: OpenBLAS ends the process before them
    dem, rover, search, site = keys["dem"], keys["rover"], keys["search"], shared["site"]
    near, files = (site.latitude_rad, site.longitude_rad), paths_of(dem["file"], folder)
    scaling = {key: dem[key] for key in ("scale", "offset_m", "unusual_heights") if key in dem}
    maps = tuple(read_map(file, near=near, body=site.body, **scaling) for file in files)
    require_origin(maps, *near)
    if "cut_out_m" in dem:
        from startrack.terrain.ground import fill_cut_out

        maps = tuple(fill_cut_out(one, dem["cut_out_m"]) for one in maps)
    on_earth = {}
    if site.body == "earth":
        from startrack.terrain.maps.ellipsoid import check_height, maps_above_ellipsoid

        check_height(site, maps)
        air = keys.get("air", {})
        maps = maps_above_ellipsoid(maps, dem, site)
        on_earth = {
            "terrestrial_refraction_1": air.get("terrestrial_refraction", shape.REFRACTION_1),
            "terrestrial_refraction_sigma_1": air.get(shape.REFRACTION.key),
        }
    default_highest = shape.EARTH_HIGHEST_M if site.body == "earth" else -np.inf
    return HeightMap(
        **shared,
        maps=maps,
        search_radius_m=search.get("radius_m", Terrain.search_radius_m),
        height_sigma_m=dem.get("height_sigma_m", 0.0),
        height_sigma_is_stated="height_sigma_m" in dem,
        horizon_sigma_common_rad=shape.radians(dem.get("horizon_sigma_deg")),
        stretch_sigma_1=dem.get("stretch_sigma_1"),
        vertical_sigma_rad=shape.radians(dem.get("vertical_sigma_deg")),
        waves_sigma_rad=_waves(dem.get(shape.WAVES.key)),
        map_offset_sigma_m=dem.get(shape.OFFSETS.key),
        camera_height_sigma_m=rover.get("camera_height_sigma_m"),
        most_slope_rad=float(np.radians(search["max_slope_deg"])),
        glare_rad=tuple((float(np.radians(a)), float(np.radians(b))) for a, b in search.get("glare_deg", ())),
        highest_beyond_m=dem.get("highest_beyond_m", default_highest),
        **on_earth,
    )


def paths_of(files: str | tuple[str, ...], folder: Path) -> list[Path]:
    """Paths of the `files` of a key, one or several, relative to `folder`."""
    return [folder / file for file in ((files,) if isinstance(files, str) else files)]


def _waves(degrees: float | tuple[float, ...] | None) -> tuple[float, ...] | None:
    """Sigmas [rad] of waves 1 to 8 of the horizon's error, from what a file states."""
    if degrees is None:
        return None
    return tuple(np.radians(shape.sigmas_of_waves(degrees) if isinstance(degrees, float) else degrees).tolist())
