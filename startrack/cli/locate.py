"""`startrack locate`: image to position and attitude."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

from startrack.cli.common import Outcome, add_image_flags, camera_of, read, result_path, run_images
from startrack.errors import BadInput

FORMAT = "startrack.fix/1"


def add_parser(subparsers: Any) -> None:
    """Add `locate` to the commands of the `startrack` parser."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "locate",
        help="image to position and attitude",
        description="Locate the camera in each image: detect, identify, attitude, evidence, position. Camera, terrain "
        "and time come from flags, else from NAME.json beside the image, else from its header. Writes NAME.fix.json, "
        "NAME.stars.ecsv, NAME.wcs, NAME.corr and NAME.annotated.png.",
    )
    add_image_flags(parser)
    parser.add_argument("-t", "--terrain", metavar="FILE", help="terrain file, or the name of a shipped one")


def run(args: argparse.Namespace) -> int:
    """Locate every image; the exit code of the worst."""
    return run_images(args, FORMAT, lambda path, stem: _one(path, stem, args))


def _one(path: str, stem: str, args: argparse.Namespace) -> Outcome:
    from startrack.catalog import load_catalog
    from startrack.pipeline import locate
    from startrack.report import (
        result_dict,
        summary_line,
        verbose_text,
        write_annotated,
        write_json,
        write_star_table,
        write_wcs,
    )
    from startrack.terrain import load_terrain

    start = time.perf_counter()
    exposure = read(path, args)
    camera = camera_of(exposure)
    if exposure.terrain is None:
        raise BadInput("bad_terrain", "no terrain file is known: give -t FILE or a sidecar with terrain")
    terrain = load_terrain(exposure.terrain)
    out = result_path(args, stem, ".fix.json", exposure)
    read_ms = 1e3 * (time.perf_counter() - start)
    result = locate(exposure, camera, terrain, load_catalog())
    result.timing_ms["read"] = read_ms
    record = result_dict(result)
    if result.light is not None:
        write_star_table(out.with_name(f"{stem}.stars.ecsv"), result)
        write_wcs(out.with_name(f"{stem}.wcs"), out.with_name(f"{stem}.corr"), result)
    if not args.no_plots:
        write_annotated(out.with_name(f"{stem}.annotated.png"), result)
    write_json(out, record)
    line = summary_line(result, seconds=time.perf_counter() - start)
    if args.verbose:
        line += "\n" + verbose_text(result) + f"\n  written to {Path(args.dir)}/{stem}.*"
    return Outcome(result.status, result.reason, line, record)
