"""`startrack terrain`: show a terrain, compute its horizons, make one from elevation data, state its errors."""

from __future__ import annotations

import argparse
import json
import sys
import time
from math import radians
from pathlib import Path
from typing import TYPE_CHECKING, Any

from startrack.cli.common import DEFAULT_OUT
from startrack.cli.preparation import prepare
from startrack.cli.terrain_facts import facts_of, lines_of, view_facts
from startrack.cli.terrain_state import add_state_parser, state_terrain
from startrack.core.compilation import announce_compilation
from startrack.core.files import check_output, file_stem, make_folder

if TYPE_CHECKING:
    from startrack.terrain import Terrain


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add `terrain` to the commands of the `startrack` parser."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "terrain", help="show a terrain, compute its horizons, make one from elevation data, state its errors",
        description="TERRAIN is a terrain file (a path if it ends in .toml or contains a separator) or a shipped name.",
    )  # fmt: skip
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    show = actions.add_parser("show", help="properties, relief and, with --at, the horizon from a position")
    show.add_argument("terrain", metavar="TERRAIN")
    show.add_argument("--at", nargs=2, type=float, metavar=("EAST", "NORTH"), help="a position [m]")
    build = actions.add_parser("build", help="compute the horizons now; otherwise the first fix does")
    build.add_argument("terrain", nargs="+", metavar="TERRAIN")
    build.add_argument("--force", action="store_true", help="even if they are known")
    imported = actions.add_parser("import", help="a terrain file and GeoTIFF crops from elevation data")
    imported.add_argument("maps", nargs="+", metavar="MAP", help="GeoTIFF, COG, PDS label ..., the finest first")
    imported.add_argument("-o", "--output", required=True, metavar="NAME.toml")
    imported.add_argument("--latitude", type=float, required=True, metavar="DEG", help="of the origin, north positive")
    imported.add_argument("--longitude", type=float, required=True, metavar="DEG", help="east positive")
    imported.add_argument(
        "--radius", type=float, default=10_000.0, metavar="M", help="of the search area (%(default).0f)"
    )
    imported.add_argument(
        "--half",
        nargs="+",
        type=float,
        metavar="M",
        help="half side of each map's crop (30000 for the first, then 300000)",
    )
    imported.add_argument(
        "--scale", nargs="+", type=float, metavar="M",
        help="metres per unit of each map; needed for integers if the files lack it",
    )  # fmt: skip
    imported.add_argument(
        "--offset", nargs="+", type=float, metavar="M", help="height of value 0 of each map, if the files lack it"
    )
    imported.add_argument(
        "--sigma", type=float, metavar="M", help="error of single posts (default: measured or estimated)"
    )
    imported.add_argument(
        "--compare", nargs="+", default=(), metavar="MAP",
        help="finer maps of a part of the ground, to measure the errors (the shipped maps are tried anyway)",
    )  # fmt: skip
    imported.add_argument(
        "--camera-height", type=float, default=1.5, metavar="M", help="above the ground (%(default)g)"
    )
    state = add_state_parser(actions)
    for action in (show, build, imported, state):
        action.add_argument("--json", action="store_true", help="print one JSON object per terrain")
        action.add_argument(
            "-v", "--verbose", action="count", default=0, help="more output; tracebacks of internal errors"
        )
        action.add_argument("-q", "--quiet", action="store_true", help="print errors only")
    show.add_argument("-D", "--dir", metavar="OUT", default=DEFAULT_OUT, help="folder of the pictures (%(default)s)")
    show.add_argument("--no-plots", action="store_true", help="no pictures")
    parser.set_defaults(run=run)
    imported.add_argument("-O", "--overwrite", action="store_true", help="replace files")
    return parser


def run(args: argparse.Namespace) -> int:
    """Run the action; its exit code."""
    return {"show": _show_terrain, "build": _build_tables, "import": _import_map, "state": state_terrain}[args.action](
        args
    )


def _show_terrain(args: argparse.Namespace) -> int:
    from startrack.terrain import load_terrain

    terrain = load_terrain(args.terrain)
    position = None if args.at is None else (args.at[0], args.at[1])
    facts = facts_of(terrain) | view_facts(terrain, position)
    if not args.no_plots:
        facts["files"] = [str(path) for path in _pictures(args, terrain, position)]
    _print_facts(args, facts)
    return 0


def _pictures(args: argparse.Namespace, terrain: Terrain, position: tuple[float, float] | None) -> list[Path]:
    from startrack.output.picture.panorama import horizon_picture
    from startrack.output.picture.terrain_picture import relief_picture

    out, stem = make_folder(args.dir, "bad_terrain"), file_stem(terrain.name)
    pictures = {out / f"{stem}.relief.png": relief_picture(terrain, position)}
    if position is not None:
        pictures[out / f"{stem}.horizon.png"] = horizon_picture(terrain, position)
    from PIL import Image

    for path, picture in pictures.items():
        check_output(path, overwrite=True, reason="bad_terrain")
        Image.fromarray(picture).save(path)
    return list(pictures)


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
    facts = facts_of(load_terrain(imported.path))
    facts |= {"sigma_from": imported.errors.origin, "sigma_comment": imported.errors.comment}
    _print_facts(args, facts | {"files": [str(imported.path)], "warnings": imported.warnings})
    return 0


def _print_facts(args: argparse.Namespace, facts: dict[str, Any]) -> None:
    for warning in () if args.quiet else facts.get("warnings", ()):
        print(f"{facts['name']}: {warning}", file=sys.stderr, flush=True)
    if args.json:
        print(json.dumps({"format": "startrack.terrain/1", **facts}), flush=True)
    elif not args.quiet:
        print("\n".join(lines_of(facts)), flush=True)
