"""Shared by the benchmarks: stored results, one file each in results/, and RESULTS.md, which is made from them."""

from __future__ import annotations

import datetime
import json
import os
import platform
import re
import subprocess
import sys
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, Self

from _sources import ROOT, hash_of

HERE = Path(__file__).parent
RESULTS, STORE = HERE / "RESULTS.md", HERE / "results"
WORSE = HERE / "worse.md"  # what is worse than at the measurement before, with the reason, written by hand
HEAD = """# Results

Each section is written by its own command; machines differ, so compare ratios, not seconds. A section that is marked
was measured with an earlier program: sources that its benchmark depends on have changed since.
"""
MARK = "**Of an earlier program.**"
ROW = re.compile(
    r'\[\s*"(?:[^"\\]|\\.)*"(?:,\s*"(?:[^"\\]|\\.)*")*\s*\]'
)  # a list of texts, on a line of its own in the files


@dataclass(frozen=True)
class Result:
    """One section of RESULTS.md."""

    section: str
    place: int  # among the sections
    command: str
    date: str
    versions: dict[str, str]  # of the packages, by their names
    python: str
    cores: int
    commit: str  # of the program; "+" behind it: with changes that were not committed; empty: not known
    sources: str  # hash of the sources that the benchmark depends on; empty: not known
    blocks: list[dict[str, Any]]  # a "text", or a table: "head" and "rows"

    @property
    def path(self) -> Path:
        """The file that it is stored in."""
        return STORE / f"{re.sub(r'[^a-z0-9]+', '-', self.section.lower()).strip('-')}.json"

    @property
    def benchmark(self) -> Path:
        """The file of its benchmark."""
        return ROOT / next(word for word in self.command.split() if word.endswith(".py"))

    @property
    def is_fresh(self) -> bool:
        """Whether the sources are those that it was measured with."""
        return self.sources == hash_of(self.benchmark)

    def text(self) -> str:
        """The section in Markdown."""
        versions = ", ".join(f"{name} {version}" for name, version in self.versions.items())
        facts = f"`{self.command}`, {self.date}; {versions}; Python {self.python}, {self.cores} cores"
        marks = [] if self.is_fresh else [MARK]
        body = [one["text"] if "text" in one else table(one["head"], one["rows"]) for one in self.blocks]
        return "\n\n".join([f"## {self.section}", facts, *marks, *body])

    def store(self) -> None:
        """Write its file."""
        STORE.mkdir(exist_ok=True)
        text = json.dumps(asdict(self), indent=1, ensure_ascii=False)
        self.path.write_text(ROW.sub(lambda row: " ".join(row[0].split()), text) + "\n", encoding="utf-8")

    @classmethod
    def load(cls, path: Path) -> Self:
        """That of a file."""
        return cls(**json.loads(path.read_text(encoding="utf-8")))


def stored_results() -> list[Result]:
    """All results in the order of their sections."""
    return sorted((Result.load(path) for path in STORE.glob("*.json")), key=lambda one: (one.place, one.section))


def write_section(name: str, command: str, packages: tuple[str, ...], body: str) -> None:
    """Store the result of a benchmark, the section `name`, and make RESULTS.md anew."""
    known = stored_results()
    place = next((one.place for one in known if one.section == name), max((one.place for one in known), default=0) + 1)
    versions = {package: metadata.version(package) for package in ("startrack", *packages)}
    found = Result(
        name, place, command, datetime.date.today().isoformat(), versions, platform.python_version(),
        os.cpu_count() or 1, *STARTED, blocks_of(body),
    )  # fmt: skip
    found.store()
    write_results()


def write_results() -> None:
    """Make RESULTS.md from the stored results."""
    RESULTS.write_text(results_text(), encoding="utf-8")


def results_text() -> str:
    """RESULTS.md of the stored results, those of earlier programs marked."""
    top = HEAD.rstrip(), WORSE.read_text(encoding="utf-8").strip()
    return "\n\n".join([*top, *(one.text() for one in stored_results())]) + "\n"


def commit_name() -> str:
    """The commit of the program, with "+" behind it where the sources have changed since; empty outside of git."""
    try:
        words = ["git", "describe", "--always", "--dirty=+", "--exclude=*"]
        return subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return ""


def program_at_start() -> tuple[str, str]:
    """Commit and hash of the sources of the benchmark that this process runs; sources may change while it does."""
    benchmark = Path(sys.argv[0]).resolve()
    return (commit_name(), hash_of(benchmark)) if benchmark.parent == HERE else ("", "")


STARTED = program_at_start()


def blocks_of(body: str) -> list[dict[str, Any]]:
    """Tables and texts of Markdown."""
    found = list[dict[str, Any]]()
    for part in re.split(r"\n\s*\n", body.strip()):
        lines = part.splitlines()
        if len(lines) > 1 and all(line.startswith("|") for line in lines) and set(lines[1]) <= set("| -"):
            head, _, *rows = [[cell.strip() for cell in line.strip()[1:-1].split("|")] for line in lines]
            found.append({"head": head, "rows": rows})
        else:
            found.append({"text": part})
    return found


def table(head: list[str], rows: list[list[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
