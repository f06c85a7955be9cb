"""`startrack identify`: stars and attitude only."""

from __future__ import annotations

import argparse
import math
import time
from typing import TYPE_CHECKING, Any

from startrack.cli.common import Outcome, add_image_flags, camera_of, read, result_path, run_images
from startrack.cli.flag_types import fields_of_view_rad

if TYPE_CHECKING:
    from startrack.camera import Camera

FORMAT = "startrack.identification/1"
NARROWEST_DEG, WIDEST_DEG = 3.0, 280.0
WIDE_RAD = math.radians(100.0)  # from here up the field of view is that of the image circle


def add_parser(subparsers: Any) -> None:
    """Add `identify` to the commands of the `startrack` parser."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "identify",
        help="stars and attitude only",
        description="Name the stars of each image and give the attitude. Needs a camera file, or with --fov only the "
        "approximate field of view: the lens is then found with the stars. No terrain is needed; without a time the "
        "catalogue is taken at J2000.0 and 60 arcsec are added to the stated errors. Writes "
        "NAME.identification.json, NAME.stars.ecsv, NAME.wcs, NAME.corr and NAME.annotated.png.",
    )
    add_image_flags(parser)
    parser.add_argument(
        "--fov", type=_fields_of_view_rad, metavar="DEG|MIN..MAX",
        help="no camera file: field of view in degrees, good to 10 %%, or a range that is tried in steps; "
        "below 100 across the image's width, from there "
        "up of the whole image circle, even where the frame clips it. Takes 12 stars, 7 below 100 degrees",
    )  # fmt: skip
    parser.set_defaults(run=run, usage_error=parser.error)


def _fields_of_view_rad(text: str) -> tuple[float, ...]:
    return fields_of_view_rad(text, NARROWEST_DEG, WIDEST_DEG)


def _found_fov_text(camera: Camera, fovs_rad: tuple[float, ...]) -> str:
    """The field of view in degrees, of those tried [rad], that is closest to that of the `camera` found."""
    import numpy as np

    middle, right = camera.centre_px[1], camera.size_px[0] - 0.5
    width_rad = float(camera.angle_rad(np.array([[-0.5, middle], [right, middle]])).sum())
    closest = min(
        fovs_rad, key=lambda fov: abs(math.log(fov / (width_rad if fov < WIDE_RAD else 2 * camera.max_angle_rad)))
    )
    return f"{math.degrees(closest):.4g}"


def run(args: argparse.Namespace) -> int:
    """Identify every image; the exit code of the worst."""
    if args.fov is not None and args.camera is not None:
        args.usage_error("--fov is for an unknown lens, -c for a known one: give one of them")
    return run_images(args, FORMAT, lambda path, stem: _identify_image(path, stem, args))


def _identify_image(path: str, stem: str, args: argparse.Namespace) -> Outcome:
    from startrack.catalog import load_catalog
    from startrack.chain import Oriented, Refused, identify, identify_blind, with_timing
    from startrack.output import (
        lens_text,
        summary_line,
        verbose_text,
        write_results,
    )

    start = time.perf_counter()
    exposure = read(path, args)
    camera = camera_of(exposure) if args.fov is None else None
    out = result_path(args, stem, ".identification.json", exposure)
    read_ms = 1e3 * (time.perf_counter() - start)
    if camera is not None:
        result: Oriented | Refused = identify(exposure, camera, load_catalog())
    else:
        result = identify_blind(exposure, args.fov, load_catalog())
    result = with_timing(result, read=read_ms)
    record = write_results(result, out, plots=not args.no_plots)
    line = summary_line(result, seconds=time.perf_counter() - start)
    if camera is None and isinstance(result, Oriented):
        fov = _found_fov_text(result.camera, args.fov)
        line += f"\n  {lens_text(result.camera)}; a camera file: startrack calibrate --fov {fov} IMAGE"
    return Outcome(result.status, result.reason, line + ("\n" + verbose_text(result) if args.verbose else ""), record)
