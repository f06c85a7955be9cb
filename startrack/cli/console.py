"""What a command prints: outcomes of images, advice, and the progress bar of work that lasts."""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from threading import Event, Thread
from typing import TYPE_CHECKING, Any, Literal, TextIO

from startrack.core import errors
from startrack.core.errors import BadInput, NoSolution, Reason, fitting_advice
from startrack.core.files import printable

if TYPE_CHECKING:
    from rich.progress import Progress as RichProgress

STEP_S = {  # of a step, by the first word of what is done: images of 4 Mpx, draws on a height map, 2 cores
    "calibrate": 0.25, "calibrate-board": 1.0, "horizon": 0.7, "locate": 0.6, "predict": 2.0,
    "render": 1.3, "track": 1.0,
}  # fmt: skip
LINE_S = 10.0
ANNOUNCED_S = 5.0  # a longer wait is announced
MOST_UNITS = 100  # of a duration, from which a larger unit is used
UNITS = (1.0, "s"), (60.0, "minutes"), (3600.0, "hours")
NUMBER_COLUMN = re.compile(r"([^\d+-]*)([+-]?\d+(?:\.\d+)?)(.*)")
NUMBER_WIDTHS = {"E ": 8, "N ": 8, "±": 5, "heading ": 5, "": 4}  # least widths, by the text before the number
Outcome = tuple[dict[str, Any], str]  # of an image: the JSON object, and the line or lines


def refusal(cause: BadInput | NoSolution, name: str, **first: Any) -> Outcome:
    """The outcome of an image or file `name` that was refused; `first` stands at the beginning of the JSON object."""
    reason, message = cause.reason, str(cause)
    record = {**first, "status": "refused", "reason": reason, "message": message, "advice": Reason(reason).advice}
    return record, f"{errors.one_line(name)}  refused  {reason}: {message}"


def print_outcome(args: argparse.Namespace, record: dict[str, Any], line: str) -> int:
    """Print the record or the line, with its advice; the exit code of its reason."""
    reason = record["reason"]
    if args.json:
        print(json.dumps(record), flush=True)
        return errors.exit_code_of(reason)
    if reason is not None and record.get("advice"):
        print_refusal(args, line, reason, record["message"], own=record["advice"], to_stdout=not args.quiet)
    elif not args.quiet or record["status"] != "ok":
        print(line, file=sys.stderr if args.quiet else sys.stdout, flush=True)
    for need in () if args.quiet else record.get("explain", ()):
        print(f"  needs {need}", file=sys.stderr, flush=True)
    return errors.exit_code_of(reason)


def print_refusal(
    args: argparse.Namespace, line: str, reason: str, message: str, *, own: str = "", to_stdout: bool = False
) -> None:
    """Print the `line` of a refusal and, behind it, what to do where its `message` does not contain that.

    `own` is the advice of the command, which comes before that of the reason. Each advice is printed once. It stands in
    the same line, so that no pipe parts the two; on a terminal in an indented one below.
    """
    stream = sys.stdout if to_stdout else sys.stderr
    advice = "" if getattr(args, "quiet", False) else _advice(reason, message, own)
    printed: set[str] = vars(args).setdefault("printed_advice", set())
    if advice and advice not in printed:
        printed.add(advice)
        first, *others = line.split("\n")
        line = "\n".join([f"{first}\n  next: {advice}" if stream.isatty() else f"{first}  next: {advice}", *others])
    print(line, file=stream, flush=True)


def _advice(reason: str, message: str, own: str) -> str:
    """What to do after a refusal: by its `message`, else the command's `own`, else that of the `reason`."""
    fitting = fitting_advice(message)
    if fitting is not None:
        return fitting
    advice = errors.next_step(reason, message)
    return own if advice and own not in ("", errors.Reason(reason).advice) else advice


