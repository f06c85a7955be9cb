"""`startrack calibrate board`: a camera file from pictures of a chessboard or a ChArUco board."""

from __future__ import annotations

import argparse
from typing import Any

from startrack.cli.calibrate import add_camera_output_flags, check_name, print_outcome, show_steps
from startrack.cli.calibration_files import check_camera_output, remove_former, write_record
from startrack.cli.common import read
from startrack.cli.flag_types import number
from startrack.core.errors import NoSolution

MIN_SIDE, MAX_SIDE = 3, 100


def add_parser(subparsers: Any) -> None:
    """Add `calibrate board` to the commands of the `startrack` parser."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "calibrate board",
        prog="startrack calibrate board",
        description="Fit the lens of a camera to pictures of a chessboard or a ChArUco board.",
    )
    parser.add_argument("images", nargs="+", metavar="IMAGE", help="pictures of the board")
    parser.add_argument("--pattern", metavar="CxR", help="inner corners of a chessboard; squares of a ChArUco board")
    parser.add_argument("--charuco", metavar="DICT", help="ChArUco with this dictionary, such as DICT_5X5_100")
    parser.add_argument(
        "--marker", type=marker_fraction, default=0.75, metavar="PART", help="marker's side over square's (0.75)"
    )
    add_camera_output_flags(parser)
    parser.set_defaults(run=run, usage_error=parser.error, camera=None, time=None, exposure=None)


def run(args: argparse.Namespace) -> int:
    """Calibrate with the board; the exit code."""
    from startrack.applications.calibration.board import board_dict, board_line, calibrate_board
    from startrack.applications.calibration.board_pose import Board
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
    line = board_line(found, out.name) + (f"\n  {record['message']}" if record["message"] else "")
    return print_outcome(args, record, line)


def marker_fraction(text: str) -> float:
    """A part of the square's side, above 0 and below 1."""
    if not 0 < number(text) < 1:
        raise argparse.ArgumentTypeError(f"{text} is not between 0 and 1")
    return number(text)
