"""`startrack horizon`: the obstruction profile of a fixed camera from photographs of the night sky."""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from startrack.applications import horizon
from startrack.catalog import load_catalog
from startrack.cli.console import Outcome, named_steps, print_files, print_left_out, print_outcome, refusal
from startrack.cli.images import approximate_camera, check_fov, check_one_time, read_each_once, site_of
from startrack.core.errors import BadInput, BadOutput, NoSolution, Reason, one_line
from startrack.core.files import printable
from startrack.core.limits import limited_time, stating_work

FORMAT = "startrack.horizon/1"
UNTESTED = "time and site are not tested by one image: an hour turns the skyline by 15 degrees"
ADVICE = "Check the site (signs) and the times (UTC); measure each picture alone if the camera was turned between them."


def run(args: argparse.Namespace) -> int:
    """Measure and write the skyline; the exit code."""
    check_fov(args)
    check_one_time(args)
    try:
        record, line = _measure(args)
        code = print_outcome(args, record, line)
        print_files(args, ", ".join(map(printable, record["files"])))
        return code
    except BadOutput:
        raise
    except (BadInput, NoSolution) as cause:
        record, line = refusal(cause, _names(args), format=FORMAT)
        if cause.reason == Reason.INCONSISTENT_EVIDENCE:
            record["advice"] = ADVICE
        return print_outcome(args, record, line)


def _measure(args: argparse.Namespace) -> Outcome:
    """The record and the line of a skyline that was measured and written."""
    outputs, picture = _outputs(args)
    horizon.check_outputs(*outputs, overwrite=args.overwrite)
    horizon.check_outputs(*picture, overwrite=True)
    done: list[str] = []
    with stating_work(lambda: done[-1] if done else "no image was identified"), limited_time(args.time_limit):
        exposures = read_each_once(args)
        site = site_of(args, exposures)
        if site is None:
            raise BadInput(
                "bad_terrain", "the site is not known: give --site LAT,LON[,M]; without it there is no azimuth"
            )
        if site.body != "earth":
            raise BadInput("bad_terrain", f"the site is on the {site.body}: this command is for cameras on the Earth")
        camera = approximate_camera(args, exposures)
        steps = 2 * len(exposures) + 1
        with named_steps(args, f"horizon from {_count_text(len(exposures))}", steps) as show_step:

            def begin(text: str) -> None:
                done.append(text)
                show_step(text)

            frames, left_out = horizon.orient_frames(
                exposures, load_catalog(), site, camera=camera, fov_rad=args.fov, progress=begin
            )
            print_left_out(left_out if frames else ())  # else the refusal names them
            found = horizon.measure_frames(frames, left_out, site, begin)
    files = horizon.write_skyline(found.skyline, site, found.frames, *outputs, overwrite=args.overwrite)
    files += horizon.write_skyline(found.skyline, site, found.frames, *picture, overwrite=True)
    unknown = int((~found.skyline.known).sum())
    varying = int((found.skyline.source == "varies").sum())
    interpolates = unknown and any(map(horizon.needs_all_azimuths, args.output))
    notes = [f"{unknown} of the {len(found.skyline)} interpolated"] if interpolates else []
    notes += [f"{varying} differ between the images: the highest edge is taken"] if varying else []
    notes += [UNTESTED] if len(found.frames) == 1 else []
    note = "; ".join(notes)
    record, skyline = _record(args, found, files, note), found.skyline
    words = [f"{record['azimuths']['known']} of {len(skyline)} azimuths"]
    if record["median_sigma_deg"] is not None:
        words.append(f"median sigma {record['median_sigma_deg']:.2f}°")
    words.append(_count_text(len(found.frames)))
    line = "  ".join([one_line(_names(args)), "ok", *words, *([note] if note else [])])
    if args.verbose:
        line += "".join(f"\n  {one_line(one.name)}: {len(one.matched_star)} stars fit the lens" for one in found.frames)
    return record, line


def _outputs(args: argparse.Namespace) -> tuple[list[str], list[str]]:
    """The paths of -o, in the folder of -D, and that of the picture beside the first, where none of them is one.

    The picture replaces one of an earlier run: nobody named it.
    """
    outputs = [os.path.join(args.dir or "", output) for output in args.output]
    if args.no_plots or any(output.lower().endswith(".png") for output in outputs):
        return outputs, []
    return outputs, [f"{outputs[0].rstrip('/')}.png"]


def _count_text(images: int) -> str:
    return f"{images} image{'s' if images > 1 else ''}"


def _names(args: argparse.Namespace) -> str:
    return ", ".join(Path(output).name for output in args.output)


def _record(
    args: argparse.Namespace, found: horizon.SkylineResult, files: Sequence[Path], note: str
) -> dict[str, Any]:  # fmt: skip
    skyline, known = found.skyline, found.skyline.known
    return {
        "format": FORMAT,
        "status": "ok",
        "reason": None,
        "message": note,
        "output": _names(args),
        "files": list(map(str, files)),
        "images": [frame.name for frame in found.frames],
        "left_out": [{"image": one.name, "reason": one.reason, "message": one.message} for one in found.left_out],
        "azimuths": {
            "known": int(known.sum()),
            **{
                name.replace(" ", "_"): int((skyline.source == name).sum())
                for name in ("stars", "sky light", "both", "varies")
            },
        },
        "median_sigma_deg": float(np.degrees(np.median(skyline.sigma_rad[known]))) if known.any() else None,
        "lowest_deg": math.degrees(skyline.elevation_rad[known].min()) if known.any() else None,
        "highest_deg": math.degrees(skyline.elevation_rad[known].max()) if known.any() else None,
    }
