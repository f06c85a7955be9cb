"""What `startrack calibrate` does with camera files: verify, show, convert; and calibration from boards."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from startrack.cli.calibrate import output_path, progress, read, site_of, tell_outcome
from startrack.errors import BadInput, NoSolution


def show(args: argparse.Namespace, words: list[str]) -> int:
    """Print what camera files say; 0."""
    from startrack.calibration.show import camera_text, facts
    from startrack.camera import load_camera

    for word in words:
        camera = load_camera(word)
        print(json.dumps(facts(camera)) if args.json else camera_text(camera))
    return 0


def convert(args: argparse.Namespace, words: list[str]) -> int:
    """One camera file to another program's or from it; 0."""
    from startrack.camera import load_camera
    from startrack.camera.convert import from_text, to_text
    from startrack.camera.convert.intrinsics import decentring_rms_px
    from startrack.camera.io import camera_text
    from startrack.files import write_atomically

    if (args.to is None) == (args.source is None) or len(words) != 1:
        args.usage_error("calibrate convert takes one file, and --to or --from")
    if args.to is not None:
        camera = load_camera(words[0])
        text = to_text(camera, args.to)
        default = {"colmap": "cameras.txt", "kalibr": "camchain.yaml"}.get(args.to, f"{camera.name}.yaml")
        lost = decentring_rms_px(camera) if camera.decentring and args.to != "colmap" else 0.0
        note = f"; {args.to} has no decentring: {lost:.2f} px RMS are lost" if lost else ""
    else:
        text = camera_text(from_text(_text(words[0]), args.source, args.name or Path(words[0]).stem))
        default, note = f"{Path(words[0]).stem}.toml", ""
    out = output_path(args, default)
    write_atomically(out, text.encode("utf-8"), overwrite=True)
    if not args.quiet:
        print(f"{out}{note}")
    return 0


def verify(args: argparse.Namespace, words: list[str]) -> int:
    """Whether the camera file still fits pictures of the stars; the exit code."""
    from startrack.calibration.verify import verify as verified
    from startrack.calibration.verify import verify_dict, verify_line
    from startrack.camera import load_camera
    from startrack.catalog import load_catalog

    worst = 0
    for word in words:
        exposure = read(word, args)
        named = args.camera or exposure.camera
        if named is None:
            raise BadInput("no_calibration", "which camera file is to be verified? give -c FILE")
        with progress(args, 1) as tell:
            try:
                tell(f"verifying with {exposure.name}")
                found = verified(exposure, load_camera(named), load_catalog(), site_of(args, [exposure]))
            except NoSolution as cause:
                record = {"image": exposure.name, "status": "refused", "reason": cause.reason, "message": str(cause)}
                worst = max(worst, tell_outcome(args, record, f"{exposure.name}  refused {cause.reason}: {cause}"))
                continue
        worst = max(worst, tell_outcome(args, verify_dict(found), verify_line(found)))
    return worst


def board(args: argparse.Namespace, words: list[str]) -> int:
    """A camera file from pictures of a chessboard or a ChArUco board; the exit code."""
    from startrack.calibration.board import board_dict, board_line, calibrate_board
    from startrack.calibration.board_corners import Board
    from startrack.camera.io import camera_text
    from startrack.files import write_atomically
    from startrack.output import write_json

    try:
        columns, rows = (int(n) for n in (args.pattern or "").lower().split("x"))
    except ValueError:
        args.usage_error(
            "calibrate board needs --pattern CxR: inner corners of a chessboard, squares of a ChArUco board"
        )
    out = output_path(args, "camera.toml")
    exposures = [read(word, args) for word in words]
    with progress(args, len(exposures) + 1) as tell:
        try:
            pattern = Board(columns, rows, args.charuco, args.marker)
            found = calibrate_board(exposures, pattern, name=args.name or out.stem, progress=tell)
        except NoSolution as cause:
            record = {"status": "refused", "reason": cause.reason, "message": str(cause), "camera": None}
            return tell_outcome(args, record, f"{out.name}  refused {cause.reason}: {cause}")
    record = board_dict(found)
    if found.accepted:
        write_atomically(out, camera_text(found.camera).encode("utf-8"), overwrite=True)
    write_json(out.with_suffix(".calibration.json"), record)
    line = board_line(found, out.name) + (f"\n  {record['message']}" if record["message"] else "")
    return tell_outcome(args, record, line)


def _text(path: str) -> str:
    try:
        return Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as cause:
        raise BadInput("no_calibration", f"{path}: {cause}") from cause
