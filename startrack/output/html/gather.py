"""Content of a folder of results: the images' records, with the paths of their companions."""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from startrack.core.files import existing_folder
from startrack.core.types import BadInput

KINDS = (".fix.json", ".identification.json")  # of one image the first that is there counts


@dataclass(frozen=True)
class Found:
    """One image's result."""

    stem: str  # relative to the folder of the results, with / on every system
    path: Path  # of the JSON file
    record: dict[str, Any]

    @property
    def kind(self) -> str:
        """Kind of the record by its file's name: fix or identification."""
        return "identification" if self.path.name.endswith(KINDS[1]) else "fix"

    def companion(self, suffix: str) -> Path:
        """Path of the companion with a `suffix` such as `.stars.ecsv`."""
        return self.path.with_name(_stem(self.path.name) + suffix)


def results_under(folder: str | os.PathLike[str]) -> tuple[list[Found], list[str]]:
    """Every result of the tree `folder` in the order of names, and a line with the cause for each unreadable file.

    Raises BadInput (bad_image, for lack of a better code) where there is no folder or no result in it.
    """
    root = existing_folder(folder, "results")
    found, unread = [], []
    for path in _files(root):
        name = path.relative_to(root).as_posix()
        try:
            found.append(Found(_stem(name), path, _record(path)))
        except ValueError as cause:
            unread.append(f"{name}: {cause}")
    if unread and not found:
        others = f" (and {len(unread) - 1} others)" if len(unread) > 1 else ""
        raise BadInput("bad_image", f"{folder}: no result there can be read: {unread[0]}{others}")
    if not found:
        raise BadInput("bad_image", f"{folder}: no NAME.fix.json there: run startrack locate or batch first")
    return found, unread


def result_at(path: str | os.PathLike[str]) -> Found:
    """The result in the file at `path`. Raises BadInput (bad_image) where it is none."""
    file = Path(path)
    if not file.is_file():
        raise BadInput("bad_image", f"{path}: no such result")
    try:
        if not file.name.endswith(KINDS):
            raise ValueError("its name has another ending")
        return Found(_stem(file.name), file, _record(file))
    except ValueError as cause:
        raise BadInput("bad_image", f"{path}: is not a NAME.fix.json of startrack: {cause}") from cause


def folder_of(found: Found) -> Path:
    """The folder that the stem of a result is relative to."""
    return found.path.parents[found.stem.count("/")]


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


def _record(path: Path) -> dict[str, Any]:
    """The record of a file. Raises ValueError with the cause where it holds none."""
    try:
        # JSON has no NaN and no infinity, but files written or edited elsewhere may: such values are unknown.
        record = json.loads(path.read_text(encoding="utf-8"), parse_constant=lambda _: None, parse_float=_finite)
    except OSError as cause:
        raise ValueError(f"cannot be opened ({cause.strerror})") from cause
    except ValueError as cause:
        raise ValueError(f"no JSON, or not all of it ({cause})") from cause
    if not isinstance(record, dict):
        raise ValueError("holds no JSON object")
    invalid = [key for key in ("image", "status") if not isinstance(record.get(key), str)]
    invalid += [] if isinstance(record.get("reason"), str | None) else ["reason"]
    if invalid:
        raise ValueError(f"{', '.join(invalid)}: missing or no text")
    return record


def _finite(text: str) -> float | None:
    return float(text) if math.isfinite(float(text)) else None


def _stem(name: str) -> str:
    return next((name.removesuffix(kind) for kind in KINDS if name.endswith(kind)), name)
