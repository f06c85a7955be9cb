"""`startrack calibrate`: a camera file from pictures of stars or of a board; `calibrate verify` checks it."""

from __future__ import annotations

import argparse
import sys

from startrack.applications import calibration
from startrack.camera import REFRACTION_CONTAINED, REFRACTION_REMOVED, SENSOR, load_camera, save_camera
from startrack.catalog import load_catalog
from startrack.cli.console import named_steps, print_files, print_left_out, print_outcome, refusal
from startrack.cli.flags import checked_flag
from startrack.cli.images import approximate_camera, check_one_time, flag_site, read, read_each_once, site_of
from startrack.cli.inputs.camera_files import (
    check_camera_output,
    check_name,
    files_of,
    remove_former,
    value_in_record,
    write_camera,
    write_record,
)
from startrack.core.errors import BadInput, NoSolution
from startrack.core.files import printable, resolve_named, split_camera
from startrack.core.limits import limited_time

MIN_SIDE, MAX_SIDE = 3, 100  # corners or squares of a board
SENSOR_FLAGS = {"gain_e_per_adu": "gain", "read_noise_e": "read_noise", "bias_adu": "bias"}  # by keys of camera files
ABOUT_REFRACTION = "of pictures from the Earth the refraction of the air is in the lens: give --site LAT,LON[,M]"


def run(args: argparse.Namespace) -> int:
    """Calibrate; the exit code."""
    check_one_time(args)
    check_name(args)
    known_sensor = calibration.KnownSensor(**{
        key: checked_flag(args, SENSOR.keys[key], getattr(args, name), f"--{name.replace('_', '-')}")
        for key, name in SENSOR_FLAGS.items()
        if getattr(args, name) is not None
    })  # fmt: skip
    flag_site(args)  # wrong usage is reported before the images are read
    out = check_camera_output(args)
    with limited_time(args.time_limit):
        exposures = read_each_once(args)
        start = approximate_camera(args, exposures)
        with named_steps(
            args, f"calibrate with {len(exposures)} images", calibration.count_steps(len(exposures))
        ) as show_step:
            try:
                found = calibration.calibrate(
                    exposures, load_catalog(), camera=start, fov_rad=args.fov, site=site_of(args, exposures),
                    known_sensor=known_sensor, name=args.name or out.stem, progress=show_step,
                )  # fmt: skip
            except NoSolution as cause:
                record = calibration.refusal_dict(cause.reason, str(cause))
                write_record(out, record)
                return print_outcome(args, record, refusal(cause, printable(out))[1])
    record, line = calibration.calibration_dict(found), calibration.summary(found, printable(out))
    line += f"\n  {record['message']}" if record["message"] else ""
    if found.accepted:
        about_mask = write_camera(out, found, [found.camera.mask, *(one.mask for one in exposures)])
        line += f"\n  {about_mask}" if about_mask else ""
    write_record(out, record)
    about_picture = "" if args.no_plots else calibration.write_report(out, found)
    if not args.quiet:
        if about_picture:
            print(about_picture, file=sys.stderr, flush=True)
        print_left_out(found.refused)
        if found.camera.refraction == REFRACTION_CONTAINED:
            print(ABOUT_REFRACTION, file=sys.stderr, flush=True)
    if args.verbose:
        line += "".join(f"\n  {note}" for note in found.photometry.notes)
    code = print_outcome(args, record, line)
    print_files(args, f"{', '.join(files_of(out))} in {printable(out.parent)}")
    return code


def run_board(args: argparse.Namespace) -> int:
    """Calibrate with the board; the exit code."""
    try:
        columns, rows = (int(n) for n in (args.pattern or "").lower().split("x"))
    except ValueError:
        args.usage_error("--pattern CxR is needed: inner corners of a chessboard, squares of a ChArUco board")
    if min(columns, rows) < MIN_SIDE or max(columns, rows) > MAX_SIDE:
        args.usage_error(f"--pattern {args.pattern}: a board has {MIN_SIDE} to {MAX_SIDE} corners or squares a side")
    check_name(args)
    out = check_camera_output(args)
    exposures = [read(path, args) for path in args.images]
    with named_steps(args, f"calibrate-board with {len(exposures)} pictures", len(exposures) + 1) as show_step:
        try:
            board = calibration.Board(columns, rows, args.charuco, args.marker)
            found = calibration.calibrate_board(exposures, board, name=args.name or out.stem, progress=show_step)
        except NoSolution as cause:
            record = calibration.refusal_dict(cause.reason, str(cause))
            return print_outcome(args, record, refusal(cause, printable(out))[1])
    record, line = calibration.board_dict(found), calibration.board_line(found, printable(out))
    if found.accepted:
        save_camera(found.camera, out)
        remove_former(out, [one.mask for one in exposures])
    write_record(out, record)
    code = print_outcome(args, record, line + (f"\n  {record['message']}" if record["message"] else ""))
    print_files(args, f"{', '.join(files_of(out))} in {printable(out.parent)}")
    return code


def verify(args: argparse.Namespace) -> int:
    """Check a camera file against exposures of the stars; the exit code of the worst."""
    worst = 0
    for path in args.images:
        exposure = read(path, args)
        named = args.camera or exposure.camera
        if named is None:
            raise BadInput("no_calibration", "no camera file to verify is known: give -c FILE")
        with named_steps(args, "verify", 1) as show_step:
            try:
                show_step(f"verifying with {exposure.name}")
                camera, site = load_camera(named), site_of(args, [exposure])
                file = resolve_named(split_camera(named)[0], "calib", "no_calibration")
                refraction = camera.refraction or value_in_record(file, "lens", "refraction")
                known = None if not refraction else bool(refraction == REFRACTION_REMOVED)
                found = calibration.verify(exposure, camera, load_catalog(), site, file_has_site=known)
                outcome = calibration.verify_dict(found), calibration.verify_line(found)
            except NoSolution as cause:
                outcome = refusal(cause, exposure.name, format=calibration.VERIFICATION_FORMAT, image=exposure.name)
        worst = max(worst, print_outcome(args, *outcome))
    return worst
