"""`startrack demo`: makes a picture, locates it and opens the report."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from startrack.cli.common import DEFAULT_OUT

POSITION_M = (-6900.0, 4700.0)  # near the wall of the thesis's crater, where the position is known best
NAME = "demo.png"


def add_parser(subparsers: Any) -> None:
    """Add `demo` to the commands of the `startrack` parser."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "demo",
        help="make a picture, locate it and open the report",
        description="Render a fisheye picture from a crater floor, locate it, and open the report in a browser. Writes "
        "demo.png with the truth beside it, and the results of startrack locate.",
    )
    parser.add_argument("-D", "--dir", metavar="OUT", default=DEFAULT_OUT, help="folder of the results (%(default)s)")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="of attitude, time and noise (%(default)s)")
    parser.add_argument("--no-open", action="store_true", help="do not open the report in a browser")
    parser.add_argument("-v", "--verbose", action="count", default=0, help="more output; tracebacks of internal errors")
    parser.add_argument("-q", "--quiet", action="store_true", help="print errors only")
    parser.set_defaults(run=run, usage_error=parser.error)


def run(args: argparse.Namespace) -> int:
    """Render, locate, report; the exit code of `locate`."""
    from startrack.cli.main import main
    from startrack.cli.report import write_page_of

    image, east_north = Path(args.dir) / NAME, [f"{metres:g}" for metres in POSITION_M]
    common = ["-q"] if args.quiet else []
    made = main([
        "render", "--seed", str(args.seed), "--east", east_north[0], "--north", east_north[1], "-o", str(image), "-O",
        "-q",
    ])  # fmt: skip
    if made:
        return made
    code = main(["locate", str(image), "-D", args.dir, "-O", *common])
    page = write_page_of(str(Path(args.dir) / "demo.fix.json"), truth=args.dir)
    if not args.quiet:
        print(f"the camera stood at E {east_north[0]} m, N {east_north[1]} m; report: {page}")
    if not args.no_open:
        import webbrowser

        webbrowser.open(page.resolve().as_uri())
    return code
