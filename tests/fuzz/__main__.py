"""`python -m tests.fuzz`: try mutated files of every kind and print what came out; exit code 1 with any failure."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from .campaign import COMMAND, HANG_S, KINDS, MEMORY_BYTES, Outcome, run_campaign
from .targets import mutated


def main() -> int:
    """Run the campaigns that the arguments name; 0 without a failure."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--runs", type=int, default=10_000, help="mutated files in all (%(default)s)")
    parser.add_argument("--commands", type=int, default=0, help="of these also through a whole command (%(default)s)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kind", choices=KINDS, action="append", help="only this kind of input; may be repeated")
    parser.add_argument("--dir", type=Path, default=Path("fuzz-failures"), help="folder of the files that failed")
    parser.add_argument("--guided", action="store_true", help="let coverage choose the changes; needs atheris")
    args = parser.parse_args()
    if args.guided:
        from .guided import run_guided

        return run_guided(args.kind or list(KINDS[:-1]), args.runs, args.seed, args.dir)
    readers = [kind for kind in args.kind or KINDS if kind != COMMAND]
    plan = {kind: args.runs // len(readers) for kind in readers}
    commands = args.commands or (args.runs if args.kind == [COMMAND] else 0)
    if commands:
        plan[COMMAND] = commands
    outcomes = []
    for kind, runs in plan.items():
        print(f"{kind} ...", file=sys.stderr, end="\r")
        outcomes.append(run_campaign(kind, runs, args.seed))
        keep_failures(outcomes[-1], args.seed, args.dir)
    print(table(outcomes))
    return int(any(outcome.failures for outcome in outcomes))


def table(outcomes: list[Outcome]) -> str:
    """The outcomes as a Markdown table."""
    lines = [f"| input | tried | answers | refusals | crashes | hangs (over {HANG_S:.0f} s) | above "
             f"{MEMORY_BYTES / 2**30:.0f} GiB | above the bounds | slowest s |", "| --- " * 9 + "|"]  # fmt: skip
    for one in outcomes:
        lines.append(
            f"| {one.kind} | {one.tried} | {one.answers} | {one.refusals} | {len(one.crashes)} | {len(one.hangs)} "
            f"| {len(one.above_cap)} | {len(one.above_bounds)} | {one.slowest_s:.1f} |"
        )
    for one in outcomes:
        lines += [f"{one.kind} {crash['index']}: {crash['cause']}" for crash in one.crashes[:20]]
        lines += [f"{one.kind} {index}: no end within the limit" for index in one.hangs]
        lines += [f"{one.kind} {index}: above the cap of memory" for index in one.above_cap]
        lines += [f"{one.kind} {found['index']}: {found['bound']}" for found in one.above_bounds]
    return "\n".join(lines)


def keep_failures(outcome: Outcome, seed: int, folder: Path) -> None:
    """Write the files that failed to `folder`, if there are any."""
    failed = [crash["index"] for crash in outcome.crashes] + outcome.hangs + outcome.above_cap
    for index in failed if outcome.kind != COMMAND else ():
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{outcome.kind}-{seed}-{index}").write_bytes(mutated(outcome.kind, seed, int(index))[0])


if __name__ == "__main__":
    sys.exit(main())
