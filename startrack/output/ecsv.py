"""ECSV as text: a table that astropy, TOPCAT and spreadsheets read, written in a tenth of the time astropy takes.

Source: Astropy Proposal for Enhancement 6 (ECSV 1.0). Comma-separated; an empty field is a masked value.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Column:
    """One column: its heading and its values, None (or an empty text) where there is none."""

    name: str
    values: Iterable[Any]
    datatype: str = "float64"  # or int64, string, bool
    unit: str | None = None  # as astropy spells it
    form: str = "%s"  # of a value; of one in a sparse column with None in it, use `format_values`
    description: str = ""


def ecsv_text(columns: Sequence[Column]) -> str:
    """The table as ECSV. All columns have the same length; texts must be free of line breaks."""
    head = ["# %ECSV 1.0", "# ---", "# delimiter: ','", "# datatype:"]
    head += [_yaml_line(column) for column in columns]
    head += ["# schema: astropy-2.0", ",".join(column.name for column in columns)]
    row = ",".join(column.form for column in columns)
    values = [_column_values(column) for column in columns]
    return "\n".join([*head, *map(row.__mod__, zip(*values, strict=True))]) + "\n"


def format_values(form: str, values: Iterable[Any]) -> list[str]:
    """Values as texts, an empty one for None."""
    return ["" if value is None else form % value for value in values]


def quote_texts(texts: Iterable[str]) -> list[str]:
    """Texts as CSV fields: quoted where they hold a comma or a quote."""
    return ['"' + text.replace('"', '""') + '"' if "," in text or '"' in text else text for text in texts]


def _column_values(column: Column) -> list[Any]:
    values = column.values.tolist() if isinstance(column.values, np.ndarray) else list(column.values)
    return quote_texts(values) if column.datatype == "string" else values


def _yaml_line(column: Column) -> str:
    unit = f"unit: {column.unit}, " if column.unit else ""
    description = column.description.replace("'", "''")
    return f"# - {{name: '{column.name}', {unit}datatype: {column.datatype}, description: '{description}'}}"
