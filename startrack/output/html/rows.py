"""Results of a folder and the table of a page: one short list per image, and how large the errors are."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from statistics import fmean, median
from typing import Any

import numpy as np

from startrack.core.files import existing_folder
from startrack.core.stored import finite_json
from startrack.core.types import BadInput
from startrack.output.quantities import QUANTITIES
from startrack.output.record import record_values
from startrack.output.text import rows
from startrack.output.values import At

RECORD_ENDS = (".fix.json", ".identification.json")  # of one image the first that is there counts


@dataclass(frozen=True)
class Found:
    """One image's result."""

    stem: str  # relative to the folder of the results, with / on every system
    path: Path  # of the JSON file
    record: dict[str, Any]

    @property
    def kind(self) -> str:
        """Kind of the record by its file's name: fix or identification."""
        return "identification" if self.path.name.endswith(RECORD_ENDS[1]) else "fix"

    @cached_property
    def at(self) -> At:
        """From the path of a quantity to its value in the record, None where that lacks it or has another type."""
        return record_values(self.record)

    @property
    def folder(self) -> Path:
        """The folder that the stem is relative to."""
        return self.path.parents[self.stem.count("/")]

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
        if not file.name.endswith(RECORD_ENDS):
            raise ValueError("its name has another ending")
        return Found(_stem(file.name), file, _record(file))
    except ValueError as cause:
        raise BadInput("bad_image", f"{path}: is not a NAME.fix.json of startrack: {cause}") from cause


def _files(root: Path) -> list[Path]:
    """One file of each image, in the order of their names; hidden folders left out."""
    chosen: dict[str, Path] = {}
    for parent, folders, files in os.walk(root):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for kind in RECORD_ENDS:
            for name in files:
                if name.endswith(kind) and not name.startswith("."):
                    chosen.setdefault((Path(parent).relative_to(root) / _stem(name)).as_posix(), Path(parent) / name)
    return [chosen[stem] for stem in sorted(chosen)]


def _record(path: Path) -> dict[str, Any]:
    """The record of a file. Raises ValueError with the cause where it holds none."""
    if path.exists() and not path.is_file():  # a pipe would block
        raise ValueError("is no regular file")
    try:
        record = finite_json(path.read_text(encoding="utf-8"))
    except OSError as cause:
        raise ValueError(f"cannot be opened ({cause.strerror})") from cause
    except (ValueError, RecursionError) as cause:
        raise ValueError(f"no JSON, or not all of it ({cause})") from cause
    if not isinstance(record, dict):
        raise ValueError("holds no JSON object")
    invalid = [key for key in ("image", "status") if not isinstance(record.get(key), str)]
    invalid += [] if isinstance(record.get("reason"), str | None) else ["reason"]
    if invalid:
        raise ValueError(f"{', '.join(invalid)}: missing or no text")
    return record


def _stem(name: str) -> str:
    return next((name.removesuffix(kind) for kind in RECORD_ENDS if name.endswith(kind)), name)


Position = tuple[float, float]  # east, north [m]
LISTED = tuple((one, one.listed) for one in QUANTITIES if one.listed is not None)
COLUMNS = (
    "image", "stem", "status", "reason", "message", "time_utc", "terrain", "cov_ee", "cov_en", "cov_nn", "radius999_m",
    "rms_px", "seconds", "real_e", "real_n", "error_m", "nees", *(one.key for one, _ in LISTED), "kind", "detail",
)  # fmt: skip
MESSAGE_LETTERS = 400


