"""Which results are of this program, and the benchmarks that measure the others.

    python benchmarks/run.py                    the state of each result
    python benchmarks/run.py --render           make RESULTS.md from the stored results, with marks of earlier programs
    python benchmarks/run.py --stale [NAME ...] measure what is of an earlier program, one after the other
    python benchmarks/run.py NAME ...           measure these; NAME is a section, or a part of one
    python benchmarks/run.py --release          exit code 1 where README.md or docs/ cite an earlier program

Each result is stored when its benchmark ends, so that a run that was stopped goes on where it was. A benchmark is
stopped after 45 minutes. Those whose commands name files of one's own are listed, not run.
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
from pathlib import Path

from _results import ROOT, Result, stored_results, write_results

LIMIT_S = 45 * 60.0  # of one benchmark, on two cores
OWN_FILES = ("...", "FOLDER", "PYTHON", "ROWS.jsonl", ".fits")  # in a command: it cannot be repeated as it stands
CITING = ("README.md", "docs/trust.md")  # whose figures must be of the program that is released


def main() -> None:
    """Show, render, run or check."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--stale", action="store_true")
    parser.add_argument("--render", action="store_true")
    parser.add_argument("--release", action="store_true")
    args = parser.parse_args()
    results = stored_results()
    chosen = [one for one in results if not args.names or any(name in one.section for name in args.names)]
    if args.render:
        write_results()
    elif args.release:
        sys.exit(report_release(results))
    elif args.stale or args.names:
        sys.exit(run_all([one for one in chosen if not (args.stale and one.is_fresh)]))
    else:
        for one in results:
            print(f"{'fresh' if one.is_fresh else 'earlier'}  {one.date}  {one.section}: {one.command}")


def run_all(results: list[Result]) -> int:
    """Measure them one after the other; the number of those that could not be."""
    missed = 0
    for one in results:
        if any(word in one.command for word in OWN_FILES):
            print(f"{one.section}: name its files and run it by hand: {one.command}")
            missed += 1
            continue
        print(f"{one.section}: {one.command}", flush=True)
        words = shlex.split(one.command)
        try:
            done = subprocess.run([sys.executable, *words[1:]], cwd=ROOT, timeout=LIMIT_S)
            ended = f"exit code {done.returncode}" if done.returncode else ""
        except subprocess.TimeoutExpired:
            ended = f"stopped after {LIMIT_S / 60:.0f} minutes: give it smaller counts"
        if ended:
            print(f"{one.section}: {ended}", file=sys.stderr)
            missed += 1
    return missed


def cited_by(results: list[Result], page: Path) -> list[Result]:
    """The results of the benchmarks that a page names."""
    text = page.read_text(encoding="utf-8")
    return [one for one in results if f"benchmarks/{one.benchmark.name}" in text]


def report_release(results: list[Result]) -> int:
    """Name the results of earlier programs that pages cite; 1 if there are any."""
    stale = {one.section: page for page in CITING for one in cited_by(results, ROOT / page) if not one.is_fresh}
    for section, page in stale.items():
        print(f"{page} cites {section}, which is of an earlier program")
    return int(bool(stale))


if __name__ == "__main__":
    main()
