"""The `startrack` command: parses the arguments, runs one command, turns errors into one line and an exit code."""

from __future__ import annotations

import argparse
import atexit
import gc
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
from typing import Any, NoReturn

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # matrices are small: a second thread waits for work, 0.2 s a start

from startrack.cli.console import discard_stdout, open_closed_streams, print_refusal
from startrack.cli.flags import Command
from startrack.core import __version__, errors
from startrack.core.errors import BadInput, BadOutput, NoSolution
from startrack.core.files import FULL_DISK
from startrack.core.limits import COMMAND_BYTES, START_BYTES, check_memory, refusing_shortage
from startrack.kernels import LibraryMissing

COMMANDS = {  # name to the module of startrack.cli that declares it
    "locate": "pictures", "batch": "pictures", "track": "pictures", "identify": "pictures", "detect": "pictures",
    "render": "studies", "calibrate": "inputs", "horizon": "inputs", "predict": "studies", "report": "pictures",
    "reproduce": "studies", "terrain": "inputs", "doctor": "studies", "cache": "studies", "schema": "studies",
    "demo": "pictures",
}  # fmt: skip
USAGE, INTERRUPTED = 2, 130
NEW_OBJECTS = 50_000  # until garbage is collected: Python's 700 cost a tenth of the time of a start
GROUPS = {  # of commands in the help; those of no group follow
    "see what it does": ("demo",),
    "solve pictures": ("locate", "batch", "track", "identify", "detect"),
    "cameras and horizons": ("calibrate", "horizon"),
    "plan and simulate": ("predict", "render", "terrain", "reproduce"),
    "look and check": ("report", "doctor", "cache", "schema"),
}
EXIT_CODES = """\
exit codes: 0 every image solved; 1 internal error; 2 usage; 3 an image ambiguous or refused; 4 bad input;
5 batch: some image not solved; 5 also if the reader of the output has gone before the end (a closed pipe);
130 interrupted (Ctrl-C)"""
DOORS = """\
rover navigation     startrack locate sample_images/near-wall.png    where is the camera, on a map of the ground?
all-sky cameras      startrack calibrate NIGHT.jpg... --fov 180      the lens; then startrack horizon: the skyline
star identification  startrack identify SKY.png --fov 60             which stars are these? no camera file is needed"""
START = f"""usage: startrack COMMAND ... (startrack --help lists the commands; startrack demo shows what they do)

{DOORS}"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit code."""
    gc.set_threshold(NEW_OBJECTS, *gc.get_threshold()[1:])
    atexit.register(gc.freeze)  # no search for garbage among all that lives at the end: 0.15 s
    open_closed_streams()
    try:
        try:
            return _run_words(list(sys.argv[1:] if argv is None else argv))
        finally:
            sys.stdout.flush()  # here, where a closed pipe is distinguished from an error; also after --help
    except BrokenPipeError:
        discard_stdout()
        return errors.EXIT_STOPPED
    except KeyboardInterrupt:
        return _report_failure("interrupted", INTERRUPTED)
    except OSError as cause:
        if cause.errno not in FULL_DISK or cause.filename is not None:
            raise
        discard_stdout()
        return _report_failure(f"the output cannot be written ({cause.strerror})", errors.EXIT_BAD_INPUT)


