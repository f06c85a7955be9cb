"""The stars of an image on a page: the brightest as columns, and their evidence by sectors of azimuth."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from startrack.catalog import proper_name_designations
from startrack.core.types import Array, Bools, Evidence
from startrack.localization import Sectors

Horizon = Callable[[Array], Array]  # azimuths (n,) to elevations (n,) [rad]
# name on the page, column of NAME.stars.ecsv, decimals (None: a text)
STAR_COLUMNS: tuple[tuple[str, str, int | None], ...] = (
    ("id", "catalog_id", None), ("name", "name", None), ("mag", "v_mag", 2), ("az", "azimuth_deg", 3),
    ("el", "elevation_deg", 3), ("x", "x_px", 2), ("y", "y_px", 2), ("mx", "x_measured_px", 2),
    ("my", "y_measured_px", 2), ("exp", "expected_e", 0), ("flux", "flux_e", 0), ("sigma", "sigma_e", 0),
    ("ev", "evidence", 2), ("status", "status", None), ("cause", "cause", None),
)  # fmt: skip
DIRECTION_COLUMNS = ("azimuth_deg", "elevation_deg", "evidence")
PAGE_SECTORS = 72  # of 5 degrees: wide enough for some stars near the skyline, narrow enough to show a boulder
NEAR_RAD = np.radians(3.0)  # to either side of the skyline
COARSE_AZIMUTHS = 10 * PAGE_SECTORS + 1
COARSE_ERROR_RAD = NEAR_RAD / 3  # a ridge between two coarse azimuths: nearer stars get their own horizon
SURE_LLR = 4.0  # of stars that decide; of weaker ones some level skyline always fits the noise better
CONTRADICTED_NATS = -3.0  # of one sector


@dataclass(frozen=True)
class MeasuredStars:
    """All stars of a table with evidence."""

    azimuth_rad: Array  # (n,)
    elevation_rad: Array  # (n,)
    llr: Array  # (n,) ln p(light | visible) - ln p(light | hidden)
    status: NDArray[np.str_]  # (n,)


class StarTable(NamedTuple):
    """What a page needs of a star table."""

    shown: dict[str, Any]  # the brightest stars as columns, designations of named ones, how many have each status
    measured: MeasuredStars


def star_table_of(path: Path, most: int) -> StarTable | None:
    """The star table at `path`, its `most` brightest stars to be shown; None where there is none."""
    if not path.is_file():
        return None
    with path.open(encoding="utf-8", newline="") as file:
        head, found = read_ecsv(file)
        rows = list(found)
    columns = {
        name: [_text_or_number(row.get(column) or "", decimals) for row in rows[:most]]
        for name, column, decimals in STAR_COLUMNS
    }
    names = proper_name_designations()
    shown = {
        "total": len(rows),
        "counts": dict(Counter(row.get("status", "") for row in rows)),
        "unit": "ADU" if any("'expected_e'" in line and "unit: adu" in line for line in head) else "e",
        "columns": {key: values for key, values in columns.items() if any(one not in (None, "") for one in values)},
        "designations": {name: known for name in columns["name"] if (known := names.get(name))},
    }
    measured = [row for row in rows if row.get("evidence")]
    azimuth, elevation, llr = (np.array([float(row[name]) for row in measured]) for name in DIRECTION_COLUMNS)
    status = np.array([row.get("status", "") for row in measured], dtype=np.str_)
    return StarTable(shown, MeasuredStars(np.radians(azimuth), np.radians(elevation), llr, status))


def read_ecsv(file: Any) -> tuple[list[str], Iterator[dict[str, str]]]:
    """ECSV's comment lines, and its rows."""
    head: list[str] = []
    for line in file:
        if not line.startswith("#"):
            names = next(csv.reader([line]))
            return head, (dict(zip(names, row, strict=False)) for row in csv.reader(file))
        head.append(line)
    return head, iter(())


