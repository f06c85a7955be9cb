"""The images of a command: read with the facts that flags state, and what is printed of each."""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from startrack.core.errors import (
    EXIT_BAD_INPUT,
    EXIT_INTERNAL_ERROR,
    EXIT_OK,
    EXIT_REFUSED,
    EXIT_STOPPED,
    INTERNAL_ERROR,
    BadInput,
    BadOutput,
    Reason,
    exit_code_of,
    next_step,
)
from startrack.core.files import is_path, make_folder

if TYPE_CHECKING:
    from startrack.camera import Camera
    from startrack.core.declaration import Key
    from startrack.core.types import Exposure
    from startrack.frames import Site

Outcome = tuple[dict[str, Any], str]  # of an image: the JSON object, and the line or lines
FACT_FLAGS = {  # keyword of `read_exposure`: argument of the command
    "time_utc": "time", "time_sigma_s": "time_sigma", "exposure_s": "exposure", "camera": "camera",
    "terrain": "terrain", "mask": "mask", "dark": "dark", "flat": "flat",
}  # fmt: skip


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

    given = {key: getattr(args, name, None) for key, name in FACT_FLAGS.items()}
    facts = {key: value for key, value in given.items() if value is not None}
    return facts | {"time_utc": parse_utc(args.time)} if "time_utc" in facts else facts


def absolute_reference(reference: str) -> str:
    """The path absolute, as workers may run in other folders; a shipped name as it is."""
    return os.path.abspath(reference) if is_path(reference) else reference


def absolute_facts(args: argparse.Namespace) -> dict[str, Any]:
    """The facts given by flags, with absolute paths. Raises BadInput where one of the files cannot be used."""
    from startrack.camera import load_camera
    from startrack.exposure import read_dark, read_flat, read_mask
    from startrack.terrain import load_terrain

    load: dict[str, Callable[[str], object]] = {
        "camera": load_camera, "terrain": load_terrain, "mask": read_mask, "dark": read_dark, "flat": read_flat,
    }  # fmt: skip
    facts = flag_facts(args)
    for key in (key for key in load if key in facts):
        load[key](facts[key])
        is_name = key in ("camera", "terrain") and not is_path(facts[key])
        facts[key] = facts[key] if is_name else os.path.abspath(facts[key])
    return facts


def check_fov(args: argparse.Namespace) -> None:
    """A usage error for a field of view beside a camera."""
    if args.fov is not None and args.camera is not None:
        args.usage_error("--fov is for an unknown lens, -c for a known one: give one of them")


def check_one_time(args: argparse.Namespace) -> None:
    """A usage error for the time of one image where there are several."""
    if args.time is not None and len(args.images) > 1:
        args.usage_error("--time is the time of one image; give each of several its own in a sidecar NAME.json")


def camera_of(exposure: Exposure) -> Camera:
    """The camera named by flag, sidecar or header. Raises BadInput (no_calibration) if there is none."""
    from startrack.camera import load_camera

    if exposure.camera is None:
        raise BadInput("no_calibration", "no camera file is known: give -c FILE or a sidecar with camera")
    return load_camera(exposure.camera)


def approximate_camera(args: argparse.Namespace, exposures: list[Exposure]) -> Camera | None:
    """The initial camera: the flag's, else (without --fov) the one that the images name."""
    from startrack.camera import load_camera

    named = args.camera or (None if args.fov else next((e.camera for e in exposures if e.camera), None))
    return load_camera(named) if named else None


def flag_site(args: argparse.Namespace) -> Site | None:
    """The site of --site; None without it. A usage error for a place that is not on the Earth."""
    from startrack.frames import Site
    from startrack.terrain import TERRAIN_KEYS

    if not args.site:
        return None
    try:
        words = [float(word) for word in args.site.split(",")]
        names = ("latitude_deg", "longitude_deg", "height_m")[: max(len(words), 2)]
        keys = dict(zip(names, words, strict=True))
    except ValueError:
        args.usage_error(f"--site {args.site}: latitude, longitude and, if known, height: 34.74,-111.42,2361")
    site = checked_flag(args, TERRAIN_KEYS.keys["origin"], keys, "--site")
    return Site("earth", math.radians(site["latitude_deg"]), math.radians(site["longitude_deg"]), site["height_m"])


