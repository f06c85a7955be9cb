"""`startrack locate --skyline`: a measured skyline to a position."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from startrack import chain, output
from startrack.camera import load_camera
from startrack.cli.console import Outcome, print_files, print_outcome, print_warnings, wait_lines
from startrack.cli.flag_types import attitude
from startrack.cli.flags import check_localizer
from startrack.cli.images import prepare
from startrack.core.errors import BadInput, BadOutput
from startrack.core.files import make_folder, printable
from startrack.core.memory import refusing_shortage
from startrack.core.types import PositionPrior
from startrack.frames import parse_utc
from startrack.localization import DEFAULT_LOCALIZER
from startrack.terrain import load_terrain


def locate_skyline(args: argparse.Namespace) -> int:
    """Locate the camera by the skyline of --skyline; the exit code."""
    check_localizer(args)
    if args.images:
        args.usage_error("--skyline stands in place of images: give one of them")
    if args.localizer != DEFAULT_LOCALIZER:
        args.usage_error(f"--skyline: only --localizer {DEFAULT_LOCALIZER} takes a measured skyline")
    try:
        with refusing_shortage():
            record, line = _solve(args)
    except BadInput as cause:
        record = output.refused_dict(args.skyline, cause.reason, str(cause))
        line = output.refusal_line(args.skyline, cause.reason, str(cause))
    print_warnings(args, Path(args.skyline).name, record.get("warnings", ()))
    code = print_outcome(args, record, line)
    if record["status"] == "ok":
        print_files(args, f"in {printable(args.dir)}")
    return code


def _solve(args: argparse.Namespace) -> Outcome:
    start = time.perf_counter()
    if args.terrain is None:
        raise BadInput("bad_terrain", "no terrain file is known: give -t FILE")
    terrain = load_terrain(args.terrain)
    when = None if args.time is None else parse_utc(args.time)
    camera = None if args.camera is None else load_camera(args.camera)
    near = None if args.near is None else PositionPrior(*args.near)
    stated = _stated_attitude(args)
    known = chain.StatedAttitude.of_input(stated, terrain.site, when)
    points = chain.skyline_points(args.skyline, _errors_of(args, stated), camera, known, near)
    exposure = chain.skyline_exposure(args.skyline, when, args.terrain)
    out = Path(args.dir) / f"{Path(args.skyline).stem}.fix.json"
    try:
        make_folder(out.parent)
    except BadOutput as cause:
        args.usage_error(str(cause))
    remedy = "choose another -D, or replace it with -O"
    output.prepare_folder(out, exposure.sha256, overwrite=args.overwrite, remedy=remedy)
    prepare(terrain, args)
    with wait_lines(args, f"locate {printable(exposure.name)}"):
        result = chain.locate_skyline(exposure, points, terrain, args.time_limit)
    more = {"explain": output.explain(result)} if args.explain else {}
    record = output.write_results(result, out, plots=not args.no_plots, more=more)
    output.write_geo(out, result, args.format)
    line = output.summary_line(result, seconds=time.perf_counter() - start)
    return record, line + ("\n" + output.verbose_text(result) if args.verbose else "")


def _stated_attitude(args: argparse.Namespace) -> str | tuple[float, float, float] | None:
    """Azimuth, pitch and roll [deg] of --attitude, or the path of a file."""
    words = [] if args.attitude is None else args.attitude.split(",")
    try:
        return attitude(words) if len(words) == 3 else args.attitude
    except argparse.ArgumentTypeError as cause:
        args.usage_error(f"argument --attitude: {cause}")
        raise  # the line above ends the program


def _errors_of(args: argparse.Namespace, stated: str | tuple[float, ...] | None) -> chain.SkylineErrors:
    """What flags state; the errors of a `stated` attitude in degrees must be, and those of a result count as none."""
    if isinstance(stated, tuple) and None in (args.heading_sigma, args.tilt_sigma):
        args.usage_error("--attitude AZ,PITCH,ROLL needs its errors: --heading-sigma DEG and --tilt-sigma DEG")
    return chain.SkylineErrors.of_inputs(
        heading_sigma=args.heading_sigma, tilt_sigma=args.tilt_sigma, correlation=args.correlation
    )