def _text_or_number(text: str, decimals: int | None) -> Any:
    if decimals is None:
        return text
    try:
        number = round(float(text), decimals)
    except ValueError:  # an empty field: nothing was measured
        return None
    return int(number) if decimals == 0 or number == int(number) else number


def sectors_of(stars: MeasuredStars, horizon: Horizon) -> dict[str, Any] | None:
    """What the `stars` near the `horizon` show in PAGE_SECTORS sectors from north through east; None without stars.

    `near_deg`: how near. `above` and `below` the horizon: numbers of stars there that are `seen` and `hidden`.
    `supports` and `opposes`: sums of |evidence| [nats] of near stars that agree with the horizon and that do not.
    `nats`: log-likelihood of the horizon beside the best one that is shifted up or down in this sector alone, from the
    stars whose evidence is sure; 0 is perfect, None without such stars. A sector below `contradicted_nats`
    contradicts the position.
    """
    above_rad = _heights_rad(stars, horizon)
    near = np.abs(above_rad) < NEAR_RAD  # False where it is not known
    if not near.any():
        return None
    sector = (stars.azimuth_rad / (2 * np.pi) * PAGE_SECTORS).astype(int) % PAGE_SECTORS
    above, agrees = above_rad > 0, (above_rad > 0) == (stars.llr > 0)

    def count(side: Bools, status: str) -> list[int]:
        chosen = near & side & (stars.status == status)
        return [int(number) for number in np.bincount(sector[chosen], minlength=PAGE_SECTORS)]

    def total(chosen: Bools) -> list[float]:
        chosen = near & chosen
        weights = np.abs(stars.llr[chosen])
        return _rounded(np.bincount(sector[chosen], weights=weights, minlength=PAGE_SECTORS).astype(np.float64))

    sure = np.isfinite(above_rad) & (np.abs(stars.llr) > SURE_LLR)
    return {
        "near_deg": round(float(np.degrees(NEAR_RAD)), 3),
        "contradicted_nats": CONTRADICTED_NATS,
        "above": {status: count(above, status) for status in ("seen", "hidden")},
        "below": {status: count(~above, status) for status in ("seen", "hidden")},
        "supports": total(agrees),
        "opposes": total(~agrees),
        "nats": _rounded(_nats_by_sector(stars.azimuth_rad[sure], above_rad[sure], stars.llr[sure])),
    }


def _heights_rad(stars: MeasuredStars, horizon: Horizon) -> Array:
    """Heights (n,) of the stars above the horizon; of stars far from it to COARSE_ERROR_RAD."""
    azimuth = np.linspace(0.0, 2 * np.pi, COARSE_AZIMUTHS)
    above_rad = stars.elevation_rad - np.interp(stars.azimuth_rad, azimuth, horizon(azimuth))
    near = np.abs(above_rad) < NEAR_RAD + COARSE_ERROR_RAD
    above_rad[near] = stars.elevation_rad[near] - horizon(stars.azimuth_rad[near])
    return above_rad


def _nats_by_sector(azimuth_rad: Array, above_rad: Array, llr: Array) -> Array:
    """Log-likelihood (PAGE_SECTORS,) of the horizon beside the best shifted one; nan where a sector has no row.

    Elevations are counted from the horizon, so that the best level skyline of a sector is the horizon shifted.
    """
    evidence = Evidence(azimuth_rad=azimuth_rad, elevation_rad=np.clip(above_rad, -np.pi / 2, np.pi / 2), llr=llr)
    sectors = Sectors(evidence, PAGE_SECTORS, epsilon=0.0)
    visible = np.where(above_rad > 0, llr, 0.0)
    sums = np.bincount(sectors.sector, weights=visible, minlength=PAGE_SECTORS).astype(np.float64)
    occupied = np.bincount(sectors.sector, minlength=PAGE_SECTORS) > 0
    return np.where(occupied, sectors.by_sector(sums), np.nan)


def _rounded(values: Array) -> list[Any]:
    """Values for JSON, None for nan."""
    return [round(value, 2) + 0.0 if np.isfinite(value) else None for value in values.tolist()]
