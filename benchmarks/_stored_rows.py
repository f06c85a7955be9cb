"""Rows of measured frames as JSON lines, and two versions of the program side by side on the same draws."""

from __future__ import annotations

import json
from pathlib import Path

from _evidence_hazards import KINDS, Row, answered, beyond, median
from _hazard_classes import CLASSES
from _results import table

Key = tuple[str, int, str]  # class, number and half of a frame
HEAD = [
    "errors", "class", "frames", "answered", "median error, m", "median 99.9 % circle, m", "beyond it",
    "beyond twice it", "beyond the protection level",
]  # fmt: skip


def store_row(path: Path, row: Row) -> None:
    """Append one row."""
    with path.open("a", encoding="utf-8") as out:
        out.write(json.dumps(row) + "\n")


def load_rows(path: Path) -> dict[Key, Row]:
    """The rows of a file by their frames; the last one of each counts."""
    rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines() if line]
    return {(row["class"], row["number"], row["half"]): row for row in rows}


def compare(first: Path, second: Path) -> str:
    """A table of the frames that both files have: each cell with the figures of the first and the second."""
    one, two = load_rows(first), load_rows(second)
    common = sorted(one.keys() & two.keys())
    lines = []
    for name in [name for name in CLASSES if any(key[0] == name for key in common)]:
        keys = [key for key in common if key[0] == name]
        lines.append(_line(CLASSES[name].kind, name, [[rows[key] for key in keys] for rows in (one, two)]))
    for kind, words in KINDS.items():
        keys = [key for key in common if key[0] in CLASSES and CLASSES[key[0]].kind == kind]
        if keys:
            lines.append(_line(kind, f"**all: {words}**", [[rows[key] for key in keys] for rows in (one, two)]))
    left = len(one) + len(two) - 2 * len(common)
    return table(HEAD, lines) + f"\n\n{first.name} | {second.name}; {left} frames that one of them lacks are left out"


def _line(kind: str, name: str, both: list[list[Row]]) -> list[str]:
    cells = [
        [
            str(len(answered(rows))), median(rows, "error_m"), median(rows, "radius999_m"), str(len(beyond(rows))),
            str(len(beyond(rows, times=2.0))), str(len(beyond(rows, "level_m"))),
        ]
        for rows in both
    ]  # fmt: skip
    return [kind, name, str(len(both[0])), *(f"{old}, {new}" for old, new in zip(*cells, strict=True))]
