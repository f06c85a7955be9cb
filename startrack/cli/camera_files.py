"""Camera files: `startrack calibrate verify`, `show` and `convert`, and the files that a calibration writes."""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from startrack.cli import flags
from startrack.cli.flag_types import limited, number
from startrack.cli.flags import Command, Either, flag
from startrack.cli.images import checked_flag, print_outcome, read, refusal, site_of
from startrack.cli.progress import progress
from startrack.core.errors import BadInput, NoSolution
from startrack.core.files import check_output, file_stem, read_text, resolve_named, write_atomically

if TYPE_CHECKING:
    from startrack.applications.calibration import Calibration
    from startrack.core.types import Array, Bools, Mask

RECORD = ".calibration.json"
REPORTS = (".report.html", ".report.png")
MASK, HOT_PIXELS = ".mask.png", ".hot-pixels.csv"
FORMATS = ("ros", "kalibr", "colmap", "opencv")
DEFAULT_NAMES = {"colmap": "cameras.txt", "kalibr": "camchain.yaml"}  # of the other programs
NAME = flag("--name NAME", "name of the camera (default: that of its file)")
CAMERA_OUTPUT = (flags.FILE, NAME, flags.DIR, flags.OVERWRITE, flags.NO_PLOTS, flags.JSON)


def run_show(args: argparse.Namespace) -> int:
    """Print the contents of camera files; 0."""
    from startrack.applications.calibration import camera_properties, camera_summary
    from startrack.camera import load_camera

    for name in args.cameras:
        camera = load_camera(name)
        print(json.dumps(camera_properties(camera)) if args.json else camera_summary(camera))
    return 0


def run_convert(args: argparse.Namespace) -> int:
    """Convert one camera file; 0."""
    from startrack.camera import (
        camera_from_foreign_text,
        camera_text,
        decentring_rms_px,
        foreign_text,
        load_camera,
    )

    check_name(args)
    if args.to is not None:
        camera = load_camera(args.file)
        text = foreign_text(camera, args.to)
        default = DEFAULT_NAMES.get(args.to, f"{file_stem(camera.name)}.yaml")
        lost = decentring_rms_px(camera) if camera.decentring and args.to != "colmap" else 0.0
        note = f"; {args.to} has no decentring: {lost:.2f} px RMS are lost" if lost else ""
    else:
        angle_rad = None if args.calibrated_angle is None else math.radians(args.calibrated_angle)
        camera = camera_from_foreign_text(
            read_text(args.file, "no_calibration"), args.source, Path(args.file).stem, angle_rad
        )
        text = camera_text(replace(camera, name=args.name or camera.name))
        default, note = f"{Path(args.file).stem}.toml", ""
        if angle_rad is None:
            print(
                f"{args.file}: calibrated_angle_deg is set to {math.degrees(camera.calibrated_angle_rad):.1f}, the "
                "nearest edge of the frame: the file states none; give --calibrated-angle",
                file=sys.stderr,
            )
    out = _output_path(args, default)
    write_atomically(out, text.encode("utf-8"), overwrite=args.overwrite)
    if not args.quiet:
        print(f"{out}{note}")
    return 0


def run_verify(args: argparse.Namespace) -> int:
    """Check a camera file against exposures of the stars; the exit code of the worst."""
    from startrack.applications.calibration import verify, verify_dict, verify_line
    from startrack.camera import load_camera
    from startrack.catalog import load_catalog

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
                known = _has_site(resolve_named(named, "calib", "no_calibration"))
                found = verify(exposure, camera, load_catalog(), site, file_has_site=known)
                record, line = verify_dict(found), verify_line(found)
            except NoSolution as cause:
                record = refusal(cause.reason, str(cause), image=exposure.name)
                line = f"{exposure.name}  refused {cause.reason}: {cause}"
        worst = max(worst, print_outcome(args, record, line))
    return worst


def check_name(args: argparse.Namespace) -> None:
    """A usage error for a name, of --name or of the file, that a camera file cannot hold."""
    from startrack.camera import camera_keys

    for flag_name, name in (("--name", args.name), ("the stem of --output", args.output and Path(args.output).stem)):
        if name is not None:
            checked_flag(args, camera_keys().keys["name"], name, flag_name)


@contextmanager
def show_steps(args: argparse.Namespace, steps: int) -> Iterator[Callable[[str], None]]:
    """A bar over the steps; the function to call with the name of each."""
    with progress("calibrate", steps, shown=not (args.quiet or args.json)) as bar:
        yield lambda text: bar.advance(text=text)


def _output_path(args: argparse.Namespace, default: str) -> Path:
    """Path of the result; its folder is made. Raises BadOutput if that is impossible, or if it exists and not -O."""
    return check_output(args.output or Path(args.dir) / default, overwrite=args.overwrite)


