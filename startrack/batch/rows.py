"""The rows of a batch's tables: the records of this run, and valid records of earlier runs for its other images."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from startrack.batch.store import RESULT, is_solved, stored_record, text_of_name
from startrack.batch.task import Task, valid_stored_record

NOT_IN_TABLES = ("modes", "message", "warnings", "format")


@dataclass
class Rows:
    """Rows of all images of a folder, and the number of results that have none."""

    rows: list[dict[str, Any]] = field(default_factory=list)
    omitted: int = 0  # stored results of other settings or contents, or of an attempt that failed
    superseded: int = 0  # images refused now because of an input, whose earlier solution is kept beside the tables


def table_values(record: dict[str, Any]) -> dict[str, Any]:
    """The part of a record that the tables need: the rest of 100,000 records need not stay in memory."""
    return {key: value for key, value in record.items() if key not in NOT_IN_TABLES}


def table_rows(tasks: Iterable[Task], now: Mapping[str, dict[str, Any]], out: str | os.PathLike[str]) -> Rows:
    """Rows of the whole folder's `tasks`; `now` has the records of this run by the images' names as text."""
    found = Rows()
    for task in tasks:
        name = text_of_name(task.name)
        record = now.get(name) or valid_stored_record(task)
        if record is None:
            found.omitted += os.path.exists(task.result)
            continue
        superseded = name in now and not is_solved(record) and is_solved(stored_record(task.result))
        found.superseded += superseded
        result = text_of_name(Path(os.path.relpath(task.result, out)).as_posix())
        found.rows.append({**table_values(record), "image": name, RESULT: None if superseded else result})
    return found
