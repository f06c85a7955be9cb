"""Frames of several classes, measured one by one: a table with a line for each class, as a section of RESULTS.md."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from _results import table, write_section

Row = dict[str, Any]
Job = TypeVar("Job", bound=tuple[Any, ...])

CHUNK = 16  # frames for each process after which the time is looked at
ONE_THREAD = (
    "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM",
)  # fmt: skip


def run_classes(
    file: str, doc: str | None, section: str, names: list[str], frames: int, head: list[str],
    measure_frame: Callable[[tuple[str, int]], Row], summary: Callable[[str, list[Row]], list[str]],
) -> None:  # fmt: skip
    """Measure `frames` of each class and print the table; write the section if all classes were run."""
    args = parser_of(doc, frames).parse_args()
    wanted = wanted_names(names, args)
    rows: dict[str, list[Row]] = {name: [] for name in wanted}
    for job, row in measured(jobs_of(wanted, args.frames), measure_frame, args.jobs, args.minutes):
        rows[job[0]].append(row)
    body = table(head, [summary(name, rows[name]) for name in wanted if rows[name]])
    print(body)
    if not args.only and not args.but:
        write_section(section, command_of(file, "--frames", args), ("numpy", "scipy"), body)


def parser_of(doc: str | None, frames: int, flag: str = "--frames") -> argparse.ArgumentParser:
    """The options that all such benchmarks have; `flag` is that of the number of `frames`."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(flag, dest="frames", type=int, default=frames, help="of each class")
    parser.add_argument("--only", nargs="*", default=[], help="classes whose names hold one of these words")
    parser.add_argument("--but", nargs="*", default=[], help="not those whose names hold one of these words")
    parser.add_argument("--minutes", type=float, default=np.inf, help="after which no further frame is begun")
    parser.add_argument("-j", "--jobs", type=int, default=2, help="processes, of one thread each")
    return parser


def command_of(file: str, flag: str, args: argparse.Namespace) -> str:
    """The command of a section."""
    within = f" --minutes {args.minutes:g}" if np.isfinite(args.minutes) else ""
    return f"python benchmarks/{Path(file).name} {flag} {args.frames}{within}"


def wanted_names(names: list[str], args: argparse.Namespace) -> list[str]:
    """The names that are to be run; all without --only and --but."""
    only = [name for name in names if not args.only or any(word in name for word in args.only)]
    return [name for name in only if not any(word in name for word in args.but)]


def jobs_of(names: list[str], frames: int, every: Callable[[str], int] = lambda name: 1) -> list[tuple[str, int]]:
    """Names and numbers, in rounds: of a class one frame in `every(name)`, and at least one."""
    return [(name, k // every(name)) for k in range(frames) for name in names if k % every(name) == 0]


def measured(
    jobs: list[Job], measure_frame: Callable[[Job], Row], processes: int, minutes: float
) -> Iterator[tuple[Job, Row]]:
    """Each of the `jobs` with its row, in their order, until the time is over."""
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))  # read by the processes when they import their libraries
    end = time.monotonic() + 60 * minutes
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        for start in range(0, len(jobs), CHUNK * processes):
            if time.monotonic() > end:
                return
            chunk = jobs[start : start + CHUNK * processes]
            yield from zip(chunk, pool.map(measure_frame, chunk), strict=True)
