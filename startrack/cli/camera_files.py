"""`startrack calibrate verify`, `show` and `convert`: actions on existing camera files."""

from __future__ import annotations

import argparse
import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from startrack.cli.calibrate import (
    add_overwrite_flag,
    add_print_flags,
    add_site_flags,
    check_name,
    print_outcome,
    show_steps,
    site_of,
)
from startrack.cli.calibration_files import has_site, output_path
from startrack.cli.common import DEFAULT_OUT, read
from startrack.cli.flag_types import calibrated_angle_rad
from startrack.core.errors import BadInput, NoSolution

FORMATS = ("ros", "kalibr", "colmap", "opencv")
DEFAULT_NAMES = {"colmap": "cameras.txt", "kalibr": "camchain.yaml"}  # of the other programs


def add_parsers(subparsers: Any) -> None:
    """Add the actions to the commands of the `startrack` parser."""
    verify = _add_action(
        subparsers, "verify", "Check whether a camera file still fits exposures of the stars. If the file was "
        "calibrated with --site, verify needs --site too.",
    )  # fmt: skip
    verify.add_argument("images", nargs="+", metavar="IMAGE", help="PNG, TIFF, FITS, JPEG or camera raw")
    verify.add_argument("-c", "--camera", metavar="FILE", help="camera file (default: the one that the image names)")
    add_site_flags(verify)
    verify.set_defaults(run=run_verify)
    show = _add_action(subparsers, "show", "Print the content of camera files.")
    show.add_argument("cameras", nargs="+", metavar="CAMERA", help="camera file, or the name of a shipped one")
    show.set_defaults(run=run_show)
    convert = _add_action(subparsers, "convert", "Convert a camera file to another program's format, or from it.")
    convert.add_argument("file", metavar="FILE", help="camera file with --to; the other program's file with --from")
    direction = convert.add_mutually_exclusive_group(required=True)
    direction.add_argument("--to", choices=FORMATS, help="write this format")
    direction.add_argument("--from", dest="source", choices=FORMATS, help="read this format")
    convert.add_argument(
        "--calibrated-angle", dest="calibrated_angle_rad", type=calibrated_angle_rad, metavar="DEG",
        help="with --from: angle off the axis up to which the lens was calibrated, which no such file states "
        "(default: that of the frame's nearest edge)",
    )  # fmt: skip
    convert.add_argument("-o", "--output", metavar="FILE", help="what to write (default: a file in OUT)")
    convert.add_argument("--name", help="name of the camera (default: the one in the file, else its stem)")
    convert.add_argument("-D", "--dir", metavar="OUT", default=DEFAULT_OUT, help="folder of the results (%(default)s)")
    add_overwrite_flag(convert)
    convert.set_defaults(run=run_convert)


def _add_action(subparsers: Any, action: str, description: str) -> argparse.ArgumentParser:
    name = f"calibrate {action}"
    parser: argparse.ArgumentParser = subparsers.add_parser(name, prog=f"startrack {name}", description=description)
    add_print_flags(parser)
    parser.set_defaults(usage_error=parser.error)
    return parser


def run_show(args: argparse.Namespace) -> int:
    """Print the contents of camera files; 0."""
    from startrack.applications.calibration.record import camera_properties, camera_text
    from startrack.camera import load_camera

    for name in args.cameras:
        camera = load_camera(name)
        print(json.dumps(camera_properties(camera)) if args.json else camera_text(camera))
    return 0


def run_convert(args: argparse.Namespace) -> int:
    """Convert one camera file; 0."""
    from startrack.camera import camera_from_foreign_text as from_text
    from startrack.camera import camera_text, decentring_rms_px, load_camera
    from startrack.camera import foreign_text as to_text
    from startrack.core.files import file_stem, read_text, write_atomically

    check_name(args)
    if args.to is not None:
        camera = load_camera(args.file)
        text = to_text(camera, args.to)
        default = DEFAULT_NAMES.get(args.to, f"{file_stem(camera.name)}.yaml")
        lost = decentring_rms_px(camera) if camera.decentring and args.to != "colmap" else 0.0
        note = f"; {args.to} has no decentring: {lost:.2f} px RMS are lost" if lost else ""
    else:
        camera = from_text(
            read_text(args.file, "no_calibration"), args.source, Path(args.file).stem, args.calibrated_angle_rad
        )
        text = camera_text(replace(camera, name=args.name or camera.name))
        default, note = f"{Path(args.file).stem}.toml", ""
        if args.calibrated_angle_rad is None:
            angle_deg = math.degrees(camera.calibrated_angle_rad)
            warning = (
                f"calibrated_angle_deg is set to {angle_deg:.1f}, the nearest edge of the frame: the file states none"
            )
            print(f"{args.file}: {warning}; give --calibrated-angle", file=sys.stderr)
    out = output_path(args, default)
    write_atomically(out, text.encode("utf-8"), overwrite=args.overwrite)
    if not args.quiet:
        print(f"{out}{note}")
    return 0


def run_verify(args: argparse.Namespace) -> int:
    """Check a camera file against exposures of the stars; the exit code of the worst."""
    from startrack.applications.calibration.verify import verify, verify_dict, verify_line
    from startrack.camera import load_camera
    from startrack.catalog import load_catalog
    from startrack.core.files import resolve_named

    worst = 0
    for path in args.images:
        exposure = read(path, args)
        named = args.camera or exposure.camera
        if named is None:
            raise BadInput("no_calibration", "no camera file to verify is known: give -c FILE")
        with show_steps(args, 1) as show_step:
            try:
                show_step(f"verifying with {exposure.name}")
                camera, site = load_camera(named), site_of(args, [exposure])
                known = has_site(resolve_named(named, "calib", "no_calibration"))
                found = verify(exposure, camera, load_catalog(), site, file_has_site=known)
            except NoSolution as cause:
                record = {"image": exposure.name, "status": "refused", "reason": cause.reason, "message": str(cause),
                          "advice": cause.reason.advice}  # fmt: skip
                worst = max(worst, print_outcome(args, record, f"{exposure.name}  refused {cause.reason}: {cause}"))
                continue
        worst = max(worst, print_outcome(args, verify_dict(found), verify_line(found)))
    return worst
