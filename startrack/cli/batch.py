"""`startrack batch`: every image of a folder, in parallel; a stopped run is resumed."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterable, Sequence
from contextlib import closing, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from startrack.cli.batch_inputs import absolute_facts, check_files_of_flags, find_images, remove_paths
from startrack.cli.batch_show import Counts, Halt, halt_on_signals, omission_lines, show_outcomes, summary
from startrack.cli.common import (
    DEFAULT_OUT,
    add_fact_flags,
    add_localizer_flags,
    add_topic_flag,
    check_localizer,
    cores,
)
from startrack.cli.flag_types import positive_count
from startrack.cli.preparation import compile_kernels, prepare_reference
from startrack.core.compilation import is_compiled
from startrack.core.errors import INTERNAL_ERROR, BadInput
from startrack.core.files import make_folder

if TYPE_CHECKING:
    from startrack.applications.batch import Image, ImageDone, Task
    from startrack.core.runner import Runner

OK, FAULT, STOPPED = 0, 1, 5
SCHEMES = ("", "tcp", "tls", "ucx", "ws", "wss")  # of Dask's addresses


def add_parser(subparsers: Any) -> None:
    """Add `batch` to the commands of the `startrack` parser."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "batch",
        help="every image of a folder",
        description="Locate the camera in every image of a tree, which OUT mirrors. A stopped run is resumed; images "
        "are repeated if they, their sidecar, camera or terrain file have changed. Adds results.ecsv, "
        "trajectory.tum, timings.ecsv, manifest.json and, with the extra parquet, results.parquet.",
        epilog="exit codes: 0 every image solved; 5 some not solved, or stopped early (Ctrl-C, SIGTERM, a full disk, a "
        "closed pipe); 1 an internal error; 2 usage; 4 bad input",
    )
    parser.add_argument("folder", metavar="FOLDER", help="folder of the images, with all below it; or a ROS bag")
    add_topic_flag(parser)
    add_fact_flags(parser)
    parser.add_argument("-t", "--terrain", metavar="FILE", help="terrain file, or the name of a shipped one")
    add_localizer_flags(parser)
    workers = parser.add_mutually_exclusive_group()
    workers.add_argument(
        "-j", "--jobs", type=positive_count, default=None, metavar="N", help="processes (default: all cores)"
    )
    workers.add_argument(
        "--cluster", type=_address, metavar="ADDRESS", help="a Dask cluster to use instead (extra: cluster)"
    )
    parser.add_argument(
        "--files-on-stdin", action="store_true", help="only the images listed on stdin, one a line, or ended by NUL"
    )
    parser.add_argument("-D", "--dir", metavar="OUT", default=DEFAULT_OUT, help="folder of the results (%(default)s)")
    again = parser.add_mutually_exclusive_group()
    again.add_argument("--resume", action="store_true", help="keep existing results (default)")
    again.add_argument("-O", "--overwrite", action="store_true", help="repeat every image")
    parser.add_argument("--json", action="store_true", help="print one JSON object per image, as they are done")
    parser.add_argument("--no-plots", action="store_true", help="no pictures")
    parser.add_argument("--report", action="store_true", help="add OUT/report.html, a page for a browser")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="accepted everywhere; here nothing is random")
    parser.add_argument("-v", "--verbose", action="count", default=0, help="a line for every image and warning")
    parser.add_argument("-q", "--quiet", action="store_true", help="print errors only")
    parser.set_defaults(run=run, usage_error=parser.error)


def run(args: argparse.Namespace) -> int:
    """0 if every image is solved, 5 if some are not or the run was stopped, 1 after an internal error."""
    if args.cluster is not None and find_spec("distributed") is None:
        args.usage_error("--cluster needs distributed: pip install '.[cluster]' in a clone of startrack")
    from startrack.applications.batch import lock_results

    facts = absolute_facts(args)
    check_localizer(args)
    check_files_of_flags(facts)
    found, whole = find_images(args)
    out = make_folder(args.dir)
    with lock_results(out):
        return _run(found, whole, out, facts, args)


