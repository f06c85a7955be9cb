"""`startrack terrain`: show a terrain, compute its horizons, make one from elevation data, state its errors."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from math import degrees, radians
from typing import Any

import numpy as np

from startrack import terrain as terrains
from startrack.cli.console import duration_text
from startrack.cli.flags import amount
from startrack.cli.images import prepare
from startrack.cli.inputs import STATED_ERRORS, state_flag
from startrack.core import files
from startrack.core.errors import BadInput, length_text, one_line
from startrack.frames import Site, latlon_from_enu
from startrack.terrain import StateableError, Terrain, load_terrain, require_place

Values = dict[tuple[str, str], float | bool]  # by table and key


def show(args: argparse.Namespace) -> int:
    """Print a terrain's properties, and draw it; 0."""
    terrain = load_terrain(args.terrain)
    position = None if args.at is None else (args.at[0], args.at[1])
    facts = _facts_of(terrain) | ({} if position is None else _view_facts(terrain, position))
    if not args.no_plots:
        facts["files"] = _draw(args, terrain, position)
    _print_facts(args, facts)
    return 0


def _draw(args: argparse.Namespace, terrain: Terrain, position: tuple[float, float] | None) -> list[str]:
    """Write the relief and, seen from a position, the horizon; the paths of the pictures."""
    from startrack.output import horizon_picture, png_bytes, relief_picture

    out, stem = files.make_folder(args.dir, "bad_terrain"), files.file_stem(terrain.name)
    pictures = {out / f"{stem}.relief.png": relief_picture(terrain, position)}
    if position is not None:
        pictures[out / f"{stem}.horizon.png"] = horizon_picture(terrain, position)
    for path, picture in pictures.items():
        files.write_atomically(path, png_bytes(picture), overwrite=True, reason="bad_terrain")
    return [str(path) for path in pictures]


def build(args: argparse.Namespace) -> int:
    """Compute the horizons of terrains; 0."""
    for name in args.terrain:
        terrain = load_terrain(name)
        facts: dict[str, Any] = {"name": terrain.name, "horizons": None}
        if terrain.table_path is not None:
            if args.force:
                terrain.discard_table()
            known = terrain.is_prepared
            facts |= {key: value for key, value in terrain.facts().items() if key == "maps_end"} | _cost_facts(terrain)
            start = time.perf_counter()
            prepare(terrain, args)
            facts |= {"horizons": str(terrain.table_path), "known_before": known}
            facts["seconds"] = round(time.perf_counter() - start, 1)
        _print_facts(args, facts)
    return 0


def import_map(args: argparse.Namespace) -> int:
    """Make a terrain file from elevation data; 0."""
    half = list(args.half or [])
    half += [30_000.0 if not half and k == 0 else 300_000.0 for k in range(len(half), len(args.maps))]
    if args.post is None and (args.crs or args.corner):
        args.usage_error("--crs and --corner are of an array: give --post too")
    corner = None if args.corner is None else (args.corner[0], args.corner[1])
    grid = None if args.post is None else terrains.Grid(post=args.post, crs=args.crs, corner=corner)
    imported = terrains.import_maps(
        args.maps, args.output, latitude_rad=radians(args.latitude), longitude_rad=radians(args.longitude), half_m=half,
        radius_m=args.radius, scale=args.scale or (), offset_m=args.offset or (), height_sigma_m=args.sigma,
        compare=args.compare, camera_height_m=args.camera_height, highest_beyond_m=args.highest_beyond,
        geoid_grid=args.geoid, grid=grid, cut_out_m=args.cut_out, unusual_heights=args.unusual_heights,
        overwrite=args.overwrite,
    )  # fmt: skip
    facts = _facts_of(load_terrain(imported.path))
    facts |= {"sigma_from": imported.errors.origin, "sigma_comment": imported.errors.comment}
    _print_facts(args, facts | {"files": [str(imported.path)], "warnings": imported.warnings})
    return 0


