"""Shared by the benchmarks: one section each of RESULTS.md, with the command, the versions and the date."""

from __future__ import annotations

import datetime
import os
import platform
import re
from importlib import metadata
from pathlib import Path

RESULTS = Path(__file__).with_name("RESULTS.md")
HEAD = "# Results\n\nEach section is written by its own command; machines differ, so compare ratios, not seconds.\n"


def write_section(name: str, command: str, packages: tuple[str, ...], body: str) -> None:
    """Replace or add the section `name` of RESULTS.md."""
    versions = ", ".join(f"{package} {metadata.version(package)}" for package in ("startrack", *packages))
    text = (
        f"## {name}\n\n`{command}`, {datetime.date.today().isoformat()}; {versions}; "
        f"Python {platform.python_version()}, {os.cpu_count()} cores\n\n{body.strip()}\n"
    )
    old = RESULTS.read_text(encoding="utf-8") if RESULTS.exists() else HEAD
    section = re.compile(rf"^## {re.escape(name)}\n.*?(?=^## |\Z)", re.MULTILINE | re.DOTALL)
    new = section.sub(lambda _: text + "\n", old) if section.search(old) else old.rstrip() + "\n\n" + text
    RESULTS.write_text(new.rstrip() + "\n", encoding="utf-8")


def table(head: list[str], rows: list[list[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
