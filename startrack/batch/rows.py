"""The rows of a batch's tables: what this run found, and of its other images what earlier runs left and still holds."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from startrack.batch.store import RESULT, is_solved, printable, stored
from startrack.batch.task import Task, still_stored

NOT_IN_TABLES = ("modes", "message", "warnings", "format")


@dataclass
class Rows:
    """Of all images of a folder, with what had to be left aside."""

    rows: list[dict[str, Any]] = field(default_factory=list)
    left_out: int = 0  # stored results of other settings or contents, or of an attempt that failed
    former: int = 0  # images that were refused for an input's sake, while an earlier solution stays beside the tables


def gist(record: dict[str, Any]) -> dict[str, Any]:
    """What the tables need: the rest of a hundred thousand records need not stay in memory."""
    return {key: value for key, value in record.items() if key not in NOT_IN_TABLES}


def rows_of(tasks: Iterable[Task], now: Mapping[str, dict[str, Any]], out: str | os.PathLike[str]) -> Rows:
    """`tasks` are those of the whole folder, `now` the records of this run by the printable names of their images."""
    found = Rows()
    for task in tasks:
        name = printable(task.name)
        record = now.get(name) or still_stored(task)
        if record is None:
            found.left_out += os.path.exists(task.result)
            continue
        former = name in now and not is_solved(record) and is_solved(stored(task.result))
        found.former += former
        result = printable(Path(os.path.relpath(task.result, out)).as_posix())
        found.rows.append({**gist(record), "image": name, RESULT: None if former else result})
    return found
