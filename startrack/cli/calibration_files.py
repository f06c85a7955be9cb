"""The files that a calibration writes: the camera file, and what lies beside it."""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from startrack.core.files import check_output, write_atomically

if TYPE_CHECKING:
    from startrack.applications.calibration import Calibration
    from startrack.core.types import Array, Bools, Mask

RECORD = ".calibration.json"
REPORTS = (".report.html", ".report.png")
MASK, HOT_PIXELS = ".mask.png", ".hot-pixels.csv"


def output_path(args: argparse.Namespace, default: str) -> Path:
    """Path of the result; its folder is made. Raises BadOutput if that is impossible, or if it exists and not -O."""
    return check_output(args.output or Path(args.dir) / default, overwrite=args.overwrite)


def check_camera_output(args: argparse.Namespace) -> Path:
    """Path of the camera file, whose companions can be written too. Raises BadOutput, before anything is computed.

    Without -O nothing is replaced but the record and the report of a calibration that was refused.
    """
    out = output_path(args, "camera.toml")
    replaceable = args.overwrite or _recorded(out, "status") == "refused"
    for suffix in (RECORD, *REPORTS):
        check_output(out.with_suffix(suffix), overwrite=replaceable)
    for suffix in (MASK, HOT_PIXELS):
        check_output(out.with_suffix(suffix), overwrite=args.overwrite)
    return out


def has_site(camera_file: Path) -> bool | None:
    """Whether the record beside a camera file states a site on the Earth; None where no record states that."""
    from startrack.applications.calibration.record import REFRACTION_REMOVED

    refraction = _recorded(camera_file, "lens", "refraction")
    return None if refraction is None else bool(refraction == REFRACTION_REMOVED)


def _recorded(camera_file: Path, *keys: str) -> Any:
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
    if found.photometry.properties.hot_px is not None:
        _write_hot_pixels(camera_file, found.photometry.properties.hot_px)
    return "" if found.obstructed is None else _write_proposed_mask(camera_file, found.obstructed)


def remove_former(camera_file: Path, used_masks: Iterable[str | Mask | None]) -> None:
    """Remove the mask and the hot pixels of a former calibration, except a file of `used_masks`."""
    mask = camera_file.with_suffix(MASK)
    used = {os.path.realpath(one) for one in used_masks if isinstance(one, str)}
    if os.path.realpath(mask) not in used:
        mask.unlink(missing_ok=True)
    camera_file.with_suffix(HOT_PIXELS).unlink(missing_ok=True)


def _write_hot_pixels(camera_file: Path, hot_px: Array) -> None:
    lines = ["x_px,y_px", *(f"{x:.0f},{y:.0f}" for x, y in hot_px)]
    write_atomically(camera_file.with_suffix(HOT_PIXELS), ("\n".join(lines) + "\n").encode(), overwrite=True)


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
