"""Shared by the image commands: flags, the loop over images, exit codes, and paths of results."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from startrack.cli.flag_types import position_prior, seconds, time_sigma_s
from startrack.core.errors import INTERNAL_ERROR, BadInput, BadOutput, exit_code_of, next_step
from startrack.core.files import make_folder

if TYPE_CHECKING:
    from startrack.camera import Camera
    from startrack.core.types import Exposure

DEFAULT_OUT = "startrack-out"
DEFAULT_LOCALIZER = "posterior"
EVIDENCE_SOURCES = ("both", "stars", "sky")  # as startrack.chain.stages has them; written here so that help is quick


def add_image_flags(parser: argparse.ArgumentParser) -> None:
    """Flags of every command that reads images."""
    parser.add_argument(
        "images", nargs="+", metavar="IMAGE", help="PNG, TIFF, FITS, JPEG, camera raw, ROS bag, or BAG#NUMBER"
    )
    add_topic_flag(parser)
    add_fact_flags(parser)
    add_output_flags(parser)


def add_topic_flag(parser: argparse.ArgumentParser) -> None:
    """The flag for the images of a bag."""
    parser.add_argument("--image-topic", metavar="TOPIC", help="of a ROS bag with several")


def add_fact_flags(parser: argparse.ArgumentParser) -> None:
    """Flags for facts that images may lack."""
    parser.add_argument(
        "-c",
        "--camera",
        metavar="FILE",
        help="camera file of startrack, ROS, Kalibr, COLMAP or OpenCV, or the name of a shipped one",
    )
    parser.add_argument("--time", metavar="UTC", help="middle of the exposure, ISO 8601")
    add_time_sigma_flag(parser)
    parser.add_argument("--exposure", type=seconds, metavar="S", help="exposure time in seconds")
    add_pixel_flags(parser)


def add_pixel_flags(parser: argparse.ArgumentParser) -> None:
    """The flags for the pixels that do not count, and for the correction of the others."""
    parser.add_argument(
        "--mask", metavar="FILE", help="8-bit image of the frame's size: pixels below 128 do not count (a mast, a lamp)"
    )
    parser.add_argument("--dark", metavar="FILE", help="dark frame of the frame's size: subtracted, its median kept")
    parser.add_argument("--flat", metavar="FILE", help="flat field of the frame's size, its own dark subtracted")


def add_time_sigma_flag(parser: Any, default: str = "1, and more where it is not stated") -> None:
    """The flag for the sigma of the clock, in a parser or a group of its flags; its help names the `default`."""
    parser.add_argument(
        "--time-sigma", type=time_sigma_s, metavar="SECONDS",
        help=f"standard deviation of the clock's error ({default})",
    )  # fmt: skip


def add_localizer_flags(parser: argparse.ArgumentParser) -> None:
    """The flags that choose the method of localization and its evidence."""
    parser.add_argument(
        "--localizer", default=DEFAULT_LOCALIZER, metavar="NAME",
        help="posterior (default), pseudo-gradient, hull, or another of startrack.localization.LOCALIZERS",
    )  # fmt: skip

    parser.add_argument(
        "--evidence", default=EVIDENCE_SOURCES[0], choices=EVIDENCE_SOURCES,
        help="of the position: stars, the light of the sky that stops at the skyline, or both (default)",
    )  # fmt: skip

    parser.add_argument(
        "--near", type=position_prior, metavar="EAST,NORTH,SIGMA",
        help="prior of the position, a normal distribution [m]: the posterior contains it, and an image that "
        "contradicts it is refused",
    )  # fmt: skip


def check_localizer(args: argparse.Namespace) -> None:
    """A usage error for an unknown name after --localizer, and for one that takes no --near."""
    from startrack.localization import LOCALIZERS

    if getattr(args, "near", None) is not None and args.localizer != DEFAULT_LOCALIZER:
        args.usage_error(f"--near: only --localizer {DEFAULT_LOCALIZER} takes a prior of the position")

    if args.localizer not in LOCALIZERS:
        args.usage_error(f"--localizer {args.localizer}: known are {', '.join(LOCALIZERS)}")


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def add_output_flags(parser: argparse.ArgumentParser) -> None:
    """Flags of every command that writes results."""
    parser.add_argument("-D", "--dir", metavar="OUT", default=DEFAULT_OUT, help="folder of the results (%(default)s)")
    parser.add_argument("-O", "--overwrite", action="store_true", help="replace results of another image of this name")
    parser.add_argument("--json", action="store_true", help="print one JSON object per image")
    parser.add_argument("--no-plots", action="store_true", help="no pictures")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="accepted everywhere; here nothing is random")
    parser.add_argument("-v", "--verbose", action="count", default=0, help="more output; tracebacks of internal errors")
    parser.add_argument("-q", "--quiet", action="store_true", help="print errors only")


def read(path: str, args: argparse.Namespace) -> Exposure:
    """The image with its facts; flags take precedence over sidecar and header. With --image-topic also of a bag."""
    from startrack.exposure import choose_bag_image, read_bag_image, read_exposure, split_bag_path

    bag = split_bag_path(path) if hasattr(args, "image_topic") else None
    if bag is None:
        return read_exposure(path, **flag_facts(args))
    return read_bag_image(choose_bag_image(*bag, args.image_topic), **flag_facts(args))


def flag_facts(args: argparse.Namespace) -> dict[str, Any]:
    """The facts given by flags, by the parameter names of `read_exposure`."""
    from startrack.frames import parse_utc

    flags: dict[str, Any] = {
        "time_utc": parse_utc(args.time) if args.time is not None else None,
        "time_sigma_s": getattr(args, "time_sigma", None),
        "exposure_s": args.exposure,
        "camera": args.camera,
        "terrain": getattr(args, "terrain", None),
        **{key: getattr(args, key, None) for key in ("mask", "dark", "flat")},
    }
    return {key: value for key, value in flags.items() if value is not None}


def camera_of(exposure: Exposure) -> Camera:
    """The camera named by flag, sidecar or header. Raises BadInput (no_calibration) if there is none."""
    from startrack.camera import load_camera

    if exposure.camera is None:
        raise BadInput("no_calibration", "no camera file is known: give -c FILE or a sidecar with camera")
    return load_camera(exposure.camera)


@dataclass(frozen=True)
class Outcome:
    """The printed result of one image."""

    status: str
    reason: str | None
    line: str
    record: dict[str, Any]


def run_images(args: argparse.Namespace, format_name: str, one: Callable[[str, str], Outcome]) -> int:
    """Run `one(path, output stem)` for each image, print its outcome, and return the exit code.

    A BadInput or an internal error of one image is its outcome and does not stop the others.
    """
    codes = [0]
    from startrack.applications.batch import result_stems
    from startrack.exposure import split_bag_path

    if args.image_topic is not None and not any(split_bag_path(path) for path in args.images):
        args.usage_error("--image-topic is for ROS bags, and none is given")
    for path, stem in zip(args.images, result_stems(args.images), strict=True):
        try:
            outcome = one(path, stem)
        except BadInput as cause:
            outcome = _refused_outcome(path, cause, format_name)
        except Exception as cause:
            if args.verbose:
                raise
            outcome = _internal_error(path, cause, format_name)
        for warning in () if args.quiet else outcome.record.get("warnings", ()):
            print(f"{Path(path).name}: {warning}", file=sys.stderr, flush=True)
        if args.json:
            print(json.dumps(outcome.record), flush=True)
        elif outcome.status != "ok":
            print(outcome.line, file=sys.stdout if not args.quiet else sys.stderr, flush=True)
        elif not args.quiet:
            print(outcome.line, flush=True)
        for need in () if args.json or args.quiet else outcome.record.get("explain", ()):
            print(f"  needs {need}", file=sys.stderr, flush=True)
        if not args.json:
            print_advice(outcome.reason, outcome.record.get("message", ""), args)
        codes.append(exit_code(outcome))
    return next((code for code in (1, 4, 3) if code in codes), 0)


def print_advice(reason: str | None, message: str, args: argparse.Namespace) -> None:
    """What to do after a refusal, on stderr, where its `message` does not contain it; once for each reason."""
    advice = "" if reason is None or getattr(args, "quiet", False) else next_step(reason, message)
    printed: set[str] = vars(args).setdefault("printed_advice", set())
    if advice and advice not in printed:
        printed.add(advice)
        print(f"  next: {advice}", file=sys.stderr, flush=True)


def exit_code(outcome: Outcome) -> int:
    """0 solved, 1 internal error, 4 bad input, 3 refused or ambiguous."""
    return exit_code_of(outcome.reason)


def _internal_error(path: str, cause: Exception, format_name: str) -> Outcome:
    """Outcome of an image with an internal error."""
    message = f"internal error: {type(cause).__name__}: {cause} (-v shows the traceback)"
    record = {
        "format": format_name,
        "image": Path(path).name,
        "status": "refused",
        "reason": INTERNAL_ERROR,
        "message": message,
        "advice": INTERNAL_ERROR.advice,
    }
    return Outcome("refused", INTERNAL_ERROR, f"{Path(path).name}  {message}", record)


def _refused_outcome(path: str, cause: BadInput, format_name: str) -> Outcome:
    """Outcome of an image that could not be read, or whose camera or terrain could not."""
    from startrack.output.text import refusal_line

    record = {
        "format": format_name,
        "image": Path(path).name,
        "status": "refused",
        "reason": cause.reason,
        "message": str(cause),
        "advice": cause.reason.advice,
    }
    return Outcome("refused", cause.reason, refusal_line(path, cause.reason, str(cause)), record)


def result_path(args: argparse.Namespace, stem: str, suffix: str, exposure: Exposure) -> Path:
    """Path of a result; its folder is made. A result of the same image is replaced, that of another only with -O.

    Raises BadInput (bad_image, for lack of a better code) before anything is computed. A folder that takes no results
    is a usage error.
    """
    from startrack.output import prepare_folder

    path = Path(args.dir) / f"{stem}{suffix}"
    try:
        make_folder(path.parent)
    except BadOutput as cause:
        args.usage_error(str(cause))
    prepare_folder(path, exposure.sha256, overwrite=args.overwrite, remedy="choose another -D, or replace it with -O")
    return path
