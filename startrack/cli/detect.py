"""`startrack detect`: centroids only."""

from __future__ import annotations

import argparse
import time
from typing import Any

from startrack.cli.common import Outcome, add_image_flags, camera_of, read, result_path, run_images

FORMAT = "startrack.detection/1"


def add_parser(subparsers: Any) -> None:
    """Add `detect` to the commands of the `startrack` parser."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "detect",
        help="centroids only",
        description="Find the point sources of each image. With a camera file fluxes are in electrons, without one in "
        "ADU and the PSF is measured from the image. Writes NAME.detections.json and NAME.annotated.png.",
    )
    add_image_flags(parser)
    parser.set_defaults(run=run, usage_error=parser.error)


def run(args: argparse.Namespace) -> int:
    """Detect in every image; the exit code of the worst."""
    return run_images(args, FORMAT, lambda path, stem: _detect_image(path, stem, args))


def _detect_image(path: str, stem: str, args: argparse.Namespace) -> Outcome:
    from startrack.chain import detect, with_timing
    from startrack.output import summary_line, write_results

    start = time.perf_counter()
    exposure = read(path, args)
    camera = camera_of(exposure) if exposure.camera is not None else None
    out = result_path(args, stem, ".detections.json", exposure)
    read_ms = 1e3 * (time.perf_counter() - start)
    result = with_timing(detect(exposure, camera), read=read_ms)
    record = write_results(result, out, plots=not args.no_plots)
    return Outcome(result.status, result.reason, summary_line(result, seconds=time.perf_counter() - start), record)