def site_of(args: argparse.Namespace, exposures: list[Exposure]) -> Site | None:
    """The site of --site, else of the terrain that a flag or the images name; None if there is none."""
    from startrack.terrain import load_terrain

    given = flag_site(args)
    named = next((e.terrain for e in exposures if e.terrain), None)
    return given if given is not None or named is None else load_terrain(named).site


def checked_flag(args: argparse.Namespace, key: Key, value: Any, flag: str) -> Any:
    """The value of a `flag` as the `key` of a file would have it; else a usage error."""
    try:
        return key.check(value, flag)
    except ValueError as cause:
        args.usage_error(str(cause))


def run_images(args: argparse.Namespace, format_name: str, one: Callable[[str, str], Outcome]) -> int:
    """Run `one(path, output stem)` for each image, print its outcome, and return the exit code.

    A BadInput or an internal error of one image is its outcome and does not stop the others.
    """
    from startrack.applications.batch import result_stems
    from startrack.exposure import split_bag_path
    from startrack.output import refusal_line

    if args.image_topic is not None and not any(split_bag_path(path) for path in args.images):
        args.usage_error("--image-topic is for ROS bags, and none is given")
    codes = set()
    for path, stem in zip(args.images, result_stems(args.images), strict=True):
        name = Path(path).name
        try:
            record, line = one(path, stem)
        except BadInput as cause:
            record = refusal(cause.reason, str(cause), format=format_name, image=name)
            line = refusal_line(path, cause.reason, str(cause))
        except Exception as cause:
            if args.verbose:
                raise
            message = f"internal error: {type(cause).__name__}: {cause} (-v shows the traceback)"
            record, line = refusal(INTERNAL_ERROR, message, format=format_name, image=name), f"{name}  {message}"
        for warning in () if args.quiet else record.get("warnings", ()):
            print(f"{name}: {warning}", file=sys.stderr, flush=True)
        codes.add(print_outcome(args, record, line))
    return worst_code(codes)


def worst_code(codes: set[int]) -> int:
    """The exit code of a command whose images have these `codes`."""
    order = (EXIT_INTERNAL_ERROR, EXIT_BAD_INPUT, EXIT_STOPPED, EXIT_REFUSED)
    return next((code for code in order if code in codes), EXIT_OK)


def refusal(reason: str, message: str, **first: Any) -> dict[str, Any]:
    """The JSON object of what was refused; `first` stands at its beginning."""
    return {**first, "status": "refused", "reason": reason, "message": message, "advice": Reason(reason).advice}


def print_outcome(args: argparse.Namespace, record: dict[str, Any], line: str) -> int:
    """Print the record or the line; the exit code of its reason."""
    if args.json:
        print(json.dumps(record), flush=True)
        return exit_code_of(record["reason"])
    if not args.quiet or record["status"] != "ok":
        print(line, file=sys.stderr if args.quiet else sys.stdout, flush=True)
    for need in () if args.quiet else record.get("explain", ()):
        print(f"  needs {need}", file=sys.stderr, flush=True)
    print_advice(record["reason"], record.get("message", ""), args)
    return exit_code_of(record["reason"])


def print_advice(reason: str | None, message: str, args: argparse.Namespace) -> None:
    """What to do after a refusal, on stderr, where its `message` does not contain it; once for each reason."""
    advice = "" if reason is None or getattr(args, "quiet", False) else next_step(reason, message)
    printed: set[str] = vars(args).setdefault("printed_advice", set())
    if advice and advice not in printed:
        printed.add(advice)
        print(f"  next: {advice}", file=sys.stderr, flush=True)


def discard_stdout() -> None:
    """Discard the rest of the buffer: its reader has ended, or its disk is full."""
    with suppress(OSError, ValueError):  # not a file, as under a test
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


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
