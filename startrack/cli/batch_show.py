"""Output of a batch while it runs, and its early stop by signals."""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from startrack.cli.images import discard_stdout
from startrack.cli.progress import progress
from startrack.core.errors import EXIT_BAD_INPUT, INTERNAL_ERROR, exit_code_of

if TYPE_CHECKING:
    from startrack.applications.batch import Rows

SHOWN = ("ok", "ambiguous", "refused", "error")
FINISHING = b"\nstartrack: finishing the images in progress; a second Ctrl-C drops them\n"
SAME_SIGNAL_S = 1.0  # a second signal within it is the same request: timeout signals process and group
Counts = Counter[str]  # images by outcome: ok, ambiguous, refused, error; and kept, warned
Show = Callable[[dict[str, Any], Counts], None]


class Halt:
    """Stops a batch after the images in progress, and keeps the first cause."""

    def __init__(self, stop: Callable[[], None]) -> None:
        self.why: str | None = None
        self._stop = stop

    def __call__(self, why: str) -> None:
        self.why = self.why or why
        self._stop()


@contextmanager
def halt_on_signals(halt: Halt) -> Iterator[None]:
    """In the block the first Ctrl-C or SIGTERM stops the batch after the images in progress, a later one at once."""
    first_s: float | None = None

    def on_signal(number: int, _: object) -> None:
        nonlocal first_s
        now_s = time.monotonic()
        if first_s is None:
            first_s = now_s
            os.write(2, FINISHING)  # not print, which is not reentrant
            halt("interrupted" if number == signal.SIGINT else "terminated")
        elif now_s - first_s > SAME_SIGNAL_S:
            raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():  # only the main thread gets signals
        yield
        return
    before = {number: signal.signal(number, on_signal) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def show_outcomes(total: int, args: argparse.Namespace, halt: Halt) -> Iterator[Show]:
    """A function to call with each record and the counts; a bar on a terminal."""

    def print_lines(record: dict[str, Any]) -> None:
        if record["reason"] == INTERNAL_ERROR:
            print(f"{record['image']}: {record['message']}", file=sys.stderr, flush=True)
        for warning in record.get("warnings", ()) if args.verbose else ():
            print(f"{record['image']}: {warning}", file=sys.stderr, flush=True)
        try:
            if args.json:
                print(json.dumps(record), flush=True)
            elif args.verbose:
                print(f"{record['image']}: {record['status']} {record['message']}".rstrip(), flush=True)
            elif record["reason"] and exit_code_of(record["reason"]) == EXIT_BAD_INPUT and not args.quiet:
                print(f"{record['image']}: {record['reason']}: {record['message']}", file=sys.stderr, flush=True)
        except BrokenPipeError:
            discard_stdout()
            halt("the output is no longer read")

    with progress("locate", total, shown=not args.quiet) as bar:

        def show(record: dict[str, Any], counts: Counts) -> None:
            print_lines(record)
            bar.advance(text="  ".join(f"{counts[name]} {name}" for name in SHOWN if counts[name]))

        yield show


def summary(counts: Counts, total: int) -> str:
    """Number of images of each outcome, in words."""
    parts = [f"{counts[name]} {name}" for name in SHOWN if counts[name]]
    kept = f" ({counts['kept']} were there already)" if counts["kept"] else ""
    warned = f"; {counts['warned']} with warnings (-v shows them)" if counts["warned"] else ""
    return f"{total} images: {', '.join(parts)}{kept}{warned}"


def omission_lines(found: Rows) -> list[str]:
    """A line for each kind of result that is in the folder but not in its tables."""
    lines = []
    if found.superseded:
        lines.append(
            f"{_results(found.superseded, 'earlier ')} kept, and left out of the tables: the image, or its sidecar, "
            "camera or terrain file, cannot be used now"
        )
    if found.omitted:
        lines.append(
            f"{_results(found.omitted)} of other settings or contents left out of the tables; startrack batch over "
            "the whole folder renews them"
        )
    return lines


def _results(number: int, kind: str = "") -> str:
    return f"{number} {kind}result{'' if number == 1 else 's'}"
