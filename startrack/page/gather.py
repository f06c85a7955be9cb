"""What a folder of results holds: the images' records, with the paths of what lies beside them."""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from startrack.types import BadInput

KINDS = (".fix.json", ".identification.json")  # of one image the first that is there counts


@dataclass(frozen=True)
class Found:
    """One image's result."""

    stem: str  # relative to the folder of the results, with / on every system
    path: Path  # of the JSON file
    record: dict[str, Any]

    def beside(self, suffix: str) -> Path:
        """Path of a companion such as `.stars.ecsv`."""
        return self.path.with_name(_stem(self.path.name) + suffix)


def results_under(folder: str | os.PathLike[str]) -> tuple[list[Found], list[str]]:
    """Every result of the tree in the order of names, and the files that could not be read.

    Raises BadInput (bad_image, for lack of a better code) where there is no folder or no result in it.
    """
    root = Path(folder)
    if not root.is_dir():
        raise BadInput("bad_image", f"{folder}: no such folder of results")
    found, unread = [], []
    for path in _files(root):
        name = path.relative_to(root).as_posix()
        record = _record(path)
        if record is None:
            unread.append(name)
        else:
            found.append(Found(_stem(name), path, record))
    if not found and not unread:
        raise BadInput("bad_image", f"{folder}: no NAME.fix.json there: run startrack locate or batch first")
    return found, unread


def result_at(path: str | os.PathLike[str]) -> Found:
    """The result of one file. Raises BadInput (bad_image) where it is none."""
    file = Path(path)
    if not file.is_file():
        raise BadInput("bad_image", f"{path}: no such result")
    record = _record(file) if file.name.endswith(KINDS) else None
    if record is None:
        raise BadInput("bad_image", f"{path}: is not a NAME.fix.json of startrack")
    return Found(_stem(file.name), file, record)


def _files(root: Path) -> list[Path]:
    """One file of each image, in the order of their names; hidden folders left out."""
    chosen: dict[str, Path] = {}
    for parent, folders, files in os.walk(root):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for kind in KINDS:
            for name in files:
                if name.endswith(kind) and not name.startswith("."):
                    chosen.setdefault((Path(parent).relative_to(root) / _stem(name)).as_posix(), Path(parent) / name)
    return [chosen[stem] for stem in sorted(chosen)]


def _record(path: Path) -> dict[str, Any] | None:
    try:
        # JSON has no NaN and no infinity, but files written or edited elsewhere may: nothing was known there.
        record = json.loads(path.read_text(encoding="utf-8"), parse_constant=lambda _: None, parse_float=_finite)
    except (OSError, ValueError):
        return None
    if not isinstance(record, dict) or not isinstance(record.get("reason"), str | None):
        return None
    return record if isinstance(record.get("image"), str) and isinstance(record.get("status"), str) else None


def _finite(text: str) -> float | None:
    return float(text) if math.isfinite(float(text)) else None


def _stem(name: str) -> str:
    return next((name.removesuffix(kind) for kind in KINDS if name.endswith(kind)), name)
