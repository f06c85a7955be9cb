"""`startrack batch`: every image of a folder, in parallel; a stopped run is resumed."""

from __future__ import annotations

import argparse
import json
import os
import shlex
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

from startrack.applications import batch
from startrack.applications.batch import Image, ImageDone, Task
from startrack.cli.console import discard_stdout, print_refusal, print_warnings, progress
from startrack.cli.flags import check_cluster, check_localizer
from startrack.cli.images import absolute_facts, maps_left_out, prepare_reference, settings_of
from startrack.cli.pictures.report import write_page_of
from startrack.core import errors
from startrack.core.errors import INTERNAL_ERROR, BadInput
from startrack.core.file_kinds import KINDS_TEXT
from startrack.core.files import make_folder, printable
from startrack.core.runner import Runner, RunStopped, count_cores
from startrack.exposure import is_bag
from startrack.output import refusal_line

SHOWN = ("ok", "ambiguous", "refused", "error")
FINISHING = b"\nstartrack: finishing the images in progress; a second Ctrl-C drops them\n"
SAME_SIGNAL_S = 1.0  # a second signal within it is the same request: timeout signals process and group
Counts = Counter[str]  # images by outcome: ok, ambiguous, refused, error; and kept, warned, beam


def run(args: argparse.Namespace) -> int:
    """Locate all images; 0 if all are solved, 5 if some are not or the run was stopped, 1 after an internal error."""
    check_cluster(args)
    check_localizer(args)
    facts = absolute_facts(args)
    found, whole = _find_images(args)
    out = make_folder(args.dir)
    with batch.lock_results(out):
        return _locate_images(found, whole, out, facts, args)


def _find_images(args: argparse.Namespace) -> tuple[Sequence[Image], Sequence[Image]]:
    """The images to locate, and all images of the folder or bag. Raises BadInput (bad_image) where there is none."""
    of_bag = is_bag(args.folder)
    if of_bag and args.files_on_stdin:
        args.usage_error(f"--files-on-stdin is for a folder of files, and {args.folder} is a ROS bag")
    if of_bag and args.time is not None:
        args.usage_error("--time is of one image: the images of a ROS bag have the times of their messages")
    if not of_bag and args.image_topic is not None:
        args.usage_error(f"--image-topic is for a ROS bag, and {args.folder} is none")
    if of_bag:
        found = whole = batch.images_of_bag(args.folder, args.image_topic)
    else:
        found = whole = batch.images_under(args.folder, args.dir)
    if args.files_on_stdin:
        listed = sys.stdin.buffer.read()
        paths = os.fsdecode(listed).split("\0" if b"\0" in listed else "\n")  # ended by NUL, or else one a line
        found = batch.listed_images(args.folder, paths, args.dir)
    maps = maps_left_out({*whole, *found})
    found, whole = ([image for image in images if image not in maps] for images in (found, whole))
    if not found:
        raise BadInput("bad_image", f"{args.folder}: no {KINDS_TEXT} images there")
    if args.time is not None and len(found) > 1:
        args.usage_error(
            f"--time is of one image, and {args.folder} has {len(found)}: give each its time in a sidecar NAME.json "
            "with time_utc"
        )
    return found, whole


