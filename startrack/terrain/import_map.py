"""From elevation data to a terrain of one's own: crops as GeoTIFF beside a terrain file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from startrack.terrain.geotiff import write_map
from startrack.terrain.map_error import error_between_posts_m
from startrack.terrain.map_resolution import carried_spacing
from startrack.terrain.protocol import Terrain
from startrack.terrain.raster import Raster
from startrack.terrain.raster_io import read_map
from startrack.types import BadInput

RIM_RADII = 1.5  # of the search area: so far away most of the rim stands
COARSE_PART = 0.2  # of the search radius


def import_maps(
    maps: Sequence[str | Path], output: str | Path, *, latitude_rad: float, longitude_rad: float,
    half_m: Sequence[float], radius_m: float, scale: Sequence[float] = (), offset_m: Sequence[float] = (),
    height_sigma_m: float | None = None, camera_height_m: float = 1.5, overwrite: bool = False,
) -> Path:  # fmt: skip
    """Write the terrain file and, beside it, a crop of each map, NAME-1.tif the finest; the terrain file's path.

    half_m: half the side of each crop about the origin [m]. scale and offset_m of each map, the finest first, where the
    files themselves do not say. height_sigma_m: None takes what the roughness of the map that makes the horizon lets
    expect between its posts. Raises BadInput bad_terrain: nothing is then written.
    """
    import tomli_w

    from startrack.terrain.io import terrain_from_dict

    output = Path(output)
    if output.suffix != ".toml":
        raise BadInput("bad_terrain", f"{output}: a terrain file's name ends in .toml")
    at = latitude_rad, longitude_rad
    latitude_deg, longitude_deg = (round(float(np.degrees(angle)), 9) for angle in at)
    if not abs(latitude_deg) <= 90:
        raise BadInput("bad_terrain", f"latitude {latitude_deg:g} is not within -90..90")
    files = [output.with_name(f"{output.stem}-{k + 1}.tif") for k in range(len(maps))]
    there = [path for path in (output, *files) if path.exists()]
    if there and not overwrite:
        raise BadInput("bad_terrain", f"{there[0]} is there already: choose another name, or replace it with -O")
    crops = []
    for k, (source, half) in enumerate(zip(maps, half_m, strict=True)):
        own = {"scale": scale[k] if k < len(scale) else None, "offset_m": offset_m[k] if k < len(offset_m) else None}
        crop = read_map(source, near=at, **own).around(*at, half)
        if min(crop.heights_m.shape) < 2:
            raise BadInput("bad_terrain", f"{source}: it does not reach {latitude_deg:g}, {longitude_deg:g}")
        crops.append(replace(crop, source=Path(source).name))
    sigma_m = _sigma_m(crops, radius_m) if height_sigma_m is None else float(height_sigma_m)
    d = {
        "format": 1, "name": output.stem, "body": "moon",
        "origin": {"latitude_deg": latitude_deg, "longitude_deg": longitude_deg},
        "dem": {"file": [path.name for path in files], "height_sigma_m": sigma_m},
        "rover": {"camera_height_m": float(camera_height_m)}, "search": {"radius_m": float(radius_m)},
    }  # fmt: skip
    output.parent.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    try:
        for path, crop in zip(files, crops, strict=True):
            written.append(path)
            write_map(path, crop)
        terrain_from_dict(d, folder=output.parent)
        output.write_text(tomli_w.dumps(d), encoding="utf-8")
    except BaseException:
        for path in written:
            path.unlink(missing_ok=True)
        raise
    return output


def _sigma_m(crops: Sequence[Raster], radius_m: float) -> float:
    """Error of single posts [m], two digits of it, by the map that makes the horizon."""
    return float(f"{error_between_posts_m(_of_the_rim(crops, radius_m)):.2g}")


def _of_the_rim(crops: Sequence[Raster], radius_m: float) -> Raster:
    """The finest map that may hold the rim, or the last."""
    rims = [crop for crop in crops if 0.5 * min(crop.heights_m.shape) * crop.post_m >= RIM_RADII * radius_m]
    return (rims or crops[-1:])[0]


def smoothness(terrain: Terrain) -> list[str]:
    """A warning where the map that makes the horizon carries no ground as fine as its posts."""
    maps = getattr(terrain, "maps", ())
    if not maps:
        return []
    rim = _of_the_rim(maps, terrain.search_radius_m)
    spacing = carried_spacing(rim.heights_m.astype(np.float64))
    if spacing <= 1:
        return []
    error_m = error_between_posts_m(rim, spacing)
    return [
        f"{rim.source or 'the map'} looks interpolated or smoothed: posts are {rim.post_m:.3g} m apart, the ground in "
        f"them about {spacing * rim.post_m:.2g} m, which lets expect errors of {error_m:.2g} m (height_sigma_m is "
        f"{getattr(terrain, 'height_sigma_m', 0.0):.2g} m); give the map it was made from, or a known error"
    ]


def coarseness(terrain: Terrain) -> list[str]:
    """A warning where the posts stand so far apart that the search area has hardly any shape."""
    post_m = getattr(terrain, "finest_post_m", 0.0)
    if post_m <= COARSE_PART * terrain.search_radius_m:
        return []
    return [
        f"posts are {post_m:.0f} m apart in a search area of {terrain.search_radius_m:.0f} m: such a map hardly tells "
        "one place from another; give a finer one"
    ]
