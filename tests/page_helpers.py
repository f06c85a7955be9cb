"""Commands, code and output of a page of the documentation, and running them as a reader would."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from contextlib import redirect_stdout
from dataclasses import dataclass
from glob import glob
from io import StringIO
from pathlib import Path
from typing import Any

import pytest

from startrack.cli.main import main

ROOT = Path(__file__).parent.parent
SNIPPET = re.compile(
    r"(?:^<!-- (?P<mark>[^\n]*) -->\n)?^```(?P<language>sh|python)\n(?P<code>.*?)^```\n"
    r"(?:\n^```text\n(?P<shown>.*?)^```)?",
    flags=re.MULTILINE | re.DOTALL,
)
EXIT_CODE = re.compile(r"#.*\bexit code (\d)")
TIME_TAKEN = re.compile(r"  \d+\.\d s$|computed in \d+\.\d s")
NUMBER = re.compile(r"-?\d+(?:\.\d+)?")
ERROR = re.compile(r"± ?(\d+(?:\.\d+)?)")
RADII = re.compile(r"\s*(one sigma|[\d.]+ % within|protected) ")
LEAST_TOLERANCE = 0.011
COUNT_TOLERANCE = 0.002
SAMPLED = 0.2  # of its error, by which a sampled value may differ: its points, rounded otherwise, make 3 to 5 %


@dataclass(frozen=True)
class Snippet:
    """A block of commands or code. `mark` is the comment before it, `shown` the output after it."""

    language: str
    code: str
    mark: str
    shown: str

    @property
    def is_run(self) -> bool:
        """False after a comment `not run: REASON`, and for the command that runs the tests; both are parsed."""
        return not self.mark.startswith(("not run: ", "test"))


def snippets(page: Path) -> Iterator[Snippet]:
    """The blocks `sh` and `python` of a page."""
    for found in SNIPPET.finditer(page.read_text(encoding="utf-8")):
        parts = {name: text or "" for name, text in found.groupdict().items()}
        yield Snippet(**parts)


def command_lines(code: str) -> list[str]:
    """Lines of a block `sh`; a line that ends in a backslash goes on in the next."""
    return [line for line in code.replace("\\\n", " ").splitlines() if line.strip()]


def startrack_words(line: str) -> list[str] | None:
    """Arguments of a `startrack` command, also of one installed in .venv; None for another command or a pipe."""
    words = shlex.split(line.split("&&")[-1], comments=True)
    is_startrack = bool(words) and words[0] in ("startrack", ".venv/bin/startrack") and "|" not in words
    return words[1:] if is_startrack else None


@dataclass(frozen=True)
class Ran:
    """What a page printed, by its command lines and blocks of code, and the names that its code defined."""

    printed: dict[str, str]
    names: dict[str, Any]


def run_page(page: Path, flags: dict[str, list[str]] | None = None) -> Ran:
    """Run the snippets of a page in the current folder.

    Each command must end with 0, or with the exit code that a comment in its line names. The output of a block must be
    the text that the page shows after it. `flags` are added to the commands that they are keyed by.
    """
    ran = Ran({}, {})
    for one in snippets(page):
        if not one.is_run:
            parse_snippet(one)
            continue
        steps = [one.code] if one.language == "python" else command_lines(one.code)
        for step in steps:
            out = StringIO()
            with redirect_stdout(out):
                if one.language == "python":
                    exec(compile(step, str(page), "exec"), ran.names)
                else:
                    run_line(step, flags or {})
            ran.printed[step] = out.getvalue()
        if one.shown:
            same_output("".join(ran.printed[step] for step in steps), one.shown)
    return ran


def run_line(line: str, flags: dict[str, list[str]]) -> None:
    """Run one command: of startrack in this process, else in a shell."""
    words, wanted = startrack_words(line), EXIT_CODE.search(line)
    if words is not None:
        expanded = [path for word in words for path in (sorted(glob(word)) if "*" in word else [word])]
        code = main([*expanded, *flags.get(words[0], [])])
    else:
        path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
        code = subprocess.run(["bash", "-c", line], env={**os.environ, "PATH": path}).returncode
    assert code == (int(wanted[1]) if wanted else 0), line


def parse_snippet(one: Snippet) -> None:
    """Check the syntax of code, and the flags of every `startrack` command, without running them."""
    if one.language == "python":
        compile(one.code, "page", "exec")
        return
    for line in command_lines(one.code):
        words = startrack_words(line)
        if words is not None:
            parse_words(words)


def parse_words(words: list[str]) -> None:
    """Fail if the command line has an unknown command, flag or number of arguments."""
    from startrack.cli import main as command

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command, "_run", lambda args: 0)
        assert main(words) == 0


def same_output(printed: str, shown: str) -> None:
    """Fail unless the page shows what was printed, line by line.

    The time taken may differ, and the last digit, which another processor may round otherwise. A line `...` of the page
    stands for lines left out.
    """
    lines = lines_of(printed)
    for part in re.split(r"^\.\.\.\n", shown, flags=re.MULTILINE):
        wanted = lines_of(part)
        starts = range(len(lines) - len(wanted) + 1)
        found = any(all(map(same_line, lines[start : start + len(wanted)], wanted)) for start in starts)
        assert found, f"the page shows\n{part}\nprinted:\n{printed}"


def lines_of(text: str) -> list[str]:
    """The lines without the time taken at their ends."""
    return [TIME_TAKEN.sub("", line.rstrip()) for line in text.strip("\n").splitlines()]


def same_line(now: str, then: str) -> bool:
    """Equal but for the last digits of the numbers, and a part of the error that the line states."""
    if NUMBER.sub("#", now) != NUMBER.sub("#", then):
        return False
    slack = SAMPLED * max(map(float, ERROR.findall(then)), default=0.0)
    part = SAMPLED if RADII.match(then) else 0.0

    def differ_little(one: str, other: re.Match[str]) -> bool:
        by_line = slack if then.startswith(" m", other.end()) else 0.0  # lengths alone are sampled
        return abs(float(one) - float(other[0])) <= max(last_digit(other[0]), by_line, part * abs(float(other[0])))

    return all(map(differ_little, NUMBER.findall(now), NUMBER.finditer(then)))


def last_digit(number: str) -> float:
    """The tolerance of a number as a page shows it; of counts a part, because of objects at the edge of a threshold."""
    decimals = number.partition(".")[2]
    return max(1.1 * 10.0 ** -len(decimals), LEAST_TOLERANCE, 0.0 if decimals else COUNT_TOLERANCE * abs(float(number)))
