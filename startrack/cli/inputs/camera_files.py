"""Camera files: `startrack calibrate show` and `convert`, and the files that a calibration writes."""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from startrack import camera as cameras
from startrack.cli.flags import checked_flag
from startrack.core.errors import BadInput
from startrack.core.files import check_output, file_stem, is_path, printable, write_atomically
from startrack.core.types import Exposure
from startrack.exposure import write_exposure
from startrack.frames import R_enu_icrs, azel_from_rays

if TYPE_CHECKING:
    from startrack.applications.calibration import Calibration
    from startrack.core.types import Mask

RECORD = ".calibration.json"
REPORTS = (".report.html", ".report.png")
MASK, HOT_PIXELS = ".mask.png", ".hot-pixels.csv"
PLATEPAR, INDI_ALLSKY = POINTED = "platepar", "indi-allsky"  # files that hold a pointing too
# Of the other programs.
DEFAULT_NAMES = {
    "colmap": "cameras.txt",
    "kalibr": "camchain.yaml",
    PLATEPAR: "platepar_cmn2010.cal",
    INDI_ALLSKY: "indi-allsky.json",
}


def show(args: argparse.Namespace) -> int:
    """Print the contents of camera files; 0."""
    from startrack.applications.calibration import camera_properties, camera_summary

    for name in args.cameras:
        camera = cameras.read_camera(name)  # its notes are printed below
        print(json.dumps(camera_properties(camera)) if args.json else camera_summary(camera))
    return 0


def convert(args: argparse.Namespace) -> int:
    """Convert one camera file; 0."""
    check_name(args)
    if (args.to, args.source) == (None, None) and (args.file.endswith(".toml") or not is_path(args.file)):
        args.usage_error("a camera file of startrack needs --to, the format that it is converted to")
    if args.to is not None and args.calibrated_angle is not None:
        args.usage_error("--calibrated-angle is for a file of another program, not for --to")
    if args.to not in POINTED and (args.attitude, args.site) != (None, None):
        args.usage_error(f"--attitude and --site are for --to {' and --to '.join(POINTED)}")
    if args.to in POINTED:
        text, note = _pointed(args)
        default = DEFAULT_NAMES[args.to]
    elif args.to is not None:
        camera = cameras.load_camera(args.file)
        text = cameras.foreign_text(camera, args.to)
        default = DEFAULT_NAMES.get(args.to, f"{file_stem(camera.name)}.yaml")
        lost = cameras.decentring_rms_px(camera) if camera.decentring and args.to != "colmap" else 0.0
        note = f"; {args.to} has no decentring: {lost:.2f} px RMS are lost" if lost else ""
    else:
        angle_rad = None if args.calibrated_angle is None else math.radians(args.calibrated_angle)
        camera = cameras.read_foreign_camera(args.file, args.source, angle_rad)
        text = cameras.camera_text(replace(camera, name=args.name or camera.name))
        default, note = f"{printable(Path(args.file).stem)}.toml", ""
        for line in camera.notes:
            print(f"{printable(args.file)}: {line}", file=sys.stderr)
    out = _output_path(args, default)
    write_atomically(out, text.encode("utf-8"), overwrite=args.overwrite)
    if not args.quiet:
        print(f"{printable(out)}{note}")
    return 0


