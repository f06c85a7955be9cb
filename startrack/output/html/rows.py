"""Results of a folder and the table of a page: one short list per image, and how large the errors are."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from startrack.core.files import existing_folder
from startrack.core.types import BadInput
from startrack.output.quantities import QUANTITIES
from startrack.output.quantity import Quantity
from startrack.output.record import at_record
from startrack.output.text import rows

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


def folder_of(found: Found) -> Path:
    """The folder that the stem of a result is relative to."""
    return found.path.parents[found.stem.count("/")]


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
    return next((name.removesuffix(kind) for kind in RECORD_ENDS if name.endswith(kind)), name)


Position = tuple[float, float]  # east, north [m]
LISTED = tuple(one for one in QUANTITIES if one.listed is not None)
COLUMNS = (
    "image", "stem", "status", "reason", "message", "time_utc", "terrain", "cov_ee", "cov_en", "cov_nn", "radius999_m",
    "rms_px", "seconds", "real_e", "real_n", "error_m", "nees", *(one.key for one in LISTED), "kind", "detail",
)  # fmt: skip
MESSAGE_LETTERS = 400


def row_of(found: Found, real: Position | None, detailed: bool) -> list[Any]:
    """The values of COLUMNS, None where there is none."""
    record = found.record
    position, stars, provenance = (section_of(record, key) for key in ("position", "stars", "provenance"))
    position_m = number_of(position, "east_m"), number_of(position, "north_m")
    covariance = _covariance(position)
    error_m, nees = _error_and_nees(position_m, covariance, real)
    east_m, north_m = real or (None, None)
    return [
        record["image"], found.stem, record["status"], record.get("reason"),
        str(record.get("message") or "")[:MESSAGE_LETTERS], provenance.get("time_utc"), provenance.get("terrain"),
        *(round_or_none(value, 4) for value in covariance or (None,) * 3),
        round_or_none(number_of(position, "radius999_m"), 2), round_or_none(number_of(stars, "rms_px"), 3),
        round_or_none(_seconds(record), 3), round_or_none(east_m, 2), round_or_none(north_m, 2),
        round_or_none(error_m, 2), round_or_none(nees, 3), *(_listed_value(record, one) for one in LISTED),
        found.kind, detailed,
    ]  # fmt: skip


def headings() -> list[list[Any]]:
    """The listed quantities as columns of the page's list: key, heading, unit, decimals, shown on narrow screens."""
    return [
        [one.key, one.listed.heading, one.unit, one.listed.decimals, one.listed.always]
        for one in LISTED
        if one.listed is not None
    ]


def facts_of(record: Mapping[str, Any]) -> list[list[Any]]:
    """The quantities of a record for people: title of each group, and its rows of a name and a text."""
    groups = (
        ("Position", ("position", "search", "clock")),
        ("Attitude", ("attitude",)),
        ("Stars", ("stars", "evidence", "sky")),
    )
    at = at_record(record)
    found = [(title, rows("page", at, sections)) for title, sections in groups]
    return [[title, [[name, text.replace("-", "−")] for name, text in facts]] for title, facts in found if facts]


def errors_of(table: Sequence[Sequence[Any]]) -> dict[str, Any] | None:
    """Mean, median and largest error [m], mean NEES, and the parts inside the circles; None where nothing is known."""
    at = {name: k for k, name in enumerate(COLUMNS)}
    known = [row for row in table if row[at["error_m"]] is not None]
    if not known:
        return None
    errors = sorted(row[at["error_m"]] for row in known)
    nees = [row[at["nees"]] for row in known if row[at["nees"]] is not None]
    middle = len(errors) // 2
    return {
        "count": len(known),
        "mean_m": round_or_none(sum(errors) / len(errors), 3),
        "median_m": round_or_none(errors[middle] if len(errors) % 2 else (errors[middle - 1] + errors[middle]) / 2, 3),
        "largest_m": errors[-1],
        "mean_nees": round_or_none(sum(nees) / len(nees), 3) if nees else None,
        "inside95": _fraction_inside(known, at["error_m"], at["radius95_m"]),
        "inside999": _fraction_inside(known, at["error_m"], at["radius999_m"]),
    }


def images_with_details(found: Sequence[Found], most: int) -> set[int]:
    """Which images get their details: those that were not solved first, up to half of `most`, then the others."""
    unsolved = [k for k, one in enumerate(found) if one.record["status"] != "ok"]
    solved = [k for k, one in enumerate(found) if one.record["status"] == "ok"]
    first = unsolved[: max(most // 2, most - len(solved))]
    return set(first + solved[: most - len(first)])


def section_of(record: Mapping[str, Any], key: str) -> dict[str, Any]:
    """A dictionary within a record, empty where there is none."""
    value = record.get(key)
    return value if isinstance(value, dict) else {}


def number_of(d: Mapping[str, Any], key: str) -> float | None:
    """A finite number of a record, or None."""
    value = d.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if math.isfinite(value) else None


def round_or_none(value: float | None, decimals: int) -> float | None:
    """Rounded, None staying None."""
    return None if value is None else round(value, decimals)


def _listed_value(record: Mapping[str, Any], one: Quantity) -> float | int | None:
    value = number_of(section_of(record, one.section), one.key)
    if value is None or one.listed is None or one.listed.decimals == 0:
        return None if value is None else round(value)
    return round(value, one.listed.decimals + 1)


def _covariance(position: dict[str, Any]) -> tuple[float, float, float] | None:
    """East-east, east-north, north-north [m^2]."""
    try:
        (ee, en), (_, nn) = position["covariance_m2"]
        return float(ee), float(en), float(nn)
    except (KeyError, TypeError, ValueError):
        return None


def _error_and_nees(
    position_m: tuple[float | None, float | None], covariance: tuple[float, float, float] | None, real: Position | None
) -> tuple[float | None, float | None]:
    """Distance from the true position [m] and NEES, e^T C^-1 e."""
    if real is None or position_m[0] is None or position_m[1] is None:
        return None, None
    east, north = position_m[0] - real[0], position_m[1] - real[1]
    ee, en, nn = covariance or (0.0, 0.0, 0.0)
    determinant = ee * nn - en * en
    nees = (nn * east**2 - 2 * en * east * north + ee * north**2) / determinant if determinant > 0 else None
    return math.hypot(east, north), nees


def _fraction_inside(known: Sequence[Sequence[Any]], error: int, radius: int) -> float | None:
    held = [row[error] <= row[radius] for row in known if row[radius] is not None]
    return round_or_none(sum(held) / len(held), 4) if held else None


def _seconds(record: Mapping[str, Any]) -> float | None:
    times = section_of(record, "timing_ms")
    return sum(number_of(times, stage) or 0.0 for stage in times) / 1e3 if times else None