class Columns:
    """Lines of several images in steady columns: names as wide as the longest, numbers to the right."""

    def __init__(self, names: Iterable[str]) -> None:
        self._name_width = max((len(errors.one_line(name)) for name in names), default=0)
        self._widths: dict[tuple[str, str], int] = {}

    def aligned(self, line: str) -> str:
        """The `line` of an image, whose columns two spaces part, with the widths of the lines before."""
        first, newline, rest = line.partition("\n")
        name, *columns = first.split("  ")
        return "  ".join([name.ljust(self._name_width), *map(self._padded, columns)]) + newline + rest

    def _padded(self, column: str) -> str:
        match = NUMBER_COLUMN.fullmatch(column)
        if match is None:
            return column
        before, number, after = match.groups()
        width = max(self._widths.get((before, after), NUMBER_WIDTHS.get(before, 0)), len(number))
        self._widths[before, after] = width
        return f"{before}{number.rjust(width)}{after}"


def print_files(args: argparse.Namespace, files: str, page: str | os.PathLike[str] | None = None) -> None:
    """The last line of a command, on stderr: where its `files` are, and the `page` for a browser if there is one."""
    if not (args.quiet or args.json):
        page_text = "" if page is None else f"; page {printable(page)}"
        print(f"files {files}{page_text}", file=sys.stderr, flush=True)


def print_warnings(args: argparse.Namespace, name: str, warnings: Iterable[str], *, of_all: bool = False) -> None:
    """A line on stderr for each of the `warnings` about `name`; those `of_all` images once, under that name."""
    printed: set[tuple[str, str]] = vars(args).setdefault("printed_of_all", set())
    for warning in () if args.quiet else warnings:
        if (name if of_all else "", warning) not in printed:
            print(f"{errors.one_line(name)}: {warning}", file=sys.stderr, flush=True)
        if of_all:
            printed |= {(name, warning), ("", warning)}


def print_left_out(images: Any) -> None:
    """A line on stderr for each of the `images` refused, which have a name, a reason and a message."""
    for one in images:
        print(f"{errors.one_line(one.name)}: left out, {one.reason}: {one.message}", file=sys.stderr, flush=True)


def worst_code(codes: set[int]) -> int:
    """The exit code of a command whose images have these `codes`."""
    order = (errors.EXIT_INTERNAL_ERROR, errors.EXIT_BAD_INPUT, errors.EXIT_STOPPED, errors.EXIT_REFUSED)
    return next((code for code in order if code in codes), errors.EXIT_OK)


def open_closed_streams() -> None:
    """Open the standard streams that the shell has closed (>&-): output as a pipe that nobody reads, others as empty.

    Their numbers are then taken, so that no file that is opened later gets what is printed.
    """
    if sys.stdin is None:
        sys.stdin = _stream(0, os.open(os.devnull, os.O_RDONLY), "r")
    if sys.stdout is None:
        reader, writer = os.pipe()
        os.close(reader)
        sys.stdout = _stream(1, writer, "w")
    if sys.stderr is None:
        sys.stderr = _stream(2, os.open(os.devnull, os.O_WRONLY), "w")


def _stream(number: int, descriptor: int, mode: Literal["r", "w"]) -> TextIO:
    """The text stream of a `descriptor`, under its usual `number` if that is free."""
    try:
        os.fstat(number)
    except OSError:
        os.dup2(descriptor, number)
        os.close(descriptor)
        descriptor = number
    return open(descriptor, mode, encoding="utf-8", errors="backslashreplace")


