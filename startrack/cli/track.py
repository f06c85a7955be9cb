"""`startrack track`: the images of a drive, or of a rover at rest, to a trajectory."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

from startrack.cli.common import EVIDENCE_SOURCES, add_fact_flags, add_output_flags, flag_facts
from startrack.cli.drive import ODOMETRY_FLOOR_M, ODOMETRY_SIGMA_1
from startrack.cli.flag_types import amount, seconds
from startrack.cli.track_run import TrackRun

STORE = ".frames"  # in OUT


def add_parser(subparsers: Any) -> None:
    """Add `track` to the commands of the `startrack` parser."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "track",
        help="images of a drive or of a rover at rest to a trajectory",
        description="Locate the images of one camera and estimate its trajectory from all of them, with the errors "
        "that they share. Writes track.tum (by all images), track.filtered.tum (by the images up to each), track.ecsv, "
        "track.geojson, track.json, track.crests.ecsv, track.png and track.html.",
    )
    parser.add_argument("frames", nargs="+", metavar="FRAMES", help="images, one folder, or one ROS bag")
    add_fact_flags(parser)
    parser.add_argument("-t", "--terrain", metavar="FILE", help="terrain file, or the name of a shipped one")
    parser.add_argument("--evidence", default=EVIDENCE_SOURCES[0], choices=EVIDENCE_SOURCES, help="as of locate")
    _add_motion(parser.add_argument_group("motion between the images (without: each is alone but for shared errors)"))
    _add_live(parser.add_argument_group("live"))
    add_output_flags(parser)
    parser.set_defaults(run=run, usage_error=parser.error)


def _add_motion(group: Any) -> None:
    group.add_argument("--odometry", metavar="FILE", help="TUM text, or a ROS bag")
    group.add_argument("--odometry-topic", metavar="TOPIC", help="of a bag with several")
    group.add_argument(
        "--odometry-sigma", type=amount, default=ODOMETRY_SIGMA_1, metavar="F", help="of a move, relative (%(default)s)"
    )
    group.add_argument(
        "--odometry-floor", type=amount, default=ODOMETRY_FLOOR_M, metavar="M", help="beside that (%(default)s)"
    )
    group.add_argument("--at-rest", action="store_true", help="the camera did not move")
    group.add_argument("--image-topic", metavar="TOPIC", help="of a bag with several")


def _add_live(group: Any) -> None:
    group.add_argument("--follow", action="store_true", help="take images as they are written into the folder FRAMES")
    group.add_argument("--until-idle", type=seconds, metavar="S", help="end after S seconds without an image")


def run(args: argparse.Namespace) -> int:
    """Estimate and write the track; the exit code of its worst image."""
    _check_flags(args)
    _check_frames(args)
    from startrack.applications.tracking import FrameStore, TrackSession
    from startrack.chain import Settings

    _check_folder(args)
    session = TrackSession(
        store=FrameStore(Path(args.dir) / STORE), settings=Settings(evidence_sources=args.evidence),
        facts=flag_facts(args),
    )  # fmt: skip
    run_of = TrackRun(args, session)
    if args.follow:
        run_of.follow()
    else:
        run_of.take_all()
    return next((code for code in (1, 4, 5, 3) if code in run_of.codes), 0)


def _check_flags(args: argparse.Namespace) -> None:
    if args.odometry is not None and args.at_rest:
        args.usage_error("--odometry is for a rover that moves, --at-rest for one that does not: give one of them")
    if args.time is not None:
        args.usage_error("--time is that of one image: the images of a track have their times in sidecars or headers")
    if args.follow and (len(args.frames) != 1 or not Path(args.frames[0]).is_dir()):
        args.usage_error(f"--follow takes one folder, into which images are written: {args.frames[0]} is no folder")
    if args.until_idle is not None and not args.follow:
        args.usage_error("--until-idle is for --follow")


def _check_frames(args: argparse.Namespace) -> None:
    """Raises BadInput (bad_image) where no path of FRAMES exists; one missing image of several is refused later."""
    from startrack.core.errors import BadInput
    from startrack.core.files import printable

    if not any(os.path.exists(path) for path in args.frames):
        raise BadInput(
            "bad_image", f"{printable(args.frames[0])}: no such file or folder: give images, one folder of images, or "
            "one ROS bag",
        )  # fmt: skip


def _check_folder(args: argparse.Namespace) -> None:
    """Make the folder of the results. Raises BadOutput where it holds the track of other images, and not -O."""
    from startrack.core.errors import BadOutput
    from startrack.core.files import make_folder

    out = Path(args.dir)
    make_folder(out)
    if not args.overwrite and (out / "track.json").exists() and not (out / STORE).is_dir():
        raise BadOutput(
            "bad_image", f"{out} holds a track that this command did not write: choose another -D, or give -O"
        )
