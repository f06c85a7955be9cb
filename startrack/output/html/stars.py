"""The star table of one image, cut to what a page can hold: the brightest stars, in columns."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import Any

Columns = dict[str, list[Any]]
# name on the page, column of NAME.stars.ecsv, decimals (None: a text)
COLUMNS: tuple[tuple[str, str, int | None], ...] = (
    ("id", "catalog_id", None), ("name", "name", None), ("mag", "v_mag", 2), ("az", "azimuth_deg", 3),
    ("el", "elevation_deg", 3), ("x", "x_px", 2), ("y", "y_px", 2), ("mx", "x_measured_px", 2),
    ("my", "y_measured_px", 2), ("exp", "expected_e", 0), ("flux", "flux_e", 0), ("sigma", "sigma_e", 0),
    ("ev", "evidence", 2), ("status", "status", None), ("cause", "cause", None),
)  # fmt: skip


def stars_of(path: Path, most: int) -> dict[str, Any] | None:
    """The `most` brightest stars as columns, with how many the table has of each status; None where there is none."""
    if not path.is_file():
        return None
    kept: Columns = {name: [] for name, _, _ in COLUMNS}
    counts: dict[str, int] = {}
    total, unit = 0, "e"
    with path.open(encoding="utf-8", newline="") as file:
        head, rows = _opened(file)
        if any("'expected_e'" in line and "unit: adu" in line for line in head):
            unit = "ADU"
        for row in rows:
            total += 1
            status = row.get("status", "")
            counts[status] = counts.get(status, 0) + 1
            if total <= most:
                for name, column, decimals in COLUMNS:
                    kept[name].append(_value(row.get(column) or "", decimals))
    return {"total": total, "counts": counts, "unit": unit, "columns": _filled(kept)}


def _opened(file: Any) -> tuple[list[str], Iterator[dict[str, str]]]:
    """ECSV's comment lines, and its rows."""
    head: list[str] = []
    for line in file:
        if not line.startswith("#"):
            names = next(csv.reader([line]))
            return head, (dict(zip(names, row, strict=False)) for row in csv.reader(file))
        head.append(line)
    return head, iter(())


def _value(text: str, decimals: int | None) -> Any:
    if decimals is None:
        return text
    try:
        number = round(float(text), decimals)
    except ValueError:  # an empty field: nothing was measured
        return None
    return int(number) if decimals == 0 or number == int(number) else number


def _filled(columns: Columns) -> Columns:
    """Without the columns that hold nothing."""
    return {name: values for name, values in columns.items() if any(value not in (None, "") for value in values)}