def _print_facts(args: argparse.Namespace, facts: dict[str, Any]) -> None:
    for warning in () if args.quiet else facts.get("warnings", ()):
        print(one_line(f"{facts['name']}: {warning}"), file=sys.stderr, flush=True)
    if args.json:
        print(json.dumps({"format": "startrack.terrain/1", **facts}), flush=True)
    elif not args.quiet:
        print("\n".join(map(one_line, _lines_of(facts))), flush=True)


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
        **_cost_facts(terrain),
    }


def _cost_facts(terrain: Terrain) -> dict[str, Any]:
    """About how long work on a `terrain` takes, as JSON values; {} where nothing takes long."""
    costs_s = {what: float(f"{seconds:.2g}") for what, seconds in terrain.costs_s().items()}
    return {"about_s": costs_s} if costs_s else {}


def _cost_text(about_s: dict[str, float]) -> str:
    """About how long the table of horizons takes, where it is not there, and the position of an image."""
    texts = {"horizons": "for the table of horizons, once", "frame": "for the position of an image"}
    return ", ".join(f"about {duration_text(seconds)} {texts[what]}" for what, seconds in about_s.items())


def _end_lines(ends: dict[str, Any]) -> Iterator[str]:
    """Where the maps end, how high unknown ground beyond counts, and the azimuths in which it may hide stars."""
    source = {"map": "the maps' highest", "stated": "highest_beyond_m"}[ends["highest_beyond_from"]]
    yield (
        f"  ends      {length_text(ends['nearest_m'], 3)} from the origin, where they are nearest (azimuth "
        f"{ends['nearest_azimuth_deg']}); ground beyond may be up to {ends['highest_beyond_m']} m high ({source})"
    )
    for one in ends["missing"]:
        yield (
            f"  missing   azimuths {one['from_deg']} to {one['to_deg']}: the maps end "
            f"{length_text(one['nearest_m'], 3)} off, and ground beyond could stand up to {one['up_to_deg']:g} degrees "
            "high; no evidence is taken below that"
        )


def _site_of(terrain: Terrain) -> Site:
    if terrain.site is None:
        raise BadInput("bad_terrain", f"{terrain.name} has no origin on a body")
    return terrain.site


