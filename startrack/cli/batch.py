"""`startrack batch`: every image of a folder, in parallel; a stopped run is resumed."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from startrack.cli import flags
from startrack.cli.batch_show import Counts, Halt, halt_on_signals, omission_lines, show_outcomes, summary
from startrack.cli.flags import Command, Either, check_cluster, check_localizer, cores, flag
from startrack.cli.images import absolute_facts
from startrack.cli.progress import compile_kernels, prepare_reference
from startrack.core.compilation import is_compiled
from startrack.core.errors import EXIT_INTERNAL_ERROR, EXIT_OK, EXIT_STOPPED, INTERNAL_ERROR, BadInput
from startrack.core.files import make_folder

if TYPE_CHECKING:
    from startrack.applications.batch import Image, ImageDone, Task
    from startrack.core.runner import Runner

SCHEMES = ("", "tcp", "tls", "ucx", "ws", "wss")  # of Dask's addresses


def run(args: argparse.Namespace) -> int:
    """Locate all images; 0 if all are solved, 5 if some are not or the run was stopped, 1 after an internal error."""
    check_cluster(args)
    from startrack.applications.batch import lock_results

    check_localizer(args)
    facts = absolute_facts(args)
    found, whole = _find_images(args)
    out = make_folder(args.dir)
    with lock_results(out):
        return _locate_images(found, whole, out, facts, args)


def _find_images(args: argparse.Namespace) -> tuple[Sequence[Image], Sequence[Image]]:
    """The images to locate, and all images of the folder or bag. Raises BadInput (bad_image) where there is none."""
    from startrack.applications.batch import images_of_bag, images_under, listed_images
    from startrack.exposure import is_bag

    of_bag = is_bag(args.folder)
    if of_bag and args.files_on_stdin:
        args.usage_error(f"--files-on-stdin is for a folder of files, and {args.folder} is a ROS bag")
    if of_bag and args.time is not None:
        args.usage_error("--time is of one image: the images of a ROS bag have the times of their messages")
    if not of_bag and args.image_topic is not None:
        args.usage_error(f"--image-topic is for a ROS bag, and {args.folder} is none")
    found = whole = images_of_bag(args.folder, args.image_topic) if of_bag else images_under(args.folder, args.dir)
    if args.files_on_stdin:
        listed = sys.stdin.buffer.read()
        paths = os.fsdecode(listed).split("\0" if b"\0" in listed else "\n")  # ended by NUL, or else one a line
        found = listed_images(args.folder, paths, args.dir)
    if not found:
        raise BadInput("bad_image", f"{args.folder}: no PNG, TIFF, FITS, JPEG or camera raw images there")
    if args.time is not None and len(found) > 1:
        args.usage_error(
            f"--time is of one image, and {args.folder} has {len(found)}: give each its time in a sidecar NAME.json "
            "with time_utc"
        )
    return found, whole


def _locate_images(
    found: Sequence[Image], whole: Sequence[Image], out: Path, facts: dict[str, Any], args: argparse.Namespace
) -> int:
    """Locate the images `found` and write the tables of the `whole` folder; the exit code."""
    from startrack.applications.batch import belongs_to_other_images, has_parquet, locate_image
    from startrack.core.runner import Runner

    if not args.overwrite and belongs_to_other_images(out, whole):
        args.usage_error(
            f"{out} holds a batch of other images than {args.folder} has now: choose another -D, or replace its "
            "results and tables with -O"
        )
    tasks = _tasks(found, out, facts, args)
    if args.cluster is None and not all(Path(task.result).exists() for task in tasks):
        _prepare(tasks[0], args)
    counts = Counts()
    runner: Runner[Task, ImageDone] = Runner(locate_image, jobs=args.jobs or cores(), cluster=args.cluster)
    halt = Halt(runner.stop)
    with halt_on_signals(halt):
        with runner:
            records, stopped = _records(runner, tasks, counts, halt, args)
        try:
            _write_tables(out, _tasks(sorted({*whole, *found}), out, facts, args), records, facts, args)
            lack = "" if has_parquet() else " (no results.parquet: the extra parquet is missing)"
            tables = f"tables in {out}{lack}"
        except BadInput as cause:
            stopped, tables = stopped or "the tables cannot be written", f"no tables: {cause}"
    if stopped:
        again = "the same command without -O" if args.overwrite else "the same command"
        done = f"{stopped}: {len(records)} of {len(tasks)} images done, {tables}"
        print(f"startrack: {done}; {again} goes on", file=sys.stderr)
        return EXIT_STOPPED
    if args.report:
        from startrack.cli.report import write_page_of

        write_page_of(str(out))
    if not args.quiet:
        print(f"{summary(counts, len(tasks))}; {tables}", file=sys.stderr if args.json else sys.stdout)
    if counts["error"]:
        return EXIT_INTERNAL_ERROR
    return EXIT_OK if counts["ok"] == len(tasks) else EXIT_STOPPED


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
    from startrack.applications.batch import read_task

    reference = task.facts.get("terrain")
    with suppress(BadInput):  # reported when the image is located
        reference = reference or read_task(task).terrain
    terrain = prepare_reference(reference, args)
    if terrain is not None and not is_compiled():
        compile_kernels(terrain)


def _records(
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


def _write_tables(
    out: Path,
    tasks: Sequence[Task],
    records: Sequence[dict[str, Any]],
    facts: dict[str, Any],
    args: argparse.Namespace,
) -> None:
    """Write the tables of the whole folder; print a line on stderr for each kind of result that they lack.

    Raises BadInput if they cannot be written.
    """
    from startrack.applications.batch import table_rows, write_tables

    of_flags = {  # without paths of this machine
        key: str(value) if key in ("time_utc", "time_sigma_s", "exposure_s") else Path(value).name
        for key, value in facts.items()
    }
    method = {"localizer": args.localizer, "evidence": args.evidence}
    near = {} if args.near is None else {"near": list(args.near)}
    rows = table_rows(tasks, {record["image"]: record for record in records}, os.path.abspath(out))
    write_tables(out, rows.rows, {**of_flags, **method, **near, "plots": not args.no_plots})
    for line in omission_lines(rows):
        print(f"startrack: {line}", file=sys.stderr)


def _address(text: str) -> str:
    """Address of a Dask scheduler, as an argparse type."""
    scheme, _, address = text.rpartition("://")
    host, _, port = address.rpartition(":")
    if scheme not in SCHEMES or not host or not port.isdecimal() or not 0 < int(port) < 2**16:
        raise argparse.ArgumentTypeError(f"{text!r} is not the address of a Dask scheduler such as tcp://host:8786")
    return text


COMMANDS = (
    Command(
        "batch", run, "every image of a folder",
        "Locate the camera in every image of a tree, which OUT mirrors. A stopped run is resumed; images are repeated "
        "if they, their sidecar, camera or terrain file have changed. Adds results.ecsv, trajectory.tum, timings.ecsv, "
        "manifest.json and, with the extra parquet, results.parquet. Exit codes: 0 every image solved; 5 some not "
        "solved, or stopped early (Ctrl-C, SIGTERM, a full disk, a closed pipe); 1 an internal error; 2 usage; 4 bad "
        "input.",
        {
            "input": (
                flag("folder FOLDER", "folder of the images, with all below it; or a ROS bag"),
                flags.TOPIC, *flags.FACTS, flags.TERRAIN,
                flag("--files-on-stdin", "only the images listed on stdin, one a line, or ended by NUL"),
            ),
            "method": flags.METHOD,
            "output": (
                flags.DIR, flags.AGAIN, flags.JSON, flags.NO_PLOTS,
                flag("--report", "add OUT/report.html, a page for a browser"),
            ),
            "more": (Either((flags.JOBS, flag(*flags.CLUSTER_TEXTS, _address))), flags.NO_SEED, *flags.MORE),
        },
        example="startrack batch NIGHT/ -c camera.toml -t shackleton -D results",
    ),
)  # fmt: skip