def discard_stdout() -> None:
    """Discard the rest of the buffer: its reader has ended, or its disk is full."""
    with suppress(OSError, ValueError):  # not a file, as under a test
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class Progress:
    """Steps done of all steps and the text of the current one; with a bar of rich its row shows them."""

    def __init__(self, total: int | None = None, bar: RichProgress | None = None, row: Any = None) -> None:
        self.completed, self.total, self.text = 0, total, ""
        self._bar, self._row = bar, row
        self._done = [(time.monotonic(), 0)]  # times and steps done: of the start, the first step and the last one

    def advance(self, steps: int = 1, text: str | None = None) -> None:
        """Further steps are done; `text` names the current step."""
        self.text = self.text if text is None else text
        self.update(self.completed + steps, self.total)

    def update(self, completed: int, total: int | None) -> None:
        """Numbers of steps done and of all steps."""
        if completed > self.completed:
            self._done = [*self._done[:2], (time.monotonic(), completed)]
        self.completed, self.total = completed, total
        if self._bar is not None:
            self._bar.update(self._row, completed=completed, total=total, text=self.text)

    def line(self) -> str:
        """What is done after how many seconds, and the time left at the mean speed of the later steps."""
        now, (first_s, first), (last_s, last) = time.monotonic(), self._done[len(self._done) // 3], self._done[-1]
        to_do, left_s = (self.total or 0) - self.completed, 0.0
        if last > first:
            left_s = (last_s - first_s) / (last - first) * to_do - (now - last_s)
        count = f"{self.completed} of {self.total}" if self.total else ""
        left = f"about {duration_text(left_s)} left" if left_s > 0.0 else ""
        return errors.one_line(
            ", ".join(one for one in (count, self.text, f"{now - self._done[0][0]:.0f} s", left) if one)
        )


@contextmanager
def progress(
    what: str, total: int | None = None, *, shown: bool = True, jobs: int = 1, about_s: float | None = None
) -> Iterator[Progress]:
    """A bar on stderr with the time left and a text, if `shown`; it disappears at the end.

    A line before it says what is done, by the first word of `what`, in `jobs` processes, and how long that may take:
    `about_s`, or by the number of steps.
    Where stderr is no terminal, a line every LINE_S seconds shows that the work goes on, and the time left.
    """
    if not shown or total == 0:
        yield Progress(total)
        return
    if not sys.stderr.isatty():
        with _lines_about(what, Progress(total)) as steps:
            yield steps
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as RichProgress

    wait_s = STEP_S.get(what.split()[0], 0.0) * (total or 1) / jobs if about_s is None else about_s
    if wait_s > ANNOUNCED_S:
        print(f"{what}: about {duration_text(wait_s)}", file=sys.stderr, flush=True)
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with RichProgress(*columns, TextColumn("{task.fields[text]}"), console=Console(stderr=True), transient=True) as bar:
        yield Progress(total, bar, bar.add_task(what, total=total, text=""))


@contextmanager
def _lines_about(what: str, steps: Progress) -> Iterator[Progress]:
    """In the block, print the state of the `steps` on stderr every LINE_S seconds."""
    end = Event()

    def print_lines() -> None:
        while not end.wait(LINE_S):
            print(f"{what}: {steps.line()}", file=sys.stderr, flush=True)

    thread = Thread(target=print_lines, daemon=True)
    thread.start()
    try:
        yield steps
    finally:
        end.set()
        thread.join()


def wait_lines(args: argparse.Namespace, what: str) -> AbstractContextManager[object]:
    """In the block, a line on stderr every LINE_S seconds shows that `what` goes on, unless the flags forbid it."""
    return nullcontext() if args.quiet or args.json else _lines_about(what, Progress())


@contextmanager
def named_steps(args: argparse.Namespace, what: str, total: int) -> Iterator[Callable[[str], None]]:
    """A bar over `total` steps, as of `progress`; the function to call with the name of each when it begins."""
    with progress(what, total, shown=not (args.quiet or args.json)) as bar:
        yield lambda text: bar.advance(text=text)


def duration_text(seconds: float) -> str:
    """A duration in words: 40 s, 12 minutes, 5 hours."""
    unit_s, unit = next((one for one in UNITS if seconds < MOST_UNITS * one[0]), UNITS[-1])
    return f"{max(round(seconds / unit_s), 1)} {unit}"
