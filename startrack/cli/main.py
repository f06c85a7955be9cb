"""The `startrack` command: finds the subcommand, runs it, and turns what went wrong into one line and an exit code."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Sequence

from startrack import __version__
from startrack.errors import BadInput, NoSolution

COMMANDS = (
    "locate", "batch", "identify", "detect", "render", "calibrate", "report", "reproduce", "terrain", "doctor",
    "schema",
)  # fmt: skip
OK, INTERNAL_ERROR, USAGE, REFUSED, BAD_INPUT, STOPPED = range(6)
EPILOG = """exit codes: 0 every image solved; 1 internal error; 2 usage; 3 an image ambiguous or refused; 4 bad input;
5 batch: some image not solved; 5 also where the output's reader went before the end (a closed pipe)

startrack locate sample_images/near-centre.png     where is the rover?
startrack identify sky.png -c camera.toml          which stars are these?
startrack render --seed 1                          a synthetic exposure to try it on
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit code."""
    parser = _parser()
    args = parser.parse_args(argv)
    if not args.command:
        parser.print_help()
        return USAGE
    try:
        code = int(importlib.import_module(f"startrack.cli.{args.command}").run(args))
        sys.stdout.flush()  # here, where a closed pipe is told from an error
        return code
    except BadInput as cause:
        return _failed(f"{cause.reason}: {cause}", BAD_INPUT)
    except NoSolution as cause:
        return _failed(f"{cause.reason}: {cause}", REFUSED)
    except KeyboardInterrupt:
        return _failed("interrupted", 130)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # nobody reads what is left in the buffer
        return STOPPED
    except Exception as cause:
        if getattr(args, "verbose", 0):
            raise
        return _failed(f"internal error: {type(cause).__name__}: {cause} (-v shows the traceback)", INTERNAL_ERROR)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="startrack",
        description="Rover position and attitude from one picture of the stars.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"startrack {__version__}")
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND")
    for name in COMMANDS:
        importlib.import_module(f"startrack.cli.{name}").add_parser(subparsers)
    return parser


def _failed(message: str, code: int) -> int:
    print(f"startrack: {message}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
