"""`startrack locate`: image to position and attitude."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from startrack.cli.common import (
    Outcome,
    add_image_flags,
    add_localizer_flags,
    check_localizer,
    read,
    result_path,
    run_images,
)
from startrack.cli.flag_types import geo_formats
from startrack.cli.preparation import prepare_reference

if TYPE_CHECKING:
    from startrack.chain import Settings

FORMAT = "startrack.fix/1"


def add_parser(subparsers: Any) -> None:
    """Add `locate` to the commands of the `startrack` parser."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "locate",
        help="image to position and attitude",
        description="Locate the camera in each image: detect, identify, attitude, evidence, position. Camera, terrain "
        "and time come from flags, else from NAME.json beside the image, else from its header. Writes NAME.fix.json, "
        "NAME.stars.ecsv, NAME.skyline.ecsv, NAME.wcs, NAME.corr, NAME.annotated.png and NAME.skyline.png.",
    )
    add_image_flags(parser)
    parser.add_argument("-t", "--terrain", metavar="FILE", help="terrain file, or the name of a shipped one")
    add_localizer_flags(parser)
    parser.add_argument(
        "--format", type=geo_formats, action="extend", metavar="geojson[,kml]", default=[],
        help="write NAME.geojson, NAME.kml or both too: position, 95 %% circle, attitude",
    )  # fmt: skip
    parser.add_argument(
        "--explain", action="store_true",
        help="of a refused or wide answer: what the image would need (exposure, facts, skyline in view, time, camera "
        "file, terrain), on stderr or in JSON as explain",
    )  # fmt: skip
    parser.add_argument("--fov", metavar="DEG", help=argparse.SUPPRESS)  # a flag of identify and calibrate
    parser.set_defaults(run=run, usage_error=parser.error)
    parser.add_argument("--report", action="store_true", help="add a page for a browser, as startrack report makes it")


def run(args: argparse.Namespace) -> int:
    """Locate every image; the exit code of the worst."""
    if args.fov is not None:
        args.usage_error(
            "a position needs the lens better than --fov finds it: make a camera file with startrack calibrate "
            f"--fov {args.fov} IMAGE... -o CAMERA.toml, then startrack locate -c CAMERA.toml"
        )
    from startrack.chain import Settings
    from startrack.core.types import PositionPrior

    check_localizer(args)
    near = None if args.near is None else PositionPrior(*args.near)
    settings = Settings(localizer=args.localizer, evidence_sources=args.evidence, near=near)
    code = run_images(args, FORMAT, lambda path, stem: _locate_image(path, stem, args, settings))
    if args.report:
        from startrack.cli.report import write_page_of_images

        write_page_of_images(args.dir, args.images)
    return code


def _locate_image(path: str, stem: str, args: argparse.Namespace, settings: Settings) -> Outcome:
    from startrack.chain import locate_exposure, with_timing
    from startrack.output import summary_line, verbose_text, write_geo, write_results
    from startrack.output.explain import explain

    start = time.perf_counter()
    exposure = read(path, args)
    out = result_path(args, stem, ".fix.json", exposure)
    read_ms = 1e3 * (time.perf_counter() - start)
    if exposure.time_utc is not None and exposure.camera is not None:
        prepare_reference(exposure.terrain, args)
    start = time.perf_counter()
    result = with_timing(locate_exposure(exposure, settings), read=read_ms)
    more = {"explain": explain(result)} if args.explain else {}
    record = write_results(result, out, plots=not args.no_plots, more=more)
    write_geo(out, result, args.format)
    line = summary_line(result, seconds=read_ms / 1e3 + time.perf_counter() - start)
    if args.verbose:
        line += "\n" + verbose_text(result) + f"\n  written to {Path(args.dir)}/{stem}.*"
    return Outcome(result.status, result.reason, line, record)