def _run(
    found: Sequence[Image], whole: Sequence[Image], out: Path, facts: dict[str, Any], args: argparse.Namespace
) -> int:
    """Locate the images `found` and write the tables of the `whole` folder; the exit code."""
    from startrack.applications.batch import has_parquet, locate_image
    from startrack.core.runner import Runner

    _check_ownership(out, whole, args)
    tasks = _tasks(found, out, facts, args)
    if args.cluster is None and not all(Path(task.result).exists() for task in tasks):
        _prepare(tasks[0], args)
    counts = Counts()
    runner: Runner[Task, ImageDone] = Runner(locate_image, jobs=args.jobs or cores(), cluster=args.cluster)
    halt = Halt(runner.stop)
    with halt_on_signals(halt):
        with runner:
            records, stopped = _locate_all(runner, tasks, counts, halt, args)
        try:
            _write_tables(
                out,
                _tasks(sorted({*whole, *found}), out, facts, args),
                records,
                {
                    **remove_paths(facts),
                    "localizer": args.localizer,
                    "evidence": args.evidence,
                    **({} if args.near is None else {"near": list(args.near)}),
                    "plots": not args.no_plots,
                },
            )
            tables = f"tables in {out}" + (
                "" if has_parquet() else " (no results.parquet: the extra parquet is missing)"
            )
        except BadInput as cause:
            stopped, tables = stopped or "the tables cannot be written", f"no tables: {cause}"
    if stopped:
        again = "the same command without -O" if args.overwrite else "the same command"
        done = f"{stopped}: {len(records)} of {len(tasks)} images done, {tables}"
        print(f"startrack: {done}; {again} goes on", file=sys.stderr)
        return STOPPED
    if args.report:
        from startrack.cli.report import write_page_of

        write_page_of(str(out))
    if not args.quiet:
        print(f"{summary(counts, len(tasks))}; {tables}", file=sys.stderr if args.json else sys.stdout)
    if counts["error"]:
        return FAULT
    return OK if counts["ok"] == len(tasks) else STOPPED


def _locate_all(
    runner: Runner[Task, ImageDone], tasks: Sequence[Task], counts: Counts, halt: Halt, args: argparse.Namespace
) -> tuple[list[dict[str, Any]], str | None]:
    """Table values of each image that was done, and the cause if not all were."""
    from startrack.applications.batch import locate_images, table_values
    from startrack.core.runner import RunStopped

    records: list[dict[str, Any]] = []
    try:
        with show_outcomes(len(tasks), args, halt) as show, closing(locate_images(runner, tasks)) as outcomes:
            for record, kept in outcomes:
                records.append(table_values(record))
                counts["error" if record["reason"] == INTERNAL_ERROR else str(record["status"])] += 1
                counts["kept"] += kept
                counts["warned"] += bool(record.get("warnings"))
                show(record, counts)
    except RunStopped as cause:
        halt.why = str(cause)
    except KeyboardInterrupt:  # the images in progress are dropped; the tables contain the finished ones
        halt("interrupted")
    return records, halt.why if len(records) < len(tasks) else None


def _check_ownership(out: Path, images: Sequence[Image], args: argparse.Namespace) -> None:
    from startrack.applications.batch import belongs_to_other_images

    if not args.overwrite and belongs_to_other_images(out, images):
        args.usage_error(
            f"{out} holds a batch of other images than {args.folder} has now: choose another -D, or replace its "
            "results and tables with -O"
        )


def _tasks(found: Sequence[Image], out: Path, facts: dict[str, Any], args: argparse.Namespace) -> list[Task]:
    from startrack.applications.batch import Task, record_path

    here = Path(os.path.abspath(out))
    return [
        Task(
            name=image.name, path=os.path.abspath(image.path), result=str(record_path(here, image)), facts=facts,
            plots=not args.no_plots, overwrite=args.overwrite, localizer=args.localizer,
            evidence=args.evidence, near=args.near, bag_image=image.bag_image,
        )
        for image in found
    ]  # fmt: skip


def _prepare(task: Task, args: argparse.Namespace) -> None:
    """Prepare the terrain of an image, as a rule that of all, once instead of in every process."""
    terrain = prepare_reference(_terrain_of(task), args)
    if terrain is not None and not is_compiled():
        compile_kernels(terrain)


def _terrain_of(task: Task) -> str | None:
    """Reference of the terrain of an image."""
    from startrack.applications.batch import read_task

    if task.facts.get("terrain"):
        return str(task.facts["terrain"])
    with suppress(BadInput):  # reported when the image is located
        return read_task(task).terrain
    return None


def _write_tables(
    out: Path, tasks: Iterable[Task], records: Sequence[dict[str, Any]], settings: dict[str, Any]
) -> None:
    """Write the tables of the whole folder; print a line on stderr for each kind of result that they lack.

    Raises BadInput if they cannot be written.
    """
    from startrack.applications.batch import table_rows, write_tables

    found = table_rows(tasks, {record["image"]: record for record in records}, os.path.abspath(out))
    write_tables(out, found.rows, settings)
    for line in omission_lines(found):
        print(f"startrack: {line}", file=sys.stderr)


def _address(text: str) -> str:
    """Address of a Dask scheduler, as an argparse type."""
    scheme, _, address = text.rpartition("://")
    host, _, port = address.rpartition(":")
    if scheme not in SCHEMES or not host or not port.isdecimal() or not 0 < int(port) < 2**16:
        raise argparse.ArgumentTypeError(f"{text!r} is not the address of a Dask scheduler such as tcp://host:8786")
    return text
