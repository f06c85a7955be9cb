"""Located frames of which something is wrong that no file states: right, refused, or confident and wrong.

    python benchmarks/hazards.py [--frames 24] [--only dust mast]
    python benchmarks/hazards.py --evidence 300 [--half judge] [--only clock] [--store rows.jsonl]
    python benchmarks/hazards.py --compare old.jsonl new.jsonl

Rendered frames of the thesis's crater (5 sigma at V 6, sky 7 % of the background). Each row: answers within their own
99.9 % circle, refusals by reason, and answers beyond that circle. All classes have the same poses.

With --evidence the stars' photometry is simulated instead of the pixels, and located by the stars alone: many more
frames, of the classes that need no pixels, also on height maps. Slow classes have fewer frames. There are two halves
of disjoint seeds: numbers of the program may be fitted on "choose", and are judged on "judge". --store appends the
rows of the frames to a file, so that a run can be continued; --compare shows two such files side by side, of the
frames that both have.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import _evidence_hazards as by_evidence
from _classes import command_of, jobs_of, measured, parser_of, run_classes, wanted_names
from _results import table, write_section
from _stored_rows import compare, load_rows, store_row


def main() -> None:
    """Run the classes, print the table; write the section if all were run."""
    if any(word.startswith("--compare") for word in sys.argv):
        parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
        parser.add_argument("--compare", nargs=2, type=Path, metavar="ROWS")
        print(compare(*parser.parse_args().compare))
    elif any(word.startswith("--evidence") for word in sys.argv):
        run_by_evidence()
    else:
        import _pixel_hazards as by_pixels

        run_classes(
            __file__, __doc__, "Hazards", list(by_pixels.HAZARDS), 24, by_pixels.HEAD, by_pixels.measure_frame,
            by_pixels.summary,
        )  # fmt: skip


def run_by_evidence() -> None:
    """The same at the level of evidence."""
    parser = parser_of(__doc__, 300, "--evidence")
    parser.add_argument("--half", choices=list(by_evidence.SEEDS), default="judge", help="of the seeds")
    parser.add_argument("--store", type=Path, help="append rows to this file; what it has is not measured again")
    args = parser.parse_args()
    wanted = wanted_names(list(by_evidence.CLASSES), args)
    jobs = [(name, number, args.half) for name, number in jobs_of(wanted, args.frames, by_evidence.every)]
    known = {} if args.store is None or not args.store.exists() else load_rows(args.store)
    rows = {name: [known[job] for job in jobs if job[0] == name and job in known] for name in wanted}
    jobs = [job for job in jobs if job not in known]
    for job, row in measured(jobs, by_evidence.measure_frame, args.jobs, args.minutes):
        rows[job[0]].append(row)
        if args.store is not None:
            store_row(args.store, row)
    lines = [by_evidence.summary(name, rows[name]) for name in wanted if rows[name]]
    body = table(by_evidence.HEAD, lines) + by_evidence.totals(rows)
    print(body)
    if not args.only and not args.but:
        command = f"{command_of(__file__, '--evidence', args)} --half {args.half}"
        write_section("Hazards at the level of evidence", command, ("numpy", "scipy"), body)


if __name__ == "__main__":
    main()