def check_camera_output(args: argparse.Namespace) -> Path:
    """Path of the camera file, whose companions can be written too. Raises BadOutput, before anything is computed.

    Without -O nothing is replaced but the record and the report of a calibration that was refused.
    """
    out = _output_path(args, "camera.toml")
    replaceable = args.overwrite or _value_in_record(out, "status") == "refused"
    for suffix in (RECORD, *REPORTS):
        check_output(out.with_suffix(suffix), overwrite=replaceable)
    for suffix in (MASK, HOT_PIXELS):
        check_output(out.with_suffix(suffix), overwrite=args.overwrite)
    return out


def _has_site(camera_file: Path) -> bool | None:
    """Whether the record beside a camera file states a site on the Earth; None where no record states that."""
    from startrack.applications.calibration import REFRACTION_REMOVED

    refraction = _value_in_record(camera_file, "lens", "refraction")
    return None if refraction is None else bool(refraction == REFRACTION_REMOVED)


def _value_in_record(camera_file: Path, *keys: str) -> Any:
    """The value in the record beside a camera file; None without a record, or in one of another kind."""
    try:
        found = json.loads(camera_file.with_suffix(RECORD).read_text(encoding="utf-8"))
        for key in keys:
            found = found[key]
    except (OSError, ValueError, RecursionError, KeyError, TypeError):
        return None
    return found


def write_record(camera_file: Path, record: dict[str, Any]) -> None:
    """Write CAMERA.calibration.json in the place of a former one, whose report is removed."""
    from startrack.output import write_json

    for suffix in REPORTS:
        camera_file.with_suffix(suffix).unlink(missing_ok=True)
    write_json(camera_file.with_suffix(RECORD), record)


def write_camera(camera_file: Path, found: Calibration, used_masks: Iterable[str | Mask | None]) -> str:
    """Write an accepted camera, its mask and its hot pixels; the line that explains the mask, if there is one.

    The mask and the hot pixels of a former calibration are removed, except a file of `used_masks`.
    """
    from startrack.camera import save_camera

    save_camera(found.camera, camera_file)
    remove_former(camera_file, used_masks)
    hot_px: Array | None = found.photometry.properties.hot_px
    if hot_px is not None:
        lines = ["x_px,y_px", *(f"{x:.0f},{y:.0f}" for x, y in hot_px)]
        write_atomically(camera_file.with_suffix(HOT_PIXELS), ("\n".join(lines) + "\n").encode(), overwrite=True)
    return "" if found.obstructed is None else _write_proposed_mask(camera_file, found.obstructed)


def remove_former(camera_file: Path, used_masks: Iterable[str | Mask | None]) -> None:
    """Remove the mask and the hot pixels of a former calibration, except a file of `used_masks`."""
    mask = camera_file.with_suffix(MASK)
    used = {os.path.realpath(one) for one in used_masks if isinstance(one, str)}
    if os.path.realpath(mask) not in used:
        mask.unlink(missing_ok=True)
    camera_file.with_suffix(HOT_PIXELS).unlink(missing_ok=True)


def _write_proposed_mask(camera_file: Path, obstructed: Bools) -> str:
    """Write CAMERA.mask.png beside the camera file; the line that explains its use."""
    import numpy as np

    from startrack.core.types import Exposure
    from startrack.exposure import write_exposure

    path = camera_file.with_suffix(MASK)
    pixels = np.where(obstructed, 0.0, 255.0).astype(np.float32)
    write_exposure(path, Exposure(pixels_adu=pixels, saturation_adu=255.0), overwrite=True)
    return (
        f"{path.name}: {100 * obstructed.mean():.1f} % of the pixels are in places that never show a star; it is not "
        f'used unless {camera_file.name} has the line mask = "{path.name}" above its first [table]'
    )


COMMANDS = (
    Command(
        "calibrate verify", run_verify, None,
        "Check whether a camera file still fits exposures of the stars. If the file was calibrated with --site, verify "
        "needs --site too.",
        {"input": flags.SKY, "more": (flags.JSON, *flags.MORE)},
        "startrack calibrate verify LATER.jpg -c camera.toml",
    ),
    Command(
        "calibrate show", run_show, None, "Print the content of camera files.",
        {
            "input": (flag("cameras CAMERA", "camera file, or the name of a shipped one", nargs="+"),),
            "more": (flags.JSON, *flags.MORE),
        },
        "startrack calibrate show fisheye-2048",
    ),
    Command(
        "calibrate convert", run_convert, None, "Convert a camera file to another program's format, or from it.",
        {
            "input": (
                flag("file FILE", "camera file with --to; the other program's file with --from"),
                Either(
                    (
                        flag("--to", "write this format", choices=FORMATS),
                        flag("--from", "read this format", choices=FORMATS, dest="source"),
                    ),
                    required=True,
                ),
                flag(
                    "--calibrated-angle DEG",
                    "with --from: angle off the axis up to which the lens was calibrated, which no such file states "
                    "(default: that of the frame's nearest edge)",
                    limited(number, lambda deg: 0 < deg <= 180, "{} is not above 0 and up to 180 degrees"),
                ),
            ),
            "output": (flags.FILE, NAME, flags.DIR, flags.OVERWRITE),
            "more": (flags.JSON, *flags.MORE),
        },
        "startrack calibrate convert camera.toml --to ros",
    ),
)  # fmt: skip
