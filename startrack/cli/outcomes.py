"""What a command says of each image: its line or JSON object, advice after a refusal, the exit code."""

from __future__ import annotations

import argparse
import json
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
    exit_code_of,
    next_step,
    reason_of,
)
from startrack.core.files import make_folder

if TYPE_CHECKING:
    from startrack.core.types import Exposure

Outcome = tuple[dict[str, Any], str]  # of an image: the JSON object, and the line or lines


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
    return {**first, "status": "refused", "reason": reason, "message": message, "advice": reason_of(reason).advice}


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
