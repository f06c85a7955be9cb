"""`startrack terrain`: show a terrain, compute its horizons, make one from elevation data, state its errors."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from math import degrees, radians
from typing import TYPE_CHECKING, Any

from startrack.cli import flags, terrain_state
from startrack.cli.flags import Command, flag
from startrack.cli.progress import prepare
from startrack.core.compilation import announce_compilation
from startrack.core.errors import BadInput
from startrack.core.files import check_output, file_stem, make_folder

if TYPE_CHECKING:
    from startrack.frames import Site
    from startrack.terrain import Terrain

START = """usage: startrack terrain ACTION ... (startrack terrain ACTION --help)

look             startrack terrain show shackleton --at 0 0                  properties, relief, a horizon
your own map     startrack terrain import MAP.tif -o NAME.toml --latitude DEG --longitude DEG
state errors     startrack terrain state NAME.toml                           what its file leaves out widens circles
prepare          startrack terrain build NAME.toml                           its horizons, before the first fix"""


def _show_terrain(args: argparse.Namespace) -> int:
    from startrack.terrain import load_terrain

    terrain = load_terrain(args.terrain)
    position = None if args.at is None else (args.at[0], args.at[1])
    facts = _facts_of(terrain) | ({} if position is None else _view_facts(terrain, position))
    if not args.no_plots:
        facts["files"] = _draw(args, terrain, position)
    _print_facts(args, facts)
    return 0


def _draw(args: argparse.Namespace, terrain: Terrain, position: tuple[float, float] | None) -> list[str]:
    """Write the relief and, seen from a position, the horizon; the paths of the pictures."""
    from PIL import Image

    from startrack.output import horizon_picture, relief_picture

    out, stem = make_folder(args.dir, "bad_terrain"), file_stem(terrain.name)
    pictures = {out / f"{stem}.relief.png": relief_picture(terrain, position)}
    if position is not None:
        pictures[out / f"{stem}.horizon.png"] = horizon_picture(terrain, position)
    for path, picture in pictures.items():
        check_output(path, overwrite=True, reason="bad_terrain")
        Image.fromarray(picture).save(path)
    return [str(path) for path in pictures]


def _build_tables(args: argparse.Namespace) -> int:
    from startrack.terrain import load_terrain

    for name in args.terrain:
        terrain = load_terrain(name)
        facts: dict[str, Any] = {"name": terrain.name, "horizons": None}
        if terrain.table_path is not None:
            if args.force:
                terrain.discard_table()
            start = time.perf_counter()
            known = terrain.is_prepared
            prepare(terrain, args)
            facts |= {"horizons": str(terrain.table_path), "known_before": known}
            facts["seconds"] = round(time.perf_counter() - start, 1)
        _print_facts(args, facts)
    return 0


def _import_map(args: argparse.Namespace) -> int:
    from startrack.terrain import import_maps, load_terrain

    announce_compilation()
    half = list(args.half or [])
    half += [30_000.0 if not half and k == 0 else 300_000.0 for k in range(len(half), len(args.maps))]
    imported = import_maps(
        args.maps, args.output, latitude_rad=radians(args.latitude), longitude_rad=radians(args.longitude), half_m=half,
        radius_m=args.radius, scale=args.scale or (), offset_m=args.offset or (), height_sigma_m=args.sigma,
        compare=args.compare, camera_height_m=args.camera_height, overwrite=args.overwrite,
    )  # fmt: skip
    facts = _facts_of(load_terrain(imported.path))
    facts |= {"sigma_from": imported.errors.origin, "sigma_comment": imported.errors.comment}
    _print_facts(args, facts | {"files": [str(imported.path)], "warnings": imported.warnings})
    return 0


def _print_facts(args: argparse.Namespace, facts: dict[str, Any]) -> None:
    for warning in () if args.quiet else facts.get("warnings", ()):
        print(f"{facts['name']}: {warning}", file=sys.stderr, flush=True)
    if args.json:
        print(json.dumps({"format": "startrack.terrain/1", **facts}), flush=True)
    elif not args.quiet:
        print("\n".join(_lines_of(facts)), flush=True)


def _facts_of(terrain: Terrain) -> dict[str, Any]:
    """Origin, search area, and the properties of the ground. Raises BadInput (bad_terrain) without an origin."""
    site = _site_of(terrain)
    return {
        "name": terrain.name,
        "body": site.body,
        "latitude_deg": round(degrees(site.latitude_rad), 6),
        "longitude_deg": round(degrees(site.longitude_rad), 6),
        "search_radius_m": terrain.search_radius_m,
        "camera_height_m": terrain.camera_height_m,
        **terrain.facts(),
    }


def _site_of(terrain: Terrain) -> Site:
    if terrain.site is None:
        raise BadInput("bad_terrain", f"{terrain.name} has no origin on a body")
    return terrain.site


def _view_facts(terrain: Terrain, position: tuple[float, float]) -> dict[str, Any]:
    """Ground and horizon at a position (east, north) [m]. Raises BadInput outside the terrain."""
    import numpy as np

    from startrack.frames import latlon_from_enu

    point = np.array([position])
    if not terrain.allowed(point)[0]:
        raise BadInput("bad_terrain", f"E {position[0]:g} m, N {position[1]:g} m is outside the terrain")
    ground = float(terrain.ground_m(point)[0])
    horizon = np.degrees(terrain.horizon_rad(point, np.radians(np.arange(720) / 2)))
    lat, lon = latlon_from_enu(_site_of(terrain), *position, ground)
    return {
        "east_m": position[0], "north_m": position[1], "ground_m": round(ground, 2),
        "place_latitude_deg": round(float(np.degrees(lat)), 6), "place_longitude_deg": round(float(np.degrees(lon)), 6),
        "horizon_min_deg": round(float(horizon.min()), 3), "horizon_max_deg": round(float(horizon.max()), 3),
    }  # fmt: skip


def _lines_of(facts: dict[str, Any]) -> Iterator[str]:
    """The properties that `facts` holds, as lines with units."""
    yield facts["name"]
    if "body" in facts:
        origin = _latlon_text(facts["latitude_deg"], facts["longitude_deg"])
        yield f"  origin    {origin}, on the {facts['body'].title()}"
        yield (
            f"  search    within {facts['search_radius_m']:g} m of the origin, the camera "
            f"{facts['camera_height_m']:g} m above the ground"
        )
    if "depth_m" in facts:
        yield f"  ground    a cylinder, {facts['diameter_m']:g} m across and {facts['depth_m']:g} m deep"
    for m in facts.get("maps", ()):
        rows, columns = m["posts"]
        yield (
            f"  map       {m['file']}: {columns} x {rows} posts, {m['post_m']:g} m apart, {m['projection']}, "
            f"heights {m['lowest_m']:g} to {m['highest_m']:g} m"
        )
    if "height_sigma_m" in facts:
        sources = {"map": " (from the map's roughness)", "comparison": " (compared with a finer map)"}
        source, shared = sources.get(facts.get("sigma_from", ""), ""), facts["horizon_sigma_deg"]
        all_around = "three times what these make of it" if shared is None else f"{shared:g} degrees"
        single = f"of single posts {facts['height_sigma_m']:g} m{source}"
        yield f"  errors    {single}; shared by the whole horizon {all_around}"
    if facts.get("horizons") and "seconds" in facts:
        how = "were known" if facts["known_before"] else f"computed in {facts['seconds']:g} s"
        yield f"  horizons  {how}: {facts['horizons']}"
    elif facts.get("horizons"):
        ready = facts["horizons_ready"]
        yield f"  horizons  {facts['horizons'] if ready else 'not computed yet: startrack terrain build'}"
    elif "horizons" in facts:
        yield "  horizons  need no table: those of a cylinder are a formula"
    if "ground_m" in facts:
        yield (
            f"  position     E {facts['east_m']:g} m, N {facts['north_m']:g} m: "
            f"{_latlon_text(facts['place_latitude_deg'], facts['place_longitude_deg'])}, "
            f"ground at {facts['ground_m']:g} m, "
            f"horizon {facts['horizon_min_deg']:g} to {facts['horizon_max_deg']:g} degrees"
        )
    for file in facts.get("files", ()):
        yield f"  written   {file}"


def _latlon_text(latitude_deg: float, longitude_deg: float) -> str:
    north, east = "N" if latitude_deg >= 0 else "S", "E" if longitude_deg >= 0 else "W"
    return f"{abs(latitude_deg):.5f} {north}, {abs(longitude_deg):.5f} {east}"


COMMANDS = (
    Command(
        "terrain", None, "show a terrain, compute its horizons, make one from elevation data, state its errors",
        "TERRAIN is a terrain file (a path if it ends in .toml or contains a separator) or a shipped name.",
        start=START,
        actions=(
            Command(
                "show", _show_terrain, "properties, relief and, with --at, the horizon from a position", None,
                {
                    "input": (
                        flag("terrain TERRAIN", "terrain file, or the name of a shipped one"),
                        flag("--at EAST NORTH", "a position [m]", float, nargs=2),
                    ),
                    "output": (flags.DIR, flags.JSON, flags.NO_PLOTS),
                    "more": flags.MORE,
                },
                "startrack terrain show shackleton --at 0 0",
            ),
            Command(
                "build", _build_tables, "compute the horizons now; otherwise the first fix does", None,
                {
                    "input": (
                        flag("terrain TERRAIN", "terrain file, or the name of a shipped one", nargs="+"),
                        flag("--force", "even if they are known"),
                    ),
                    "more": (flags.JSON, *flags.MORE),
                },
                "startrack terrain build shackleton",
            ),
            Command(
                "import", _import_map, "a terrain file and GeoTIFF crops from elevation data", None,
                {
                    "input": (
                        flag("maps MAP", "GeoTIFF, COG, PDS label ..., the finest first", nargs="+"),
                        flag("--latitude DEG", "of the origin, north positive", float, required=True),
                        flag("--longitude DEG", "east positive", float, required=True),
                        flag("--radius M", "of the search area", float, default=10_000.0),
                        flag("--half M", "half side of each map's crop (30000 for the first, then 300000)", float,
                             nargs="+"),
                        flag("--scale M", "metres per unit of each map; needed for integers if the files lack it",
                             float, nargs="+"),
                        flag("--offset M", "height of value 0 of each map, if the files lack it", float, nargs="+"),
                        flag("--sigma M", "error of single posts (default: measured or estimated)", float),
                        flag(
                            "--compare MAP",
                            "finer maps of a part of the ground, to measure the errors (the shipped maps are tried "
                            "anyway)", nargs="+", default=(),
                        ),
                        flag("--camera-height M", "above the ground", float, default=1.5),
                    ),
                    "output": (
                        flag("-o --output NAME.toml", "the terrain file", required=True), flags.OVERWRITE, flags.JSON,
                    ),
                    "more": flags.MORE,
                },
                "startrack terrain import MAP.tif -o own.toml --latitude -89.5 --longitude 130",
            ),
            terrain_state.COMMAND,
        ),
    ),
)  # fmt: skip