def _locate_images(
    found: Sequence[Image], whole: Sequence[Image], out: Path, facts: dict[str, Any], args: argparse.Namespace
) -> int:
    """Locate the images `found` and write the tables of the `whole` folder or bag; the exit code."""
    if not args.overwrite and batch.belongs_to_other_images(out, whole):
        args.usage_error(
            f"{out} holds a batch of other images than {args.folder} has now: choose another -D, or replace its "
            "results and tables with -O"
        )
    tasks = _tasks(found, out, facts, args)
    if args.cluster is None and (args.overwrite or not all(os.path.exists(task.result) for task in tasks)):
        _prepare(tasks[0], args)
    runner: Runner[Task, ImageDone] = Runner(batch.locate_image, jobs=args.jobs or count_cores(), cluster=args.cluster)
    shown = _Shown(args, len(tasks), runner.stop)
    with shown.halt_by_signals():
        with runner:
            records = shown.take(runner, tasks)
        stopped = shown.halted if len(records) < len(tasks) else None
        try:
            _write_tables(args, out, _tasks(sorted({*whole, *found}), out, facts, args), records)
            lack = "" if batch.has_parquet() else " (no results.parquet: the extra parquet is missing)"
            tables = f"tables in {printable(out)}{lack}"
        except BadInput as cause:
            stopped, tables = stopped or "the tables cannot be written", f"no tables: {cause}"
    if stopped:
        again = "the same command without -O" if args.overwrite else "the same command"
        done = f"{stopped}: {len(records)} of {len(tasks)} images done, {tables}"
        print(f"startrack: {done}; {again} goes on", file=sys.stderr)
        return errors.EXIT_STOPPED
    page = f"; page {printable(write_page_of(str(out)))}" if args.report else ""
    if not args.quiet:
        print(f"{shown.summary()}; {tables}{page}", file=sys.stderr if args.json else sys.stdout)
        if not (args.json or args.report) and shown.counts["ok"]:
            print(f"  next: startrack report {shlex.quote(printable(out))}", file=sys.stderr)
    if shown.counts["error"]:
        return errors.EXIT_INTERNAL_ERROR
    return errors.EXIT_OK if shown.counts["ok"] == len(tasks) else errors.EXIT_STOPPED


def _tasks(found: Sequence[Image], out: Path, facts: dict[str, Any], args: argparse.Namespace) -> list[Task]:
    here, settings = Path(os.path.abspath(out)), settings_of(args)
    return [
        Task(
            name=image.name, path=os.path.abspath(image.path), result=str(batch.record_path(here, image)), facts=facts,
            plots=not args.no_plots, overwrite=args.overwrite, settings=settings, bag_image=image.bag_image,
        )
        for image in found
    ]  # fmt: skip


def _prepare(task: Task, args: argparse.Namespace) -> None:
    """Prepare the terrain of an image, as a rule that of all, once instead of in every process."""
    reference = task.facts.get("terrain")
    with suppress(BadInput):  # reported when the image is located
        reference = reference or batch.read_task(task).terrain
    terrain = prepare_reference(reference, args)
    if terrain is not None and args.verbose:
        print_warnings(args, terrain.name, terrain.warnings(), of_all=True)


