"""`startrack horizon`: the obstruction profile of a fixed camera from photographs of the night sky."""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from startrack.cli.calibrate import approximate_camera, print_outcome, site_of
from startrack.cli.common import add_fact_flags, add_output_flags, read
from startrack.cli.flag_types import field_of_view_rad
from startrack.cli.progress import progress
from startrack.core.errors import BadInput, BadOutput, NoSolution

if TYPE_CHECKING:
    from startrack.applications.horizon import LeftOut, SkylineResult
    from startrack.core.types import Exposure
    from startrack.frames import Site

FORMAT = "startrack.horizon/1"


def add_parser(subparsers: Any) -> None:
    """Add `horizon` to the commands of the `startrack` parser."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "horizon",
        help="the horizon of a fixed camera from photographs of the night sky",
        description="Measure the skyline (obstruction profile) of a fixed camera on the Earth from one or several "
        "photographs of the night sky: from stars seen, stars missing, and the place where the sky's light stops. The "
        "suffix of -o chooses the format: .csv, .ecsv, .hrz (N.I.N.A.), .png (panorama), none (folder of a Stellarium "
        "landscape).",
    )
    parser.add_argument("images", nargs="+", metavar="IMAGE", help="PNG, TIFF, FITS, JPEG or camera raw")
    parser.add_argument("-o", "--output", metavar="FILE", required=True, help="the skyline")
    parser.add_argument("--site", metavar="LAT,LON[,M]", help="where the camera stands, in degrees and metres "
                        "(--site=-30.2,...)")  # fmt: skip
    parser.add_argument("-t", "--terrain", metavar="FILE", help="terrain file on the Earth whose origin is the site")
    parser.add_argument("--fov", type=field_of_view_rad, metavar="DEG", help="no camera file: field of view, good to "
                        "10 %%; below 100 across the width, from 100 up of the image circle")  # fmt: skip
    add_fact_flags(parser)
    add_output_flags(parser)
    parser.set_defaults(run=run, usage_error=parser.error)


def run(args: argparse.Namespace) -> int:
    """Measure and write the skyline; the exit code."""
    if args.fov is not None and args.camera is not None:
        args.usage_error("--fov is for an unknown lens, -c for a known one: give one of them")
    if args.time is not None and len(args.images) > 1:
        args.usage_error("--time is the time of one image; give each of several its own in a sidecar NAME.json")
    try:
        return print_outcome(args, *_measure(args))
    except BadOutput:
        raise
    except (BadInput, NoSolution) as cause:
        record = {"format": FORMAT, "status": "refused", "reason": cause.reason, "message": str(cause),
                  "advice": cause.reason.advice}  # fmt: skip
        return print_outcome(args, record, f"{Path(args.output).name}  refused {cause.reason}: {cause}")


def _measure(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """The record and the line of a skyline that was measured and written."""
    from startrack.applications.horizon.frames import orient_frames
    from startrack.applications.horizon.measure import measure_frames
    from startrack.applications.horizon.write import check_output, needs_all_azimuths, write_skyline
    from startrack.catalog import load_catalog

    check_output(args.output, overwrite=args.overwrite)
    exposures = [read(path, args) for path in args.images]
    site = _earth_site(args, exposures)
    camera = approximate_camera(args, exposures)
    with progress("horizon", 2, shown=not (args.quiet or args.json)) as bar:
        bar.advance(0, text="identifying the stars")
        frames, left_out = orient_frames(exposures, load_catalog(), site, camera=camera, fov_rad=args.fov)
        if frames:  # else the refusal names them
            _name_left_out(left_out)
        bar.advance(text="measuring the skyline")
        found = measure_frames(frames, left_out, site)
    write_skyline(args.output, found.skyline, site, overwrite=args.overwrite)
    unknown = int((~found.skyline.known).sum())
    note = f"{unknown} of them interpolated" if needs_all_azimuths(args.output) and unknown else ""
    return _record(args, found, note), _line(args, found, note)


def _earth_site(args: argparse.Namespace, exposures: list[Exposure]) -> Site:
    """The site. Raises BadInput (bad_terrain) where none is known or it is not on the Earth."""
    site = site_of(args, exposures)
    if site is None:
        raise BadInput("bad_terrain", "the site is not known: give --site LAT,LON[,M]; without it there is no azimuth")
    if site.body != "earth":
        raise BadInput("bad_terrain", f"the site is on the {site.body}: this command is for cameras on the Earth")
    return site


def _name_left_out(left_out: tuple[LeftOut, ...]) -> None:
    for one in left_out:
        print(f"{one.name}: left out, {one.reason}: {one.message}", file=sys.stderr, flush=True)


def _record(args: argparse.Namespace, found: SkylineResult, note: str) -> dict[str, Any]:
    skyline = found.skyline
    known = skyline.known
    return {
        "format": FORMAT,
        "status": "ok",
        "reason": None,
        "message": note,
        "output": Path(args.output).name,
        "images": [frame.name for frame in found.frames],
        "left_out": [{"image": one.name, "reason": one.reason, "message": one.message} for one in found.left_out],
        "azimuths": {
            "known": int(known.sum()),
            **{name.replace(" ", "_"): int((skyline.source == name).sum()) for name in ("stars", "sky light", "both")},
        },
        "median_sigma_deg": _median_deg(skyline.sigma_rad[known]),
        "lowest_deg": math.degrees(skyline.elevation_rad[known].min()) if known.any() else None,
        "highest_deg": math.degrees(skyline.elevation_rad[known].max()) if known.any() else None,
    }


def _line(args: argparse.Namespace, found: SkylineResult, note: str) -> str:
    skyline = found.skyline
    words = [f"{int(skyline.known.sum())} of {len(skyline)} azimuths"]
    sigma = _median_deg(skyline.sigma_rad[skyline.known])
    words += [f"median sigma {sigma:.2f}°"] if sigma is not None else []
    words += [f"{len(found.frames)} image{'s' if len(found.frames) > 1 else ''}"]
    line = "  ".join([Path(args.output).name, "ok", *words, *([note] if note else [])])
    if args.verbose:
        for frame in found.frames:
            line += f"\n  {frame.name}: {len(frame.matched_star)} stars fit the lens"
    return line


def _median_deg(values_rad: Any) -> float | None:
    import numpy as np

    return float(np.degrees(np.median(values_rad))) if len(values_rad) else None