def _run_words(words: list[str]) -> int:
    """Run the command that `words` name; the exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # LC_ALL=C and a name beyond ASCII: escaped, no failure
            stream.reconfigure(errors="backslashreplace")
    with _end_by_interrupt():
        parser, commands = _parser()
    if "_ARGCOMPLETE" in os.environ and importlib.util.find_spec("argcomplete") is not None:
        import argcomplete  # of the extra `completion`: the shell requests words

        argcomplete.autocomplete(parser)
    if words and not words[0].startswith("-") and words[0] not in COMMANDS:
        parser.error(f"no command is called {words[0]!r}; there are: {', '.join(COMMANDS)}")
    if " ".join(words[:2]) in commands and words[1:]:  # an action with its own parser and help
        words = [" ".join(words[:2]), *words[2:]]
    if len(words) == 1 and words[0] in commands and commands[words[0]].start:
        print(commands[words[0]].start)
        return USAGE
    args = parser.parse_args(words)
    if not args.command:
        print(START)
        return USAGE
    return _run(args)


def _run(args: argparse.Namespace) -> int:
    """Run the command that was parsed; the exit code. Raises OSError where the standard output takes no more."""
    logging.getLogger("startrack").setLevel(logging.ERROR if getattr(args, "quiet", False) else logging.NOTSET)
    try:
        with refusing_shortage():
            check_memory(base_bytes=START_BYTES if args.memory_later else COMMAND_BYTES)
            return int(args.run(args))
    except BadOutput as cause:
        print(f"startrack {args.command}: error: {cause.command_message}", file=sys.stderr)
        return USAGE
    except (BadInput, NoSolution) as cause:
        code = errors.EXIT_BAD_INPUT if isinstance(cause, BadInput) else errors.EXIT_REFUSED
        line = f"startrack {args.command}  refused  {cause.reason}: {errors.one_line(str(cause))}"
        print_refusal(args, line, cause.reason, str(cause))
        return code
    except LibraryMissing as cause:
        return _report_failure(str(cause), errors.EXIT_INTERNAL_ERROR)
    except Exception as cause:
        is_output = isinstance(cause, BrokenPipeError) or getattr(cause, "errno", None) in FULL_DISK
        if getattr(args, "verbose", 0) or (is_output and getattr(cause, "filename", None) is None):
            raise
        message = f"internal error: {type(cause).__name__}: {cause} (-v shows the traceback)"
        return _report_failure(message, errors.EXIT_INTERNAL_ERROR)


class _Parser(argparse.ArgumentParser):
    """A parser, also of each command, that reports wrong usage, unknown arguments too, in a line and names its help.

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

    def error(self, message: str) -> NoReturn:
        """Print the `message` and the command that shows the usage, and exit."""
        self.exit(USAGE, f"{self.prog}: error: {errors.one_line(message)}\ntry '{self.prog} --help'\n")


class _StartParser(_Parser):
    """The parser of all commands, whose help shows the doors and the commands by their groups."""

    summaries: dict[str, str]

    def format_help(self) -> str:
        """Usage, doors, commands with their summaries, and exit codes."""
        named = {name for names in GROUPS.values() for name in names}
        groups = {**GROUPS, "more": tuple(name for name in COMMANDS if name not in named)}
        width = max(map(len, COMMANDS))
        parts = [
            "usage: startrack COMMAND ... (startrack COMMAND --help shows the flags and an example)",
            "Rover position and attitude, or the names of the stars, from one picture of the sky.", DOORS,
            *(
                "\n".join([f"{title}:", *(f"  {name:<{width}}  {self.summaries[name]}" for name in names)])
                for title, names in groups.items() if names
            ),
            "  --version  the version\n  -h, --help  this text", EXIT_CODES,
        ]  # fmt: skip
        return "\n\n".join(parts) + "\n"


@contextmanager
def _end_by_interrupt() -> Iterator[None]:
    """In the block Ctrl-C ends the process: while modules are loaded, Python can lose a KeyboardInterrupt."""
    is_main_thread = threading.current_thread() is threading.main_thread()
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler or not is_main_thread:
        yield
        return
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _parser() -> tuple[argparse.ArgumentParser, dict[str, Command]]:
    """The parser, and the commands and actions by their names."""
    parser = _StartParser(prog="startrack")
    parser.add_argument("--version", action="version", version=f"startrack {__version__}")
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND", parser_class=_Parser)
    commands: dict[str, Command] = {}
    for name, module in COMMANDS.items():
        for command in importlib.import_module(f"startrack.cli.{module}").COMMANDS:
            if command.name.split()[0] == name:
                command.add_to(subparsers)
                commands[command.name] = command
    parser.summaries = {name: commands[name].summary or "" for name in COMMANDS}
    return parser, commands


def _report_failure(message: str, code: int) -> int:
    print(f"startrack: {errors.one_line(message)}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
