"""`startrack calibrate`: a camera file from star exposures; `calibrate board` from pictures of a board."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING, Any

from startrack.cli import camera_files, flags
from startrack.cli.camera_files import (
    CAMERA_OUTPUT,
    check_camera_output,
    check_name,
    remove_former,
    show_steps,
    write_camera,
    write_record,
)
from startrack.cli.flag_types import amount, field_of_view_rad, limited, number, positive_number
from startrack.cli.flags import Command, flag
from startrack.cli.images import (
    approximate_camera,
    check_one_time,
    checked_flag,
    flag_site,
    print_outcome,
    read,
    site_of,
)
from startrack.core.compilation import announce_compilation
from startrack.core.errors import NoSolution

if TYPE_CHECKING:
    from pathlib import Path

    from startrack.applications.calibration import Calibration, KnownSensor
    from startrack.core.types import Mask

MIN_SIDE, MAX_SIDE = 3, 100  # corners or squares of a board
START = """usage: startrack calibrate [ACTION] ... (startrack calibrate --help lists the flags of each action)

from stars       startrack calibrate NIGHT.jpg... --fov 180 -o CAMERA.toml   the lens, from pictures of the night sky
from a board     startrack calibrate board BOARD.png... --pattern 9x6        the lens, from pictures of a chessboard
check            startrack calibrate verify LATER.jpg -c CAMERA.toml         does the camera file still fit?
look             startrack calibrate show CAMERA.toml                        the content of a camera file
other programs   startrack calibrate convert CAMERA.toml --to ros            ros, kalibr, colmap, opencv; --from too"""


def run(args: argparse.Namespace) -> int:
    """Calibrate; the exit code."""
    from startrack.applications.calibration import calibrate, refusal_dict
    from startrack.catalog import load_catalog

    check_one_time(args)
    check_name(args)
    known_sensor = _known_sensor(args)
    flag_site(args)  # wrong usage is reported before the images are read
    out = check_camera_output(args)
    exposures = [read(path, args) for path in args.images]
    announce_compilation()
    start = approximate_camera(args, exposures)
    with show_steps(args, 2 * len(exposures) + 3) as show_step:
        try:
            found = calibrate(
                exposures,
                load_catalog(),
                camera=start,
                fov_rad=args.fov,
                site=site_of(args, exposures),
                known_sensor=known_sensor,
                name=args.name or out.stem,
                progress=show_step,
            )
        except NoSolution as cause:
            record = refusal_dict(cause.reason, str(cause))
            write_record(out, record)
            return print_outcome(args, record, f"{out.name}  refused {cause.reason}: {cause}")
    return _write_calibration(args, out, found, [one.mask for one in exposures])


def _known_sensor(args: argparse.Namespace) -> KnownSensor:
    """The sensor's properties given by flags, within the limits of camera files; else a usage error."""
    from startrack.applications.calibration import KnownSensor
    from startrack.camera import SENSOR

    given = {"gain_e_per_adu": "gain", "read_noise_e": "read_noise", "bias_adu": "bias"}
    return KnownSensor(**{
        key: checked_flag(args, SENSOR.keys[key], getattr(args, name), f"--{name.replace('_', '-')}")
        for key, name in given.items()
        if getattr(args, name) is not None
    })  # fmt: skip


def _write_calibration(args: argparse.Namespace, out: Path, found: Calibration, masks: list[str | Mask | None]) -> int:
    """Write and print a calibration of images with `masks`; the exit code."""
    from startrack.applications.calibration import calibration_dict, summary, write_report

    record = calibration_dict(found)
    line = _line_with_message(summary(found, out.name), record)
    if found.accepted:
        about_mask = write_camera(out, found, [found.camera.mask, *masks])
        line += f"\n  {about_mask}" if about_mask else ""
    write_record(out, record)
    about_picture = "" if args.no_plots else write_report(out, found)
    if not args.quiet:
        if about_picture:
            print(about_picture, file=sys.stderr, flush=True)
        for one in found.refused:
            print(f"{one.name}: left out, {one.reason}: {one.message}", file=sys.stderr, flush=True)
    if args.verbose:
        line += "".join(f"\n  {note}" for note in found.photometry.notes)
    return print_outcome(args, record, line)


def _line_with_message(line: str, record: dict[str, Any]) -> str:
    return line + (f"\n  {record['message']}" if record["message"] else "")


def run_board(args: argparse.Namespace) -> int:
    """Calibrate with the board; the exit code."""
    from startrack.applications.calibration import Board, board_dict, board_line, calibrate_board
    from startrack.camera import save_camera

    try:
        columns, rows = (int(n) for n in (args.pattern or "").lower().split("x"))
    except ValueError:
        args.usage_error("--pattern CxR is needed: inner corners of a chessboard, squares of a ChArUco board")
    if min(columns, rows) < MIN_SIDE or max(columns, rows) > MAX_SIDE:
        args.usage_error(f"--pattern {args.pattern}: a board has {MIN_SIDE} to {MAX_SIDE} corners or squares a side")
    check_name(args)
    out = check_camera_output(args)
    exposures = [read(path, args) for path in args.images]
    with show_steps(args, len(exposures) + 1) as show_step:
        try:
            pattern = Board(columns, rows, args.charuco, args.marker)
            found = calibrate_board(exposures, pattern, name=args.name or out.stem, progress=show_step)
        except NoSolution as cause:
            record = {"status": "refused", "reason": cause.reason, "message": str(cause), "camera": None}
            return print_outcome(args, record, f"{out.name}  refused {cause.reason}: {cause}")
    record = board_dict(found)
    if found.accepted:
        save_camera(found.camera, out)
        remove_former(out, [one.mask for one in exposures])
    write_record(out, record)
    return print_outcome(args, record, _line_with_message(board_line(found, out.name), record))


COMMANDS = (
    Command(
        "calibrate", run, "a camera file from star exposures",
        "Fit the lens of a camera to the stars of one or more exposures of the open night sky, check the fit, and "
        "write the camera file with its covariance, a report and a JSON record. A fit that fails a check is refused, "
        "with the exposures that would help.",
        {
            "input": (
                *flags.SKY,
                flag(
                    "--fov DEG", "below 100: angle across the width; from 100 up: of the image circle",
                    field_of_view_rad,
                ),
            ),
            "sensor, if the exposures do not show it": (
                flag("--gain E", "electrons per ADU", positive_number),
                flag("--read-noise E", "read noise, electrons", amount),
                flag("--bias ADU", "level without light", number),
            ),
            "output": CAMERA_OUTPUT,
            "more": flags.MORE,
        },
        start=START,
    ),
    *camera_files.COMMANDS,
    Command(
        "calibrate board", run_board, None,
        "Fit the lens of a camera to pictures of a chessboard or a ChArUco board.",
        {
            "input": (
                flag("images IMAGE", "pictures of the board", nargs="+"),
                flag("--pattern CxR", "inner corners of a chessboard; squares of a ChArUco board"),
                flag("--charuco DICT", "ChArUco with this dictionary, such as DICT_5X5_100"),
                flag("--marker PART", "marker's side over square's",
                     limited(number, lambda part: 0 < part < 1, "{} is not between 0 and 1"), default=0.75),
            ),
            "output": CAMERA_OUTPUT,
            "more": flags.MORE,
        },
        "startrack calibrate board BOARD.png... --pattern 9x6 -o camera.toml",
    ),
)  # fmt: skip
