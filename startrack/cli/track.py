"""`startrack track`: the images of a drive, or of a rover at rest, to a trajectory."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from startrack.cli import flags
from startrack.cli.flag_types import seconds
from startrack.cli.flags import Command, flag
from startrack.cli.images import flag_facts, worst_code
from startrack.cli.track_run import TrackRun
from startrack.core.errors import BadInput, BadOutput
from startrack.core.files import make_folder, printable

STORE = ".frames"  # in OUT


def run(args: argparse.Namespace) -> int:
    """Estimate and write the track; the exit code of its worst image."""
    _check_flags(args)
    from startrack.applications.tracking import FrameStore, TrackSession
    from startrack.chain import Settings

    _check_folder(args)
    store, settings = FrameStore(Path(args.dir) / STORE), Settings(evidence_sources=args.evidence)
    errors = {"odometry_sigma": args.odometry_sigma, "odometry_floor_m": args.odometry_floor}
    track = TrackRun(args, TrackSession(store=store, settings=settings, facts=flag_facts(args), **errors))
    if args.follow:
        track.follow()
    else:
        track.take_all()
    return worst_code(track.codes)


def _check_flags(args: argparse.Namespace) -> None:
    """A usage error for flags that do not go together. Raises BadInput (bad_image) where no path of FRAMES exists."""
    if args.odometry is not None and args.at_rest:
        args.usage_error("--odometry is for a rover that moves, --at-rest for one that does not: give one of them")
    if args.time is not None:
        args.usage_error("--time is that of one image: the images of a track have their times in sidecars or headers")
    if args.follow and (len(args.frames) != 1 or not Path(args.frames[0]).is_dir()):
        args.usage_error(f"--follow takes one folder, into which images are written: {args.frames[0]} is no folder")
    if args.until_idle is not None and not args.follow:
        args.usage_error("--until-idle is for --follow")
    if not any(os.path.exists(path) for path in args.frames):  # one missing image of several is refused later
        first = printable(args.frames[0])
        message = f"{first}: no such file or folder: give images, one folder of images, or one ROS bag"
        raise BadInput("bad_image", message)


def _check_folder(args: argparse.Namespace) -> None:
    """Make the folder of the results. Raises BadOutput where it holds the track of other images, and not -O."""
    out = Path(args.dir)
    make_folder(out)
    if not args.overwrite and (out / "track.json").exists() and not (out / STORE).is_dir():
        raise BadOutput(
            "bad_image", f"{out} holds a track that this command did not write: choose another -D, or give -O"
        )


COMMANDS = (
    Command(
        "track", run, "images of a drive or of a rover at rest to a trajectory",
        "Locate the images of one camera and estimate its trajectory from all of them, with the errors that they "
        "share. Writes track.tum (by all images), track.filtered.tum (by the images up to each), track.ecsv, "
        "track.geojson, track.json, track.crests.ecsv, track.png and track.html.",
        {
            "input": (
                flag("frames FRAMES", "images, one folder, or one ROS bag", nargs="+"),
                flags.TOPIC, *flags.FACTS, flags.TERRAIN,
            ),
            "method": (flags.EVIDENCE,),
            "motion between the images (without: each is alone but for shared errors)": (
                flag("--odometry FILE", "TUM text, or a ROS bag"),
                flag("--odometry-topic TOPIC", "of a bag with several"),
                *flags.ODOMETRY,
                flag("--at-rest", "the camera did not move"),
            ),
            "live": (
                flag("--follow", "take images as they are written into the folder FRAMES"),
                flag("--until-idle S", "end after S seconds without an image", seconds),
            ),
            "output": flags.OUTPUT,
            "more": (flags.NO_SEED, *flags.MORE),
        },
        "startrack track DRIVE/ --odometry odometry.tum -c camera.toml -t shackleton",
    ),
)  # fmt: skip
