"""Frames of several classes, measured one by one: a table with a line for each class, as a section of RESULTS.md."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from _results import table, write_section

Row = dict[str, Any]


def run_classes(
    file: str, doc: str | None, section: str, names: list[str], frames: int, head: list[str],
    measure_frame: Callable[[tuple[str, int]], Row], summary: Callable[[str, list[Row]], list[str]],
) -> None:  # fmt: skip
    """Measure `frames` of each class and print the table; write the section if all classes were run."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=frames, help="of each class")
    parser.add_argument("--only", nargs="*", default=[], help="classes whose names hold one of these words")
    parser.add_argument("-j", "--jobs", type=int, default=2)
    args = parser.parse_args()
    wanted = [name for name in names if not args.only or any(word in name for word in args.only)]
    jobs = [(name, number) for name in wanted for number in range(args.frames)]
    with ProcessPoolExecutor(args.jobs) as pool:
        rows = list(pool.map(measure_frame, jobs, chunksize=2))
    lines = [summary(name, [row for job, row in zip(jobs, rows, strict=True) if job[0] == name]) for name in wanted]
    body = table(head, lines)
    print(body)
    if not args.only:
        write_section(section, f"python benchmarks/{Path(file).name} --frames {args.frames}", ("numpy", "scipy"), body)
