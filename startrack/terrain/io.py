"""Terrain files (TOML): read and check. The format is in docs/formats.md."""

from __future__ import annotations

import tomllib
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from startrack.files import resolve_named
from startrack.frames import Site
from startrack.terrain.cylinder import Cylinder
from startrack.terrain.protocol import Terrain
from startrack.types import BadInput

FORMAT = 1
DEM_RADIUS_M = 10_000.0


def load_terrain(name_or_path: str | Path) -> Terrain:
    """The terrain of a file (a path if it ends in .toml or contains a separator) or of a shipped name.

    Raises BadInput bad_terrain naming the cause.
    """
    path = resolve_named(name_or_path, "terrain", "bad_terrain")
    try:
        text = path.read_text(encoding="utf-8")
        return _terrain_of(path.absolute(), text, _stamps(path.parent, tomllib.loads(text)))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as cause:
        raise BadInput("bad_terrain", f"{path}: not a TOML file: {cause}") from cause
    except BadInput as cause:
        raise BadInput("bad_terrain", f"{path}: {cause}") from cause


@lru_cache(maxsize=2)
def _terrain_of(path: Path, text: str, stamps: tuple[Any, ...]) -> Terrain:
    """Read once for many images: maps, packed ground and tables are some 0.3 GB and half a second."""
    return terrain_from_dict(tomllib.loads(text), default_name=path.stem, folder=path.parent)


def _stamps(folder: Path, d: dict[str, Any]) -> tuple[Any, ...]:
    """What changes when one of the maps does."""
    dem = d.get("dem")
    files = dem.get("file") if isinstance(dem, dict) else None
    paths = [folder / str(file) for file in (files if isinstance(files, list) else [files])]
    found = [path.stat() for path in paths if path.is_file()]
    return tuple((s.st_ino, s.st_size, s.st_mtime_ns) for s in found)


def terrain_from_dict(d: dict[str, Any], default_name: str = "terrain", folder: Path | None = None) -> Terrain:
    """The terrain of a terrain file's keys; maps are looked for in the folder.

    Raises BadInput bad_terrain naming the key that is wrong.
    """
    if d.get("format", FORMAT) != FORMAT:
        raise BadInput("bad_terrain", f"format {d['format']!r} is not known; this version reads format {FORMAT}")
    body = d.get("body")
    if body not in ("moon", "earth"):
        raise BadInput("bad_terrain", f"body must be moon or earth, not {body!r}")
    origin = _table(d, "origin")
    latitude = _number(origin, "latitude_deg")
    if abs(latitude) > 90:
        raise BadInput("bad_terrain", f"latitude_deg is {latitude:g}: not within -90..90")
    site = Site(
        body=body,
        latitude_rad=float(np.radians(latitude)),
        longitude_rad=float(np.radians(_number(origin, "longitude_deg"))),
        height_m=_number(origin, "height_m", 0.0),
    )
    if ("cylinder" in d) == ("dem" in d):
        what = "it names two grounds" if "dem" in d else "it names no ground"
        raise BadInput("bad_terrain", f"{what}: give a [cylinder] with diameter_m and depth_m, or a [dem] with file")
    name = str(d.get("name", default_name))
    return _dem(d, name, site, folder or Path()) if "dem" in d else _cylinder(d, name, site)


def _cylinder(d: dict[str, Any], name: str, site: Site) -> Cylinder:
    cylinder = _table(d, "cylinder")
    diameter, depth = _number(cylinder, "diameter_m"), _number(cylinder, "depth_m")
    camera_height = _number(_table(d, "rover", {}), "camera_height_m", 1.5)
    search = _number(_table(d, "search", {}), "radius_m", diameter / 2)
    if min(diameter, depth, search) <= 0 or not 0 <= camera_height < depth:
        raise BadInput("bad_terrain", "diameter_m, depth_m, radius_m must be positive, the camera below the rim")
    depth_sigma = _number(cylinder, "depth_sigma_m", 0.0)
    diameter_sigma = _number(cylinder, "diameter_sigma_m", 0.0)
    if not (0 <= depth_sigma < 0.2 * depth and 0 <= diameter_sigma < 0.2 * diameter):
        raise BadInput("bad_terrain", "depth_sigma_m and diameter_sigma_m must be below a fifth of what they belong to")
    return Cylinder(
        name=name,
        site=site,
        diameter_m=diameter,
        depth_m=depth,
        camera_height_m=camera_height,
        search_radius_m=search,
        depth_sigma_m=depth_sigma,
        diameter_sigma_m=diameter_sigma,
    )


def _dem(d: dict[str, Any], name: str, site: Site, folder: Path) -> Terrain:
    from startrack.terrain.height_map import HeightMap
    from startrack.terrain.raster_io import read_map

    if site.body != "moon":
        raise BadInput("bad_terrain", "[dem] maps are heights above the Moon's sphere: body must be moon")
    dem, search = _table(d, "dem"), _table(d, "search", {})
    files = dem.get("file")
    files = [files] if isinstance(files, str) else files
    if not isinstance(files, list) or not files or not all(isinstance(file, str) for file in files):
        raise BadInput("bad_terrain", "file must name a height map, or a list of them, finest first")
    numbers = {key: _number(dem, key) for key in ("scale", "offset_m") if key in dem}
    radius = _number(search, "radius_m", DEM_RADIUS_M)
    camera_height = _number(_table(d, "rover", {}), "camera_height_m", 1.5)
    sigma = _number(dem, "height_sigma_m", 0.0)
    common = _number(dem, "horizon_sigma_deg") if "horizon_sigma_deg" in dem else None
    slope = _number(search, "max_slope_deg", 90.0)
    if radius <= 0 or camera_height < 0 or sigma < 0 or not 0 <= (common or 0.0) < 10 or not 0 < slope <= 90:
        raise BadInput(
            "bad_terrain",
            "radius_m must be positive, camera_height_m, height_sigma_m and horizon_sigma_deg not negative, "
            "max_slope_deg within 0..90",
        )
    near = site.latitude_rad, site.longitude_rad
    return HeightMap(
        name=name,
        site=site,
        maps=tuple(read_map(folder / file, near=near, **numbers) for file in files),
        camera_height_m=camera_height,
        search_radius_m=radius,
        height_sigma_m=sigma,
        horizon_sigma_common_rad=None if common is None else float(np.radians(common)),
        most_slope_rad=float(np.radians(slope)),
        glare_rad=_glare(search),
    )


def _glare(search: dict[str, Any]) -> tuple[tuple[float, float], ...]:
    """Azimuth ranges [rad] of `glare_deg`, a list of pairs."""
    pairs = search.get("glare_deg", [])
    if not isinstance(pairs, list) or not all(isinstance(pair, list) and len(pair) == 2 for pair in pairs):
        raise BadInput("bad_terrain", "glare_deg must be a list of pairs of azimuths, [[from, to], ...]")
    named = [{"glare_deg": value} for pair in pairs for value in pair]
    ends = [float(np.radians(_number(one, "glare_deg"))) for one in named]
    return tuple(zip(ends[::2], ends[1::2], strict=True))


def _table(d: dict[str, Any], key: str, default: dict[str, Any] | None = None) -> dict[str, Any]:
    value = d.get(key, default)
    if not isinstance(value, dict):
        raise BadInput("bad_terrain", f"needs a table [{key}]")
    return value


def _number(d: dict[str, Any], key: str, default: float | None = None) -> float:
    value = d.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise BadInput("bad_terrain", f"{key} must be a number, not {value!r}")
    return float(value)
