"""Which results are of this program, and the benchmarks that measure the others.

    python benchmarks/run.py                    the state of each result
    python benchmarks/run.py --render           make RESULTS.md from the stored results, with marks of earlier programs
    python benchmarks/run.py --stale [NAME ...] measure what is of an earlier program, one after the other
    python benchmarks/run.py NAME ...           measure these; NAME is a section, or a part of one
    python benchmarks/run.py --release          exit code 1 where README.md, docs/how-good.md or docs/trust.md cite an
                                                earlier program

Each result is stored when its benchmark ends, so that a run that was stopped goes on where it was. A benchmark is
stopped after 45 minutes. Those whose commands name files of one's own are listed, not run.
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys

from _results import ROOT, Result, stored_results, write_results

LIMIT_S = 45 * 60.0  # of one benchmark, on two cores
OWN_FILES = ("...", "FOLDER", "PYTHON", "ROWS.jsonl", ".fits")  # in a command: it cannot be repeated as it stands
CITING = "docs/trust.md"  # names the benchmarks of its figures; those of the other pages are in measured_figures.py


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
        try:
            done = subprocess.run(storing_command(one), cwd=ROOT, timeout=LIMIT_S)
            ended = f"exit code {done.returncode}" if done.returncode else ""
        except subprocess.TimeoutExpired:
            ended = f"stopped after {LIMIT_S / 60:.0f} minutes: give it smaller counts"
        if ended:
            print(f"{one.section}: {ended}", file=sys.stderr)
            missed += 1
    return missed


def storing_command(one: Result) -> list[str]:
    """The words of a result's command, with --write where its benchmark stores nothing without it."""
    has_flag = '"--write"' in one.benchmark.read_text(encoding="utf-8")
    words = [sys.executable, *shlex.split(one.command)[1:]]
    return [*words, "--write"] if has_flag and "--write" not in words else words


def cited_results(results: list[Result]) -> list[Result]:
    """The results whose figures README.md, docs/how-good.md and docs/trust.md state."""
    sys.path.insert(0, str(ROOT / "docs"))
    from measured_figures import cited_sections

    text = (ROOT / CITING).read_text(encoding="utf-8")
    return [
        one for one in results if one.section in cited_sections() or f"benchmarks/{one.benchmark.name}" in text
    ]  # fmt: skip


def report_release(results: list[Result]) -> int:
    """Name the results of earlier programs that are cited; 1 if there are any."""
    stale = [one.section for one in cited_results(results) if not one.is_fresh]
    for section in stale:
        print(f"{section} is cited, and is of an earlier program")
    return int(bool(stale))


if __name__ == "__main__":
    main()