def _view_facts(terrain: Terrain, position: tuple[float, float]) -> dict[str, Any]:
    """Ground and horizon at a position (east, north) [m]. Raises BadInput outside the terrain."""
    from startrack.output import ranges_deg, sectors_off_map

    require_place(terrain, *position)
    point = np.array([position])
    ground = float(terrain.ground_m(point)[0])
    horizon = np.degrees(terrain.horizon_rad(point, np.radians(np.arange(720) / 2)))
    lat, lon = latlon_from_enu(_site_of(terrain), *position, ground)
    return {
        "east_m": position[0], "north_m": position[1], "ground_m": round(ground, 2),
        "place_latitude_deg": round(float(np.degrees(lat)), 6), "place_longitude_deg": round(float(np.degrees(lon)), 6),
        "horizon_min_deg": round(float(horizon.min()), 3), "horizon_max_deg": round(float(horizon.max()), 3),
        "horizon_off_map_deg": ranges_deg(sectors_off_map(terrain, np.array(position))),
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
    if "maps_end" in facts:
        yield from _end_lines(facts["maps_end"])
    if "height_sigma_m" in facts:
        sources = {
            "map": " (from the map's roughness)", "comparison": " (compared with a finer map)",
            "product": " (published, and from the map's roughness)",
        }  # fmt: skip
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
    if "about_s" in facts:
        yield f"  takes     {_cost_text(facts['about_s'])}, on this machine"
    if "ground_m" in facts:
        yield (
            f"  position     E {facts['east_m']:g} m, N {facts['north_m']:g} m: "
            f"{_latlon_text(facts['place_latitude_deg'], facts['place_longitude_deg'])}, "
            f"ground at {facts['ground_m']:g} m, "
            f"horizon {facts['horizon_min_deg']:g} to {facts['horizon_max_deg']:g} degrees"
        )
        if facts["horizon_off_map_deg"]:
            from startrack.output import ranges_text

            yield (
                f"  off map      azimuths {ranges_text(facts['horizon_off_map_deg'])}: the maps end, and ground beyond "
                "could stand above this horizon"
            )
    for file in facts.get("files", ()):
        yield f"  written   {file}"


def _latlon_text(latitude_deg: float, longitude_deg: float) -> str:
    north, east = "N" if latitude_deg >= 0 else "S", "E" if longitude_deg >= 0 else "W"
    return f"{abs(latitude_deg):.5f} {north}, {abs(longitude_deg):.5f} {east}"


def state(args: argparse.Namespace) -> int:
    """Write the errors; 0, or 2 where there is nothing to write and nobody to ask. Raises BadInput, BadOutput."""
    path = files.resolve_named(args.file, "terrain", "bad_terrain")
    text = files.read_text(path, "bad_terrain")
    try:
        known = terrains.stateable_errors(text)
        missing = [error for error in known if error.is_missing]
        values = _values_of_flags(args, known, text)
        if not values and missing and sys.stdin.isatty():
            values = _ask(missing)
        if values:
            text = terrains.state_errors(text, values)
            # Refuses what would be no terrain.
            terrains.terrain_from_dict(
                files.parse_toml(text, "bad_terrain"), default_name=path.stem, folder=path.parent
            )
    except BadInput as cause:
        raise BadInput(cause.reason, f"{files.printable(path)}: {cause}") from cause
    if values:
        files.write_atomically(path, text.encode("utf-8"), overwrite=True, reason="bad_terrain")
    _show(args, str(path), missing, {key: value for (_, key), value in values.items()})
    return 2 if missing and not values and not sys.stdin.isatty() else 0


def _values_of_flags(args: argparse.Namespace, known: list[StateableError], text: str) -> Values:
    """What the flags state. Wrong usage: keys of another kind of terrain, and keys that the file states."""
    tables = {error.key: error.table for error in known}
    given = {key: getattr(args, key) for key in STATED_ERRORS if getattr(args, key) is not None}
    for key in given:
        if key not in tables:
            args.usage_error(f"{state_flag(key)}: {args.file} has no {key}: it describes another kind of ground")
    is_cylinder = "depth_sigma_m" in tables
    if args.exact and not is_cylinder:
        given = {error.key: 0.0 for error in known if error.is_missing} | given
    values: Values = {(tables[key], key): value for key, value in given.items()}
    if args.exact and is_cylinder and "exact" not in files.parse_toml(text, "bad_terrain")["cylinder"]:
        values["cylinder", "exact"] = True
    return values


def _ask(missing: list[StateableError]) -> Values:
    """Answers on the terminal; an empty one leaves an error unstated."""
    print("One standard deviation of each; 0 if it is exact; Enter leaves it out.")
    values: Values = {}
    for error in missing:
        try:
            while answer := input(f"{error.key}, {error.meaning} (left out: {error.default}): ").strip():
                try:
                    values[error.table, error.key] = amount(answer)
                    break
                except (argparse.ArgumentTypeError, ValueError) as cause:
                    print(f"  {cause}")
        except EOFError:
            continue
    return values


def _show(args: argparse.Namespace, path: str, missing: list[StateableError], written: dict[str, float | bool]) -> None:
    """Print what was written and what is left out."""
    left = [error for error in missing if error.key not in written and "exact" not in written]
    if args.json:
        unstated = [{"fact": error.key, "default": error.default} for error in left]
        print(json.dumps({"format": "startrack.terrain/1", "file": path, "stated": written, "unstated": unstated}))
    elif not args.quiet:
        lines = [f"  written   {key} = {str(value).lower()}" for key, value in written.items()]
        lines += [f"  left out  {error.key}, {error.meaning}: {error.default}" for error in left]
        print("\n".join([one_line(path), *(lines or ["  states every error"])]))
    if left and not written and not sys.stdin.isatty():
        flags = " ".join(f"{state_flag(error.key)} {STATED_ERRORS[error.key]}" for error in left)
        print(f"startrack terrain state {one_line(path)}: give {flags}, or --exact", file=sys.stderr)
