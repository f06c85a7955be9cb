"""Mutated files of every kind through readers and whole commands: `python benchmarks/files.py [FILES] [COMMANDS]`.

Counts internal errors, hangs, and files that take more processor time or memory than the bounds allow.
"""

from __future__ import annotations

import sys
from pathlib import Path

from _results import table, write_section

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]  # of the campaigns and of what they import

from tests.fuzz.campaign import BOUND_BYTES, BOUND_CPU_S, COMMAND, KINDS, Outcome, run_campaign  # noqa: E402

HEAD = ["input", "tried", "answers", "refusals", "internal errors", "hangs", "above the bounds", "slowest s"]


def row(one: Outcome) -> list[str]:
    """The figures of one kind of input."""
    above = len(one.above_cap) + len(one.above_bounds)
    counts = one.tried, one.answers, one.refusals, len(one.crashes), len(one.hangs), above
    return [one.kind, *map(str, counts), f"{one.slowest_s:.1f}"]


def main() -> None:
    """Run the campaigns and store their figures."""
    files, commands = [*map(int, sys.argv[1:3]), *(20_000, 300)[len(sys.argv) - 1 :]]
    readers = [kind for kind in KINDS if kind != COMMAND]
    outcomes = [run_campaign(kind, files // len(readers), 1) for kind in readers]
    outcomes.append(run_campaign(COMMAND, commands, 1))
    for one in outcomes:
        for found in (*one.crashes, *one.above_bounds):
            print(one.kind, found, file=sys.stderr)
    body = (
        f"Bounds of one file: {BOUND_CPU_S:g} s of processor time and {BOUND_BYTES / 1e6:.0f} MB beyond what a sound "
        f"file takes.\n\n{table(HEAD, [row(one) for one in outcomes])}"
    )
    write_section("Mutated files", f"python benchmarks/files.py {files} {commands}", (), body)
    print(body)


if __name__ == "__main__":
    main()
