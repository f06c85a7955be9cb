"""The `startrack` command: parses the arguments, runs one command, turns errors into one line and an exit code."""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import io
import logging
import os
import re
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from startrack import __version__
from startrack.cli.common import print_advice
from startrack.core.errors import BadInput, BadOutput, NoSolution
from startrack.core.files import FULL_DISK

COMMANDS = (
    "locate", "batch", "track", "identify", "detect", "render", "calibrate", "horizon", "predict", "report",
    "reproduce", "terrain", "doctor", "schema", "demo",
)  # fmt: skip
ACTIONS = {"calibrate": ("verify", "show", "convert", "board")}  # with a parser each, beside the command's own
OK, INTERNAL_ERROR, USAGE, REFUSED, BAD_INPUT, STOPPED = range(6)
INTERRUPTED = 130
EPILOG = """exit codes: 0 every image solved; 1 internal error; 2 usage; 3 an image ambiguous or refused; 4 bad input;
5 batch: some image not solved; 5 also if the reader of the output has gone before the end (a closed pipe)

startrack locate sample_images/near-centre.png     where is the rover?
startrack identify sky.png -c camera.toml          which stars are these?
startrack render --seed 1                          a synthetic exposure to try it on
"""
START = """usage: startrack COMMAND ... (startrack --help lists the commands; startrack demo shows what they do)

rover navigation     startrack locate sample_images/near-wall.png    where is the camera, on a map of the ground?
all-sky cameras      startrack calibrate NIGHT.jpg... --fov 180      the lens; then startrack horizon: the skyline
star identification  startrack identify SKY.png --fov 60             which stars are these? no camera file is needed"""

START_OF = {  # of the commands with actions
    "calibrate": """usage: startrack calibrate [ACTION] ... (startrack calibrate --help lists the flags of each action)

from stars       startrack calibrate NIGHT.jpg... --fov 180 -o CAMERA.toml   the lens, from pictures of the night sky
from a board     startrack calibrate board BOARD.png... --pattern 9x6        the lens, from pictures of a chessboard
check            startrack calibrate verify LATER.jpg -c CAMERA.toml         does the camera file still fit?
look             startrack calibrate show CAMERA.toml                        the content of a camera file
other programs   startrack calibrate convert CAMERA.toml --to ros            ros, kalibr, colmap, opencv; --from too""",
    "terrain": """usage: startrack terrain ACTION ... (startrack terrain ACTION --help)

look             startrack terrain show shackleton --at 0 0                  properties, relief, a horizon
your own map     startrack terrain import MAP.tif -o NAME.toml --latitude DEG --longitude DEG
state errors     startrack terrain state NAME.toml                           what its file leaves out widens circles
prepare          startrack terrain build NAME.toml                           its horizons, before the first fix""",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit code."""
    try:
        _write_any_text()
        with _ended_by_interrupt():
            parser = _parser()
        _offer_completion(parser)
        words = _joined_action(sys.argv[1:] if argv is None else argv)
        if words and not words[0].startswith("-") and words[0].split()[0] not in COMMANDS:
            parser.error(f"no command is called {words[0]!r}; there are: {', '.join(COMMANDS)}")
        if len(words) == 1 and words[0] in START_OF:
            print(START_OF[words[0]])
            return USAGE
        args = parser.parse_args(words)
        if not args.command:
            print(START)
            return USAGE
        return _run(args)
    except KeyboardInterrupt:
        return _report_failure("interrupted", INTERRUPTED)


def _run(args: argparse.Namespace) -> int:
    """Run the command that was parsed; the exit code."""
    logging.getLogger("startrack").setLevel(logging.ERROR if getattr(args, "quiet", False) else logging.NOTSET)
    try:
        code = int(args.run(args))
        sys.stdout.flush()  # here, where a closed pipe is distinguished from an error
        return code
    except BadOutput as cause:
        print(f"startrack {args.command}: error: {cause.command_message}", file=sys.stderr)
        return USAGE
    except BadInput as cause:
        return _report_refusal(cause, BAD_INPUT, args)
    except NoSolution as cause:
        return _report_refusal(cause, REFUSED, args)
    except BrokenPipeError:
        _discard_stdout()
        return STOPPED
    except Exception as cause:
        if isinstance(cause, OSError) and cause.errno in FULL_DISK and cause.filename is None:
            _discard_stdout()
            return _report_failure(f"the output cannot be written ({cause.strerror})", BAD_INPUT)
        if getattr(args, "verbose", 0):
            raise
        return _report_failure(
            f"internal error: {type(cause).__name__}: {cause} (-v shows the traceback)", INTERNAL_ERROR
        )


class _Parser(argparse.ArgumentParser):
    """A parser, also of each command, that reports unknown arguments with its own usage.

    A list of numbers that begins with a minus sign is a value, not a flag: --near -3000,1500,200.
    """

    def __init__(self, *given: Any, **more: Any) -> None:
        super().__init__(*given, **more)
        self._negative_number_matcher = re.compile(r"-\.?\d[\d.,e+-]*$")

    def parse_known_args(self, *given: Any, **more: Any) -> Any:
        """As `argparse`, but an argument that is not known is an error: the parser of all commands does not get it."""
        found, unknown = super().parse_known_args(*given, **more)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return found, unknown


@contextmanager
def _ended_by_interrupt() -> Iterator[None]:
    """In the block Ctrl-C ends the process: while modules are loaded, Python can lose a KeyboardInterrupt."""
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler or not _in_main_thread():
        yield
        return
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="startrack",
        description="Rover position and attitude from one star exposure.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"startrack {__version__}")
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND")
    for name in COMMANDS:
        importlib.import_module(f"startrack.cli.{name}").add_parser(subparsers)
    return parser


def _joined_action(argv: Sequence[str]) -> list[str]:
    """["calibrate", "show", ...] as ["calibrate show", ...], so that the action has its own parser and help."""
    words = list(argv)
    return [" ".join(words[:2]), *words[2:]] if words[1:] and words[1] in ACTIONS.get(words[0], ()) else words


def _offer_completion(parser: argparse.ArgumentParser) -> None:
    """Complete words in the shell, if it requests that and the extra `completion` is installed."""
    if "_ARGCOMPLETE" in os.environ and importlib.util.find_spec("argcomplete") is not None:
        import argcomplete

        argcomplete.autocomplete(parser)


def _write_any_text() -> None:
    """Escape characters that the terminal's encoding lacks (LC_ALL=C and a name beyond ASCII) instead of failing."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _discard_stdout() -> None:
    """Discard the rest of the buffer: its reader has ended, or its disk is full."""
    try:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (OSError, ValueError):  # not a file, as under a test
        return


def _report_refusal(cause: BadInput | NoSolution, code: int, args: argparse.Namespace) -> int:
    """The refusal of a whole command, and what to do."""
    _report_failure(f"{cause.reason}: {cause}", code)
    print_advice(cause.reason, str(cause), args)
    return code


def _report_failure(message: str, code: int) -> int:
    print(f"startrack: {message}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
