"""The star table of an image on a page: its brightest stars as columns, and directions and evidence of all."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.catalog import proper_name_designations
from startrack.core.types import Array

Columns = dict[str, list[Any]]
# name on the page, column of NAME.stars.ecsv, decimals (None: a text)
STAR_COLUMNS: tuple[tuple[str, str, int | None], ...] = (
    ("id", "catalog_id", None), ("name", "name", None), ("mag", "v_mag", 2), ("az", "azimuth_deg", 3),
    ("el", "elevation_deg", 3), ("x", "x_px", 2), ("y", "y_px", 2), ("mx", "x_measured_px", 2),
    ("my", "y_measured_px", 2), ("exp", "expected_e", 0), ("flux", "flux_e", 0), ("sigma", "sigma_e", 0),
    ("ev", "evidence", 2), ("status", "status", None), ("cause", "cause", None),
)  # fmt: skip
DIRECTION_COLUMNS = ("azimuth_deg", "elevation_deg", "evidence")


@dataclass(frozen=True)
class MeasuredStars:
    """All stars of a table with evidence."""

    azimuth_rad: Array  # (n,)
    elevation_rad: Array  # (n,)
    llr: Array  # (n,) ln p(light | visible) - ln p(light | hidden)
    status: NDArray[np.str_]  # (n,)


@dataclass(frozen=True)
class StarTable:
    """What a page needs of a star table."""

    shown: dict[str, Any]  # the brightest stars as columns, designations of named ones, how many have each status
    measured: MeasuredStars


def star_table_of(path: Path, most: int) -> StarTable | None:
    """The star table at `path`, its `most` brightest stars to be shown; None where there is none."""
    if not path.is_file():
        return None
    kept: Columns = {name: [] for name, _, _ in STAR_COLUMNS}
    counts: dict[str, int] = {}
    measured: list[tuple[str, str, str, str]] = []
    total, unit = 0, "e"
    with path.open(encoding="utf-8", newline="") as file:
        head, rows = read_ecsv(file)
        if any("'expected_e'" in line and "unit: adu" in line for line in head):
            unit = "ADU"
        for row in rows:
            total += 1
            status = row.get("status", "")
            counts[status] = counts.get(status, 0) + 1
            if row.get("evidence"):
                azimuth, elevation, llr = (row[name] for name in DIRECTION_COLUMNS)
                measured.append((azimuth, elevation, llr, status))
            if total <= most:
                for name, column, decimals in STAR_COLUMNS:
                    kept[name].append(_text_or_number(row.get(column) or "", decimals))
    designations = {name: known for name in kept["name"] if (known := proper_name_designations().get(name))}
    columns = _drop_empty_columns(kept)
    shown = {"total": total, "counts": counts, "unit": unit, "columns": columns, "designations": designations}
    return StarTable(shown, _measured_stars(measured))


def read_ecsv(file: Any) -> tuple[list[str], Iterator[dict[str, str]]]:
    """ECSV's comment lines, and its rows."""
    head: list[str] = []
    for line in file:
        if not line.startswith("#"):
            names = next(csv.reader([line]))
            return head, (dict(zip(names, row, strict=False)) for row in csv.reader(file))
        head.append(line)
    return head, iter(())


def _measured_stars(rows: list[tuple[str, str, str, str]]) -> MeasuredStars:
    numbers = np.array([row[:3] for row in rows], dtype=np.float64).reshape(-1, 3)
    status = np.array([row[3] for row in rows], dtype=np.str_)
    return MeasuredStars(np.radians(numbers[:, 0]), np.radians(numbers[:, 1]), numbers[:, 2], status)


def _text_or_number(text: str, decimals: int | None) -> Any:
    if decimals is None:
        return text
    try:
        number = round(float(text), decimals)
    except ValueError:  # an empty field: nothing was measured
        return None
    return int(number) if decimals == 0 or number == int(number) else number


def _drop_empty_columns(columns: Columns) -> Columns:
    """The columns without the empty ones."""
    return {name: values for name, values in columns.items() if any(value not in (None, "") for value in values)}