class _Shown:
    """The images located so far: counted, printed, and halted by the first cause to stop."""

    def __init__(self, args: argparse.Namespace, total: int, stop: Callable[[], None]) -> None:
        self.args, self.total, self._stop = args, total, stop
        self.halted: str | None = None  # the cause
        self.counts: Counts = Counter()
        self.reasons: Counts = Counter()  # of refusals

    def halt(self, why: str) -> None:
        """Stop the batch after the images in progress, and keep the first cause."""
        self.halted = self.halted or why
        self._stop()

    @contextmanager
    def halt_by_signals(self) -> Iterator[None]:
        """In the block the first Ctrl-C or SIGTERM halts after the images in progress, a later one at once."""
        first_s: float | None = None

        def on_signal(number: int, _: object) -> None:
            nonlocal first_s
            now_s = time.monotonic()
            if first_s is None:
                first_s = now_s
                os.write(2, FINISHING)  # not print, which is not reentrant
                self.halt("interrupted" if number == signal.SIGINT else "terminated")
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

    def take(self, runner: Runner[Task, ImageDone], tasks: Sequence[Task]) -> list[dict[str, Any]]:
        """Table values of each image that was done; the others are missing where the batch was halted."""
        records: list[dict[str, Any]] = []
        try:
            bar_shown = progress(
                f"locate {self.total} images",
                self.total,
                shown=not self.args.quiet,
                jobs=self.args.jobs or count_cores(),
            )
            with bar_shown as bar, closing(batch.locate_images(runner, tasks)) as outcomes:
                for record, kept in outcomes:
                    records.append(batch.table_values(record))
                    self.counts["error" if record["reason"] == INTERNAL_ERROR else str(record["status"])] += 1
                    self.reasons.update([record["reason"]] if record["status"] == "refused" else [])
                    self.counts["kept"] += kept
                    self.counts["warned"] += bool(record.get("warnings"))
                    self.counts["beam"] += (record.get("search") or {}).get("outcome") == "beam"
                    self._print(record)
                    bar.advance(text="  ".join(self._numbers()))
        except RunStopped as cause:
            self.halted = str(cause)
        except KeyboardInterrupt:  # the images in progress are dropped; the tables contain the finished ones
            self.halt("interrupted")
        return records

    def _print(self, record: dict[str, Any]) -> None:
        reason, args = record["reason"], self.args
        if reason == INTERNAL_ERROR:
            print(f"{record['image']}: {record['message']}", file=sys.stderr, flush=True)
        if args.verbose:
            print_warnings(args, record["image"], record.get("warnings", ()))
        try:
            if args.json:
                print(json.dumps(record), flush=True)
            elif args.verbose:
                print(f"{record['image']}: {record['status']} {record['message']}".rstrip(), flush=True)
            elif record["status"] == "refused" and reason != INTERNAL_ERROR and not args.quiet:
                line = refusal_line(record["image"], reason, record["message"])
                print_refusal(args, line, reason, record["message"])
        except BrokenPipeError:
            discard_stdout()
            self.halt("the output is no longer read")

    def _numbers(self) -> list[str]:
        return [f"{self.counts[name]} {name}" for name in SHOWN if self.counts[name]]

    def summary(self) -> str:
        """Number of images of each outcome, in words."""
        kept = f" ({self.counts['kept']} were there already)" if self.counts["kept"] else ""
        warned = f"; {self.counts['warned']} with warnings (-v shows them)" if self.counts["warned"] else ""
        beam = f"; {self.counts['beam']} with search: beam, not proven" if self.counts["beam"] else ""
        why = ", ".join(f"{count} {reason}" for reason, count in self.reasons.most_common())
        images = f"{self.total} image{'' if self.total == 1 else 's'}"
        return f"{images}: {', '.join(self._numbers())}{f' ({why})' if why else ''}{kept}{warned}{beam}"


def _write_tables(args: argparse.Namespace, out: Path, tasks: Sequence[Task], records: list[dict[str, Any]]) -> None:
    """Write the tables of the whole folder's `tasks`; print a line on stderr for each kind of result that they lack."""
    of_flags = {  # without paths of this machine
        key: str(value) if key in ("time_utc", "time_sigma_s", "exposure_s") else Path(value).name
        for key, value in tasks[0].facts.items()
    }
    method = {"localizer": args.localizer, "evidence": args.evidence}
    near: dict[str, Any] = {} if args.near is None else {"near": list(args.near)}
    if args.near_attitude is not None:
        near["near_attitude"] = Path(args.near_attitude).name
    if args.near_sky is not None:
        near["near_sky"] = str(args.near_sky)
    rows = batch.table_rows(tasks, {record["image"]: record for record in records}, os.path.abspath(out))
    batch.write_tables(out, rows.rows, {**of_flags, **method, **near, "plots": not args.no_plots})
    lacking = {
        "earlier result{} kept, and left out of the tables: the image, or its sidecar, camera or terrain file, cannot "
        "be used now": rows.superseded,
        "result{} of other settings or contents left out of the tables; startrack batch over the whole folder renews "
        "them": rows.omitted,
    }
    for text, number in lacking.items():
        if number:
            print(f"startrack: {number} {text.format('' if number == 1 else 's')}", file=sys.stderr)