def row_of(found: Found, real: Position | None, detailed: bool) -> list[Any]:
    """The values of COLUMNS, None where there is none."""
    record, at = found.record, found.at
    position_m = [at("position.east_m"), at("position.north_m")]
    covariance_m2 = np.array(at("position.covariance_m2") or np.zeros((2, 2)))
    known = covariance_m2[np.triu_indices(2)].tolist() if covariance_m2.any() else [None] * 3
    error_m = nees = None
    if real is not None and None not in position_m:
        apart_m = np.array(position_m) - real  # nees: e^T C^-1 e
        error_m = float(np.hypot(*apart_m))
        regular = np.linalg.det(covariance_m2) > 0
        nees = float(apart_m @ np.linalg.solve(covariance_m2, apart_m)) if regular else None
    times = record.get("timing_ms")
    times = [ms for ms in times.values() if isinstance(ms, int | float)] if isinstance(times, dict) else []
    listed = ((at(one.path), listed.decimals) for one, listed in LISTED)
    return [
        record["image"], found.stem, record["status"], record.get("reason"),
        str(record.get("message") or "")[:MESSAGE_LETTERS], at("provenance.time_utc"), at("provenance.terrain"),
        *(_round_number(value, 4) for value in known), _round_number(at("position.radius999_m"), 2),
        _round_number(at("stars.rms_px"), 3), _round_number(sum(times) / 1e3 if times else None, 3),
        *(_round_number(value, 2) for value in (*(real or (None, None)), error_m)), _round_number(nees, 3),
        *(_round_number(value, decimals + 1 if decimals else None) for value, decimals in listed), found.kind,
        detailed,
    ]  # fmt: skip


def headings() -> list[list[Any]]:
    """The listed quantities as columns of the page's list: key, heading, unit, decimals, shown on narrow screens."""
    return [[one.key, listed.heading, one.unit, listed.decimals, listed.always] for one, listed in LISTED]


def facts_of(at: At) -> list[list[Any]]:
    """The quantities of a record for people: title of each group, and its rows of a name, a text and what it means."""
    groups = (
        ("Position", ("position", "search", "clock")),
        ("Attitude", ("attitude", "middle")),
        ("Stars", ("stars", "evidence", "sky")),
    )
    found = [(title, rows("page", at, sections), _helps(sections)) for title, sections in groups]
    return [
        [title, [[name, text.replace("-", "−"), helps.get(name)] for name, text in facts]]
        for title, facts, helps in found
        if facts
    ]


def _helps(sections: Sequence[str]) -> dict[str, str]:
    """What each row of a page shows, in words, by its name: the description of its first quantity with its unit."""
    helps: dict[str, str] = {}
    for one in (one for one in QUANTITIES if one.section in sections):
        for show in (show for show in one.shown if "page" in show.place.split()):
            unit = f" [{one.unit}]" if one.unit else ""
            helps.setdefault(show.row[0].upper() + show.row[1:], one.description.replace("`", "") + unit)
    return helps


def errors_of(table: Sequence[Sequence[Any]]) -> dict[str, Any] | None:
    """Mean, median and largest error [m], mean NEES, and the parts inside the circles; None where nothing is known."""
    columns: Mapping[str, Sequence[Any]] = dict(zip(COLUMNS, zip(*table, strict=True), strict=True))
    errors = [error for error in columns["error_m"] if error is not None]
    if not errors:
        return None
    nees = [one for one in columns["nees"] if one is not None]
    inside = {
        name: [error <= radius for error, radius in zip(columns["error_m"], columns[name], strict=True)
               if error is not None and radius is not None]
        for name in ("radius95_m", "radius999_m")
    }  # fmt: skip
    return {
        "count": len(errors),
        "mean_m": round(fmean(errors), 3),
        "median_m": round(median(errors), 3),
        "largest_m": max(errors),
        "mean_nees": round(fmean(nees), 3) if nees else None,
        "inside95": round(fmean(inside["radius95_m"]), 4) if inside["radius95_m"] else None,
        "inside999": round(fmean(inside["radius999_m"]), 4) if inside["radius999_m"] else None,
    }


def images_with_details(found: Sequence[Found], most: int) -> set[int]:
    """Which images get their details: those that were not solved first, up to half of `most`, then the others."""
    unsolved = [k for k, one in enumerate(found) if one.record["status"] != "ok"]
    solved = [k for k, one in enumerate(found) if one.record["status"] == "ok"]
    first = unsolved[: max(most // 2, most - len(solved))]
    return set(first + solved[: most - len(first)])


def _round_number(value: float | None, decimals: int | None) -> float | None:
    return None if value is None else round(value, decimals)
