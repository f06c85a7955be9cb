"""Terrain files (TOML): read and check. The format is in docs/formats.md."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from startrack.frames import Site
from startrack.paths import resolve_named
from startrack.terrain.cylinder import Cylinder
from startrack.terrain.protocol import Terrain
from startrack.types import BadInput

FORMAT = 1


def load_terrain(name_or_path: str | Path) -> Terrain:
    """The terrain of a file (a path if it ends in .toml or contains a separator) or of a shipped name.

    Raises BadInput bad_terrain naming the cause.
    """
    path = resolve_named(name_or_path, "terrain", "bad_terrain")
    try:
        return terrain_from_dict(tomllib.loads(path.read_text(encoding="utf-8")), default_name=path.stem)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as cause:
        raise BadInput("bad_terrain", f"{path}: not a TOML file: {cause}") from cause
    except BadInput as cause:
        raise BadInput("bad_terrain", f"{path}: {cause}") from cause


def terrain_from_dict(d: dict[str, Any], default_name: str = "terrain") -> Terrain:
    """The terrain of a terrain file's keys. Raises BadInput bad_terrain naming the key that is wrong."""
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
    if "cylinder" not in d:
        what = "[dem] height maps cannot be read by this version" if "dem" in d else "it names no ground"
        raise BadInput("bad_terrain", f"{what}: give a [cylinder] with diameter_m and depth_m")
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
        name=str(d.get("name", default_name)),
        site=site,
        diameter_m=diameter,
        depth_m=depth,
        camera_height_m=camera_height,
        search_radius_m=search,
        depth_sigma_m=depth_sigma,
        diameter_sigma_m=diameter_sigma,
    )


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
