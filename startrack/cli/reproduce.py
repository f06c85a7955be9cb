"""`startrack reproduce`: the thesis's tables and figures, with our method beside them."""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import TYPE_CHECKING

from startrack.cli import flags
from startrack.cli.flag_types import count, positive_count
from startrack.cli.flags import Command, Either, check_cluster, check_extra, cores, flag
from startrack.cli.progress import progress
from startrack.core.compilation import announce_compilation
from startrack.core.files import make_folder

if TYPE_CHECKING:
    from startrack.applications.reproduction import Artefact

# The keys of startrack.applications.reproduction.ARTEFACTS, whose import would load numpy.
NAMES = (
    "table3.1", "fig3.3", "fig3.4", "fig3.5", "fig3.6", "fig3.7", "fig3.8", "fig3.9", "fig3.10", "figA.1", "figA.2",
    "figB", "magnitude", "aspect",
)  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Make the named artefacts, in the order of the thesis; 0."""
    unknown = [name for name in args.what if name not in (*NAMES, "all")]
    if unknown:
        args.usage_error(
            f"{', '.join(unknown)}: not a table or figure of the thesis; known are {', '.join(NAMES)}, all"
        )
    chosen = NAMES if "all" in args.what else [name for name in NAMES if name in args.what]
    if not args.no_plots:
        check_extra(args, "matplotlib", "plots", "figures need", ", or omit them with --no-plots")
    check_cluster(args)

    from startrack.applications.reproduction import ARTEFACTS, FULL, QUICK, Context, fix_store, write_artefact

    out, size = make_folder(args.dir), FULL if args.full else QUICK
    announce_compilation()
    if args.ours is not None:
        size = size.limit_ours(args.ours)
    with fix_store(out, jobs=args.jobs or cores(), progress=progress, cluster=args.cluster) as store:
        if args.cluster is not None:
            store.connect()
        for name in chosen:
            start = time.perf_counter()
            artefact = ARTEFACTS[name](Context(size, args.seed, store))
            files = write_artefact(artefact, out, plots=not args.no_plots)
            _print_artefact(args, artefact, size.name, files, time.perf_counter() - start)
    return 0


def _print_artefact(args: argparse.Namespace, artefact: Artefact, size: str, files: list[Path], seconds: float) -> None:
    if args.json:
        record = {
            "format": "startrack.reproduction/1",
            "name": artefact.name,
            "title": artefact.title,
            "size": size,
            "seed": args.seed,
            **artefact.values,
            "files": [str(path) for path in files],
            "timing_ms": {**artefact.timing_ms, "all": 1e3 * seconds},
        }
        print(json.dumps(record), flush=True)
    elif not args.quiet:
        per_fix = ", ".join(f"{key} {value:.1f}" for key, value in artefact.timing_ms.items())
        print(f"{artefact.name}: {artefact.line}{f' [ms per fix: {per_fix}]' if per_fix else ''}", flush=True)


COMMANDS = (
    Command(
        "reproduce", run, "the thesis's tables and figures, ours beside them",
        "Reproduce the tables and figures of Kua 2008 in its crater simulator, with its method and ours on the same "
        "draws. Each NAME gives NAME.md, NAME.png and, with numbers, NAME.ecsv. Computed chunks are kept in "
        "OUT/.chunks: a stopped run is resumed.",
        {
            "input": (
                flag("what NAME", f"all (default), or any of: {', '.join(NAMES)}", nargs="*", default=["all"]),
            ),
            "method": (
                Either((
                    flag("--quick", "fewer positions than the thesis, in about a minute (default)"),
                    flag("--full", "as in the thesis: 10 x 10,000, and 100,000 positions"),
                )),
                flag("--ours N", "our method on at most N positions per starfield, 10 N in figure 3.10",
                     positive_count),
                flag("--seed N", "same seed, same files", count, default=0),
            ),
            "output": (flags.DIR, flags.JSON, flags.NO_PLOTS),
            "more": (flags.JOBS, flags.CLUSTER, *flags.MORE),
        },
        "startrack reproduce table3.1 --quick",
    ),
)  # fmt: skip
