"""Files that the commands write, as flat dictionaries from key to value, for compare_outputs.py."""

from __future__ import annotations

import csv
import json
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

IGNORED_KEYS = {"timing_ms", "version", "seconds", "words", "files", "job_sha256", "inputs", "CREATOR", "COMMENT"}
IGNORED_FILES = {"timings.ecsv"}
TEXT_TABLES = {".ecsv", ".csv", ".tum"}
SUFFIXES = TEXT_TABLES | {".json", ".jsonl", ".toml", ".wcs", ".corr"}
LABELS = ("catalog_id", "index_id", "image", "name", "hip")


def output_files(folder: Path) -> dict[str, Path]:
    """The files that can be compared, by their path from the folder; none in hidden folders."""
    paths = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*") if path.suffix in SUFFIXES}
    return {
        name: path for name, path in paths.items() if path.name not in IGNORED_FILES and not re.search(r"(^|/)\.", name)
    }


def read_values(path: Path) -> dict[str, Any]:
    """All values of a file except ignored ones; those of text tables are texts as printed."""
    if path.suffix in TEXT_TABLES:
        return dict(_flatten(_read_text_table(path)))
    if path.suffix in (".wcs", ".corr"):
        return dict(_flatten(_read_fits(path)))
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".toml":
        return dict(_flatten(tomllib.loads(text)))
    if path.suffix == ".jsonl":
        return dict(_flatten([json.loads(line) for line in text.splitlines()]))
    return dict(_flatten(json.loads(text)))


def _flatten(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        for name, inner in value.items():
            if name not in IGNORED_KEYS:
                yield from _flatten(inner, f"{key}.{name}" if key else str(name))
    elif isinstance(value, list):
        for label, inner in zip(_labels(value), value, strict=True):
            yield from _flatten(inner, f"{key}[{label}]")
    elif isinstance(value, str):
        yield key, re.sub(r"(?<![\w.])/(?:[^\s/'\"]+/)+", "", value)  # without the folders of absolute paths
    else:
        yield key, value


def _labels(rows: list[Any]) -> list[Any]:
    """Labels of the elements of a list: values of the first key that are present and unique, else numbers."""
    if rows and all(isinstance(row, dict) for row in rows):
        for name in LABELS:
            values = [row.get(name) for row in rows]
            if None not in values and len(set(values)) == len(rows):
                return values
    return list(range(len(rows)))


def _read_text_table(path: Path) -> list[dict[str, str]]:
    """The rows of an ECSV, CSV or TUM file; lines that start with # are comments."""
    lines = path.read_text(encoding="utf-8").splitlines()
    comma = path.suffix == ".csv" or any(line.startswith("# delimiter: ','") for line in lines[:20])
    rows = list(csv.reader((line for line in lines if not line.startswith("#")), delimiter="," if comma else " "))
    head = [str(column) for column in range(8)] if path.suffix == ".tum" else rows.pop(0)
    return [dict(zip(head, row, strict=True)) for row in rows]


def _read_fits(path: Path) -> dict[str, Any]:
    """Primary header and, if there is one, the table of the first extension."""
    from astropy.io import fits  # here, since it takes most of a second

    with fits.open(path) as units:
        rows = []
        if len(units) > 1:
            rows = [dict(zip(units[1].columns.names, row, strict=True)) for row in units[1].data.tolist()]
        return {**units[0].header, "rows": rows}