def _pointed(args: argparse.Namespace) -> tuple[str, str]:
    """The text of a file that holds a pointing, and a note about how well it is the lens. Raises BadInput."""
    from startrack.chain import read_near_attitude
    from startrack.cli.images import flag_site

    site = flag_site(args)
    if args.attitude is None or site is None:
        return args.usage_error(  # type: ignore[no-any-return]
            f"--to {args.to} needs --attitude NAME.identification.json, where the camera pointed and when, and --site "
            "LAT,LON[,M]: startrack identify IMAGE --time UTC -c CAMERA writes the first"
        )
    camera, attitude = cameras.load_camera(args.file), read_near_attitude(args.attitude)
    if attitude.time_utc is None:
        raise BadInput("no_time", f"{printable(args.attitude)}: states no time: identify the image again with --time")
    if attitude.camera is not None and Path(attitude.camera).stem != Path(args.file).stem:
        raise BadInput(
            "bad_calibration",
            f"{printable(args.attitude)}: was measured by the camera {printable(attitude.camera)}, not by "
            f"{printable(args.file)}: identify the image again with -c {printable(args.file)}",
        )
    R_cam_icrs = attitude.R_cam_icrs_at(None, None)
    elevation_rad = azel_from_rays(R_enu_icrs(site, attitude.time_utc) @ R_cam_icrs[2])[1]
    if elevation_rad < 0.0:
        raise BadInput(
            "bad_terrain",
            f"{printable(args.attitude)}: the camera points {-math.degrees(elevation_rad):.0f} degrees below the "
            "horizon of this site: check --site (signs) and the time of the image",
        )
    if args.to == INDI_ALLSKY:
        overlay = cameras.virtualsky_of(camera, R_cam_icrs, attitude.time_utc, site)
        return overlay.text, (
            f"; VirtualSky's lens is {overlay.largest_px:.1f} px from this one at most, {overlay.rms_px:.1f} px RMS"
        )
    found = cameras.platepar_of(camera, R_cam_icrs, attitude.time_utc, site)
    angle_deg = math.degrees(camera.calibrated_angle_rad)
    return found.text, (
        f"; largest errors of its {found.kind} up to {angle_deg:.1f} degrees off the axis: {found.to_sky_px:.2f} px to "
        f"the sky, {found.to_image_px:.2f} px to the image; its photometry is RMS's default"
    )


def check_name(args: argparse.Namespace) -> None:
    """A usage error for a name, of --name or of the file, that a camera file cannot hold."""
    for flag_name, name in (("--name", args.name), ("the stem of --output", args.output and Path(args.output).stem)):
        if name is not None:
            checked_flag(args, cameras.camera_keys().keys["name"], name, flag_name)


def _output_path(args: argparse.Namespace, default: str) -> Path:
    """Path of the result; its folder is made. Raises BadOutput if that is impossible, or if it exists and not -O."""
    return check_output(args.output or Path(args.dir) / default, overwrite=args.overwrite)


def check_camera_output(args: argparse.Namespace) -> Path:
    """Path of the camera file, whose companions can be written too. Raises BadOutput, before anything is computed.

    Without -O nothing is replaced but the record and the report of a calibration that was refused.
    """
    out = _output_path(args, "camera.toml")
    replaceable = args.overwrite or value_in_record(out, "status") == "refused"
    for suffix in (RECORD, *REPORTS):
        check_output(out.with_suffix(suffix), overwrite=replaceable)
    for suffix in (MASK, HOT_PIXELS):
        check_output(out.with_suffix(suffix), overwrite=args.overwrite)
    return out


def files_of(camera_file: Path) -> list[str]:
    """Names of the files of a calibration that are there, the camera file first."""
    paths = (camera_file.with_suffix(suffix) for suffix in (camera_file.suffix, RECORD, *REPORTS, MASK, HOT_PIXELS))
    return [printable(path.name) for path in paths if path.is_file()]


def value_in_record(camera_file: Path, *keys: str) -> Any:
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
    cameras.save_camera(found.camera, camera_file)
    remove_former(camera_file, used_masks)
    hot_px = found.photometry.properties.hot_px
    if hot_px is not None:
        lines = ["x_px,y_px", *(f"{x:.0f},{y:.0f}" for x, y in hot_px)]
        write_atomically(camera_file.with_suffix(HOT_PIXELS), ("\n".join(lines) + "\n").encode(), overwrite=True)
    if found.obstructed is None:
        return f"no mask is proposed: {found.no_mask_because}" if found.no_mask_because else ""
    path = camera_file.with_suffix(MASK)
    pixels = np.where(found.obstructed, 0.0, 255.0).astype(np.float32)
    write_exposure(path, Exposure(pixels_adu=pixels, saturation_adu=255.0), overwrite=True)
    return (
        f"{path.name}: {100 * found.obstructed.mean():.1f} % of the pixels are too dark to be open sky; "
        f'it is not used unless {camera_file.name} has the line mask = "{path.name}" above its first [table]'
    )


def remove_former(camera_file: Path, used_masks: Iterable[str | Mask | None]) -> None:
    """Remove the mask and the hot pixels of a former calibration, except a file of `used_masks`."""
    mask = camera_file.with_suffix(MASK)
    used = {os.path.realpath(one) for one in used_masks if isinstance(one, str)}
    if os.path.realpath(mask) not in used:
        mask.unlink(missing_ok=True)
    camera_file.with_suffix(HOT_PIXELS).unlink(missing_ok=True)
