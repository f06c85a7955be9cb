"""Compare two folders made by benchmarks/store_outputs.py and print what differs, as Markdown.

    python benchmarks/compare_outputs.py OLD NEW --tolerance 1e-9

Read are JSON and JSON lines, ECSV, CSV and TUM tables, TOML, and the FITS files .wcs and .corr; hidden files, pictures,
Markdown and Parquet (which repeats results.ecsv) are not. Numbers are equal within the relative tolerance or the
absolute floor. Numbers of text tables are printed with a few digits: those that differ by one unit of the last digit
are counted separately ("last digit") and are no failure. Left out are run times, versions, hashes of jobs and of their
inputs, and the folders of paths. Rows and objects are paired by name (catalog_id, image, hip, ...) where that is
unique, else by number. Keys and rows that are on one side only are listed, and are no failure.

Exit code 0: all equal; 1: a value differs, or a file of OLD is not in NEW; 2: nothing to compare.
"""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections import Counter
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path
from typing import Any

from _output_files import TEXT_TABLES, output_files, read_values
from _results import table

HEAD = ["file", "values", "differ", "last digit", "largest relative difference", "status", "moved, m"]
SHOWN = 15  # kinds of keys listed per file


@dataclass(frozen=True)
class Difference:
    """One value that differs; `relative` is infinite for texts."""

    relative: float
    key: str
    old: Any
    new: Any


@dataclass
class Compared:
    """One file on both sides."""

    values: int = 0
    last_digit: int = 0
    differ: list[Difference] = field(default_factory=list)
    added: list[str] = field(default_factory=list)
    removed: list[str] = field(default_factory=list)
    status: str = ""
    moved_m: float | None = None


def main() -> int:
    """Compare all files, print the tables; 0, 1 or 2."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", type=Path, metavar="OLD")
    parser.add_argument("new", type=Path, metavar="NEW")
    parser.add_argument("--tolerance", type=float, default=1e-9, help="relative (%(default)s)")
    parser.add_argument("--floor", type=float, default=1e-12, help="absolute (%(default)s)")
    args = parser.parse_args()
    old, new = output_files(args.old), output_files(args.new)
    files = {
        name: compare(read_values(old[name]), read_values(new[name]), args.tolerance, args.floor,
                      printed=old[name].suffix in TEXT_TABLES)
        for name in sorted(old.keys() & new.keys())
    }  # fmt: skip
    if not files:
        print("nothing to compare")
        return 2
    print(table(HEAD, [line(name, result) for name, result in files.items()]))
    for name, result in files.items():
        if lines := details(result):
            print(f"\n### {name}\n", *lines, sep="\n")
    missing, extra = sorted(old.keys() - new.keys()), sorted(new.keys() - old.keys())
    for title, names in (("Files removed", missing), ("Files added", extra)):
        if names:
            print(f"\n{title}: {', '.join(names)}")
    changed = [name for name, result in files.items() if result.differ]
    count = sum(result.values for result in files.values())
    print(f"\n{count} values in {len(files)} files; {len(changed)} files differ, {len(missing)} are missing")
    return 1 if changed or missing else 0


def compare(old: dict[str, Any], new: dict[str, Any], tolerance: float, floor: float, *, printed: bool) -> Compared:
    """All values of a file on both sides; `printed`: its numbers are texts."""
    result = Compared(added=[key for key in new if key not in old], removed=[key for key in old if key not in new])
    for key in (key for key in old if key in new):
        result.values += 1
        a, b = old[key], new[key]
        if a == b or (a != a and b != b):  # two NaN are equal
            continue
        x, y = number(a, printed), number(b, printed)
        if not math.isfinite(x) or not math.isfinite(y):
            result.differ.append(Difference(math.inf, key, a, b))
        elif abs(x - y) > floor + tolerance * max(abs(x), abs(y)):
            if printed and abs(x - y) < 1.5 * last_digit(a, b):
                result.last_digit += 1
            else:
                result.differ.append(Difference(abs(x - y) / max(abs(x), abs(y)), key, a, b))
    before, after = status(old), status(new)
    result.status = before if before == after else f"{before} -> {after}"
    places = [[side.get(f"position.{axis}_m") for axis in ("east", "north", "up")] for side in (old, new)]
    if all(isinstance(value, float | int) for place in places for value in place):
        result.moved_m = math.dist(*places)
    return result


def status(values: dict[str, Any]) -> str:
    """Status and reason, such as "ok" or "refused not_identified"; "-" of files without."""
    return f"{values.get('status', '-')} {values.get('reason') or ''}".strip()


def number(value: Any, printed: bool) -> float:
    """As float; NaN where it is not a number (a text of a table may be one)."""
    if isinstance(value, bool) or value is None or (isinstance(value, str) and not printed):
        return math.nan
    try:
        return float(value)
    except ValueError:
        return math.nan


def last_digit(*texts: str) -> float:
    """One unit of the last digit printed; 0 where all are whole numbers."""
    exponent = min(int(Decimal(text).as_tuple().exponent) for text in texts)
    return 0.0 if exponent >= 0 else 10.0**exponent


def line(name: str, result: Compared) -> list[str]:
    """One line of the table."""
    worst = max(result.differ, default=None, key=lambda difference: difference.relative)
    largest = "-" if worst is None else f"{size(worst.relative)} {worst.key}"
    moved = "-" if result.moved_m is None else f"{result.moved_m:.2g}"
    counts = [str(count) for count in (result.values, len(result.differ), result.last_digit)]
    return [name, *counts, largest, result.status, moved]


def size(relative: float) -> str:
    """A relative difference as text."""
    return "text" if math.isinf(relative) else f"{relative:.1e}"


def details(result: Compared) -> list[str]:
    """The differences, one line for each kind of key (such as a column), and the keys on one side only."""
    kinds: dict[str, list[Difference]] = {}
    for difference in result.differ:
        kinds.setdefault(kind(difference.key), []).append(difference)
    lines = []
    for name, found in list(kinds.items())[:SHOWN]:
        worst = max(found, key=lambda difference: difference.relative)
        lines.append(f"- {name}: {len(found)}, largest {size(worst.relative)}: {worst.old!r} -> {worst.new!r}")
    for title, keys in (("added", result.added), ("removed", result.removed)):
        counts = Counter(map(kind, keys)).most_common(SHOWN)
        lines += [f"- {title}: {name} ({count})" for name, count in counts]
    return lines


def kind(key: str) -> str:
    """The key without the names of rows."""
    return re.sub(r"\[[^]]*\]", "[]", key)


if __name__ == "__main__":
    sys.exit(main())
