"""Columns of numbers in CSV files, and obstacles that were scanned: how high they hide the sky, by azimuth."""

from __future__ import annotations

import csv
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from startrack.core.errors import BadInput
from startrack.core.files import FilePath, printable, read_text
from startrack.core.values import Array, Bools

OBSTACLE_COLUMNS = ("azimuth_deg", "elevation_deg")
MOST_TURN_DEG = 720.0  # of an azimuth: twice around
MOST_GAP_RAD = np.radians(10.0)  # between rows farther apart nothing was scanned, and nothing is hidden
LEAST_ROWS = 2


def column_names(path: FilePath, reason: str) -> list[str]:
    """The names of the columns in a CSV or ECSV file at `path`. Raises BadInput `reason` where it cannot be read."""
    first = next((line for line in _lines(path, reason) if line.strip()), "")
    return [word.strip() for word in first.split(",")]


def _lines(path: FilePath, reason: str) -> list[str]:
    """Lines of the file at `path`; those of comments, as of ECSV, are empty, so that the others keep their numbers."""
    lines = read_text(path, reason).removeprefix("\ufeff").splitlines()
    return ["" if line.startswith("#") else line for line in lines]


def read_columns(path: FilePath, names: Sequence[str], reason: str, *, gaps_in: Sequence[str] = ()) -> Array:
    """Numbers (n, columns) of the columns `names` in a CSV or ECSV file at `path` with a header line.

    Other columns are ignored. A field of the columns `gaps_in` may be empty: nan. Raises BadInput `reason` with the
    file and the cause.
    """
    lines = csv.reader(_lines(path, reason))
    try:
        rows = [(lines.line_num, [word.strip() for word in row]) for row in lines if any(word.strip() for word in row)]
        if not rows or any(rows[0][1].count(name) != 1 for name in names):
            raise ValueError(f"its first line does not name the columns {' and '.join(names)}")
        columns, found = [rows[0][1].index(name) for name in names], np.empty((len(rows) - 1, len(names)))
        for k, (number, row) in enumerate(rows[1:]):
            try:
                words = [row[column] for column in columns]
                is_gap = np.array([name in gaps_in and not word for name, word in zip(names, words, strict=True)])
                found[k] = [np.nan if gap else float(word) for gap, word in zip(is_gap, words, strict=True)]
                is_wrong = not (np.isfinite(found[k]) | is_gap).all()
            except (ValueError, IndexError):
                is_wrong = True
            if is_wrong:
                raise ValueError(f"line {number}: finite numbers are expected for {' and '.join(names)}")
        return found
    except (ValueError, csv.Error) as cause:
        raise BadInput(reason, f"{printable(path)}: {cause}") from cause


@dataclass(frozen=True, eq=False)
class Obstacles:
    """Skyline of scanned obstacles, straight between its n points; gaps of more than 10 degrees hide nothing."""

    azimuth_rad: Array  # (n,) ascending, from 0 to below a turn
    elevation_rad: Array  # (n,)
    sha256: str = ""  # of the values

    def hides(self, azimuth_rad: Array, elevation_rad: Array) -> Bools:
        """Whether directions (...) at `azimuth_rad` and `elevation_rad` [rad] lie below the obstacles' skyline."""
        at, turn = np.mod(azimuth_rad, 2 * np.pi), 2 * np.pi
        around = np.r_[self.azimuth_rad[-1] - turn, self.azimuth_rad, self.azimuth_rad[0] + turn]
        top = np.interp(at, around, np.r_[self.elevation_rad[-1], self.elevation_rad, self.elevation_rad[0]])
        after = np.clip(np.searchsorted(around, at, side="right"), 1, len(around) - 1)
        return np.asarray((around[after] - around[after - 1] <= MOST_GAP_RAD) & (elevation_rad < top))


def read_obstacles(path: FilePath, reason: str) -> Obstacles:
    """The obstacles in a CSV file at `path`; rows without an elevation are gaps.

    Raises BadInput `reason` for a file without both columns, with words, with numbers that are no angles, or without
    two rows.
    """
    found = read_columns(path, OBSTACLE_COLUMNS, reason, gaps_in=OBSTACLE_COLUMNS[1:])
    azimuth, elevation = found.T
    wrong = (np.abs(azimuth) > MOST_TURN_DEG) | (np.abs(elevation) > 90.0)
    cause = ""
    if wrong.any():
        k = int(np.argmax(wrong))
        cause = f"azimuth {azimuth[k]:g} and elevation {elevation[k]:g} are no angles in degrees above a horizon"
    elif np.count_nonzero(np.isfinite(elevation)) < LEAST_ROWS:
        cause = f"it has {np.count_nonzero(np.isfinite(elevation))} rows with an elevation; {LEAST_ROWS} are needed"
    if cause:
        raise BadInput(reason, f"{printable(path)}: {cause}")
    known = found[np.isfinite(elevation)]
    azimuth, elevation = np.mod(np.radians(known[:, 0]), 2 * np.pi), np.radians(known[:, 1])
    order = np.argsort(azimuth, kind="stable")
    return Obstacles(azimuth[order], elevation[order], hashlib.sha256(known.tobytes()).hexdigest())
