"""Frames of several classes, measured one by one: a table with a line for each class, as a section of RESULTS.md."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from _results import table, write_section

Row = dict[str, Any]
Total = Callable[[dict[str, list[Row]]], str]

CHUNK = 64  # frames after which the time is looked at


def run_classes(
    file: str, doc: str | None, section: str, names: list[str], frames: int, head: list[str],
    measure_frame: Callable[[tuple[str, int]], Row], summary: Callable[[str, list[Row]], list[str]],
    every: Callable[[str], int] = lambda name: 1, flag: str = "--frames", total: Total = lambda rows: "",
) -> None:  # fmt: skip
    """Measure `frames` of each class and print the table; write the section if all classes were run.

    Of a class only one frame in `every(name)` is measured. `flag` is the option for the number
    of frames, `total` a text about the rows of all classes.
    """
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(flag, dest="frames", type=int, default=frames, help="of each class")
    parser.add_argument("--only", nargs="*", default=[], help="classes whose names hold one of these words")
    parser.add_argument("--minutes", type=float, default=np.inf, help="after which no further frame is begun")
    parser.add_argument("-j", "--jobs", type=int, default=2)
    args = parser.parse_args()
    wanted = [name for name in names if not args.only or any(word in name for word in args.only)]
    jobs = [(name, k) for k in range(args.frames) for name in wanted if k % every(name) == every(name) - 1]
    rows: dict[str, list[Row]] = {name: [] for name in wanted}
    end = time.monotonic() + 60 * args.minutes
    with ProcessPoolExecutor(args.jobs) as pool:
        for start in range(0, len(jobs), CHUNK):
            if time.monotonic() > end:
                break
            chunk = jobs[start : start + CHUNK]
            for job, row in zip(chunk, pool.map(measure_frame, chunk, chunksize=2), strict=True):
                rows[job[0]].append(row)
    body = table(head, [summary(name, rows[name]) for name in wanted if rows[name]]) + total(rows)
    print(body)
    if not args.only:
        within = f" --minutes {args.minutes:g}" if np.isfinite(args.minutes) else ""
        command = f"python benchmarks/{Path(file).name} {flag} {args.frames}{within}"
        write_section(section, command, ("numpy", "scipy"), body)
