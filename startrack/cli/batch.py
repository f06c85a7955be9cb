"""`startrack batch`: every image of a folder, side by side, taken up again where it was left."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from startrack.cli.common import DEFAULT_OUT, add_fact_flags, cores, flag_facts, made_folder
from startrack.cli.flag_types import at_least_one
from startrack.cli.horizons import ready_for
from startrack.errors import BadInput

if TYPE_CHECKING:
    from startrack.batch import Counts, Image, Task

OK, INTERNAL_ERROR, STOPPED = 0, 1, 5
SHOWN = ("ok", "ambiguous", "refused", "error")


def add_parser(subparsers: Any) -> None:
    """Add `batch` to the commands of the `startrack` parser."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "batch",
        help="every image of a folder",
        description="Locate the camera in every image of a tree, which OUT mirrors. A run that was stopped goes on "
        "from there; images, sidecars, camera or terrain files that have changed are done again. Adds results.ecsv, "
        "results.parquet, trajectory.tum, timings.ecsv and manifest.json.",
    )
    parser.add_argument("folder", metavar="FOLDER", help="folder of the images, with all below it")
    add_fact_flags(parser)
    parser.add_argument("-t", "--terrain", metavar="FILE", help="terrain file, or the name of a shipped one")
    parser.add_argument(
        "-j", "--jobs", type=at_least_one, default=None, metavar="N", help="processes (default: all cores)"
    )
    parser.add_argument("--cluster", metavar="ADDRESS", help="a Dask cluster to use instead (extra: cluster)")
    parser.add_argument("--files-on-stdin", action="store_true", help="only the images listed on stdin, one a line")
    parser.add_argument("-D", "--dir", metavar="OUT", default=DEFAULT_OUT, help="folder of the results (%(default)s)")
    again = parser.add_mutually_exclusive_group()
    again.add_argument("--resume", action="store_true", help="keep the results that are there (default)")
    again.add_argument("-O", "--overwrite", action="store_true", help="do every image again")
    parser.add_argument("--json", action="store_true", help="print one JSON object per image, as they are done")
    parser.add_argument("--no-plots", action="store_true", help="no pictures")
    parser.add_argument("--report", action="store_true", help="add OUT/report.html, a page for a browser")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="accepted everywhere; here nothing is random")
    parser.add_argument("-v", "--verbose", action="count", default=0, help="a line for every image")
    parser.add_argument("-q", "--quiet", action="store_true", help="print nothing but errors")
    parser.set_defaults(usage_error=parser.error)


def run(args: argparse.Namespace) -> int:
    """0 when every image is solved, 5 when some are not or the run was stopped, 1 after an internal error."""
    if args.cluster is not None and find_spec("distributed") is None:
        args.usage_error("a cluster is reached with distributed: pip install 'startrack[cluster]'")
    from startrack.batch import Batch, images_under, named_images, write_tables

    out = made_folder(args.dir)
    found = named_images(args.folder, sys.stdin) if args.files_on_stdin else images_under(args.folder, out)
    if not found:
        raise BadInput("bad_image", f"{args.folder}: no PNG, TIFF, FITS, JPEG or camera raw images there")
    facts = flag_facts(args)
    tasks = _tasks(found, out, facts, args)
    if args.cluster is None and not all(Path(task.result).exists() for task in tasks):
        ready_for(_terrain_of(tasks[0]), args)
    jobs = args.jobs or cores()
    records: list[dict[str, Any]] = []
    counts = _no_counts()
    try:
        with _progress(len(tasks), args) as tell:
            for record, kept in Batch(jobs=jobs, cluster=args.cluster).results(tasks):
                records.append(_gist(record))
                outcome = "error" if record["reason"] == "internal_error" else str(record["status"])
                counts[outcome] += 1
                counts["kept"] += kept
                tell(record, counts)
    except KeyboardInterrupt:
        print(f"startrack: stopped after {len(records)} of {len(tasks)}; the same command goes on", file=sys.stderr)
        return STOPPED
    except (OSError, ImportError) as cause:
        if args.cluster is None:
            raise
        raise BadInput("no_cluster", f"{args.cluster}: no Dask scheduler answers ({cause})") from cause
    if args.files_on_stdin:
        records += _earlier(images_under(args.folder, out), {image.name for image in found}, out)
    write_tables(out, records, _settings(facts, args))
    if args.report:
        from startrack.cli.report import page_of

        page_of(str(out))
    if not args.quiet:
        print(_summary(counts, len(tasks), out))
    if counts["error"]:
        return INTERNAL_ERROR
    return OK if counts["ok"] == len(tasks) else STOPPED


def _tasks(found: Sequence[Image], out: Path, facts: dict[str, Any], args: argparse.Namespace) -> list[Task]:
    from startrack.batch import Task

    compiled = find_spec("numba") is not None
    return [
        Task(
            name=image.name, path=image.path, result=str(out / f"{image.stem}.fix.json"), facts=facts,
            plots=not args.no_plots, renew=args.overwrite, compiled=compiled,
        )
        for image in found
    ]  # fmt: skip


def _terrain_of(task: Task) -> str | None:
    """The terrain of an image: one of the whole folder, as a rule."""
    from startrack.exposure import read_exposure

    if task.facts.get("terrain"):
        return str(task.facts["terrain"])
    with suppress(BadInput):  # said where the image is located
        return read_exposure(task.path, **task.facts).terrain
    return None


def _earlier(whole: Sequence[Image], done: set[str], out: Path) -> list[dict[str, Any]]:
    """What earlier runs found of the folder's other images: the tables are of all."""
    from startrack.batch import stored

    records = (stored(str(out / f"{image.stem}.fix.json")) for image in whole if image.name not in done)
    return [_gist(record) for record in records if record is not None]


def _gist(record: dict[str, Any]) -> dict[str, Any]:
    """What the tables need: the rest of a hundred thousand records need not stay in memory."""
    return {key: value for key, value in record.items() if key not in ("modes", "message", "warnings", "format")}


def _settings(facts: dict[str, Any], args: argparse.Namespace) -> dict[str, Any]:
    """What was asked for, free of this machine's paths."""
    shown = {key: Path(value).name if key in ("camera", "terrain") else str(value) for key, value in facts.items()}
    return {**shown, "plots": not args.no_plots}


def _summary(counts: Counts, total: int, out: Path) -> str:
    parts = [f"{counts[name]} {name}" for name in SHOWN if counts[name]]
    kept = f" ({counts['kept']} were there already)" if counts["kept"] else ""
    return f"{total} images: {', '.join(parts)}{kept}; tables in {out}"


@contextmanager
def _progress(total: int, args: argparse.Namespace) -> Iterator[Any]:
    """A function to call with each record and the counts; a bar on a terminal."""

    def lines(record: dict[str, Any], counts: Counts) -> None:
        if args.json:
            import json

            print(json.dumps(record), flush=True)
        elif args.verbose:
            print(f"{record['image']}: {record['status']} {record['message']}".rstrip(), flush=True)

    if args.quiet or not sys.stderr.isatty():
        yield lines
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), TextColumn("{task.fields[counts]}")
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        row = bar.add_task("batch", total=total, counts="")

        def advance(record: dict[str, Any], counts: Counts) -> None:
            lines(record, counts)
            bar.update(row, advance=1, counts="  ".join(f"{counts[name]} {name}" for name in SHOWN if counts[name]))

        yield advance


def _no_counts() -> Counts:
    from startrack.batch import Counts

    return Counts()
