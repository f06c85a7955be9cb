"""Details of one image on a page: ground, picture, stars, their evidence by sectors of azimuth, and skyline."""

from __future__ import annotations

import base64
import csv
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from startrack.catalog import proper_name_designations
from startrack.core.declaration import LARGEST
from startrack.core.types import Array, Bools
from startrack.localization import ROW_NATS
from startrack.output.picture.annotate import layers_of, picture_in
from startrack.output.picture.canvas import QUALITY, encoded_bytes
from startrack.output.picture.maps import edge_cover, ground_cells, hill_shading
from startrack.output.tables import half_range_rad
from startrack.terrain import Terrain

RELIEF_CELLS = 420
MAP_MARGIN = 1.03  # beyond the map, for its edge
BRIGHTEST = 215.0
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
SOURCES = ("", "stars", "sky light", "both")  # of a skyline; the page has their places in this list


class MeasuredStars(NamedTuple):
    """All stars of a table with evidence."""

    azimuth_rad: Array  # (n,)
    elevation_rad: Array  # (n,)
    llr: Array  # (n,) ln p(light | visible) - ln p(light | hidden)
    status: NDArray[np.str_]  # (n,)


def star_table_of(path: Path, most: int) -> tuple[dict[str, Any] | None, MeasuredStars]:
    """What a page shows of the star table at `path`, None where there is none, and all its stars with evidence.

    Shown are the `most` brightest stars as columns, designations of named ones, and how many have each status.
    """
    head, rows = read_ecsv(path)
    columns = {
        name: [_text_or_number(row.get(column) or "", decimals) for row in rows[:most]]
        for name, column, decimals in STAR_COLUMNS
    }
    names = proper_name_designations()
    shown = {
        "total": len(rows),
        "counts": dict(Counter(row.get("status") or "" for row in rows)),
        "unit": "ADU" if any("'expected_e'" in line and "unit: adu" in line for line in head) else "e",
        "columns": {key: values for key, values in columns.items() if any(one not in (None, "") for one in values)},
        "designations": {name: known for name in columns["name"] if (known := names.get(name))},
    }
    measured, (azimuth, elevation, llr) = _known_rows(rows, DIRECTION_COLUMNS)
    status = np.array([row.get("status") or "" for row in measured], dtype=np.str_)
    stars = MeasuredStars(np.radians(azimuth), np.radians(elevation), llr, status)
    return (shown if head else None), stars


def read_ecsv(path: Path) -> tuple[list[str], list[dict[str, str]]]:
    """The comment lines and the rows of an ECSV file; both empty where there is none, or none that can be read."""
    lines = path.read_text(encoding="utf-8", errors="replace").split("\n") if path.is_file() else []
    head = [line for line in lines if line.startswith("#")]
    try:
        return head, list(csv.DictReader(lines[len(head) :]))
    except csv.Error:
        return [], []


def _number(text: str | None) -> float:
    """The number of a field; nan where it is empty, no number, or larger than any of ours."""
    try:
        value = float(text or "nan")
    except ValueError:
        return np.nan
    return value if abs(value) <= LARGEST else np.nan


def _known_rows(rows: list[dict[str, str]], names: Sequence[str]) -> tuple[list[dict[str, str]], Array]:
    """The rows with a number in each of the columns `names`, and these numbers (columns, rows)."""
    numbers = np.array([[_number(row.get(name)) for name in names] for row in rows]).reshape(len(rows), len(names))
    known = np.isfinite(numbers).all(axis=1)
    return [row for row, is_known in zip(rows, known.tolist(), strict=True) if is_known], numbers[known].T


def _text_or_number(text: str, decimals: int | None) -> Any:
    if decimals is None:
        return text
    number = round(_number(text), decimals)
    return None if number != number else int(number) if number == int(number) else number


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

    def sum_evidence(chosen: Bools) -> list[float]:
        """Sums of |evidence| [nats] of the `chosen` (n,) near stars, one a sector (PAGE_SECTORS,)."""
        chosen = near & chosen
        weights = np.abs(stars.llr[chosen])
        return round_values(np.bincount(sector[chosen], weights=weights, minlength=PAGE_SECTORS))

    sure = np.isfinite(above_rad) & (np.abs(stars.llr) > SURE_LLR)
    return {
        "near_deg": round(float(np.degrees(NEAR_RAD)), 3),
        "contradicted_nats": CONTRADICTED_NATS,
        "above": {status: count(above, status) for status in ("seen", "hidden")},
        "below": {status: count(~above, status) for status in ("seen", "hidden")},
        "supports": sum_evidence(agrees),
        "opposes": sum_evidence(~agrees),
        "nats": round_values(_nats_by_sector(stars.azimuth_rad[sure], above_rad[sure], stars.llr[sure])),
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

    Elevations are counted from the horizon, so that the best level skyline of a sector is the horizon shifted. A star
    counts as much as in the posterior.
    """
    found = np.full(PAGE_SECTORS, np.nan)
    llr, sector = (
        np.clip(llr, -ROW_NATS, ROW_NATS),
        (azimuth_rad / (2 * np.pi) * PAGE_SECTORS).astype(int) % PAGE_SECTORS,
    )
    for s in np.unique(sector):
        order = np.flatnonzero(sector == s)[np.argsort(-above_rad[sector == s])]
        by_height = np.concatenate([[0.0], np.cumsum(llr[order])])  # the horizon above all stars, below the first ...
        found[s] = by_height[np.count_nonzero(above_rad[order] > 0)] - by_height.max()
    return found


def skyline_of(path: Path, horizon: Horizon | None, stars: dict[str, Any] | None) -> dict[str, Any] | None:
    """The skyline of a table NAME.skyline.ecsv as columns of its known directions [deg]; None where there is none.

    Of a known `horizon` also `above`, the heights above it, `half`, the range of them to
    be shown, and `near`: the indices of the `stars` within that range, and their heights above the horizon.
    """
    found_there = (row for row in read_ecsv(path)[1] if row.get("source") in SOURCES[1:])
    rows, columns_deg = _known_rows(list(found_there), ("azimuth_deg", "elevation_deg", "sigma_deg"))
    if not rows:
        return None
    azimuth, elevation, sigma = np.radians(columns_deg)
    found: dict[str, Any] = {
        "az": round_values(np.degrees(azimuth), 2),
        "el": round_values(np.degrees(elevation), 3),
        "sigma": round_values(np.degrees(sigma), 4),
        "source": [SOURCES.index(row["source"]) for row in rows],
    }
    if horizon is None:
        return found
    above = elevation - horizon(azimuth)
    half, near = half_range_rad(above, sigma), list[list[float]]()
    columns = stars["columns"] if stars is not None else {}
    if "az" in columns and "el" in columns:
        az, el = (np.radians(np.array(columns[name], dtype=np.float64)) for name in ("az", "el"))  # None: nan
        heights = el - horizon(az)
        which = np.flatnonzero(np.abs(heights) < half)
        near = [
            [k, height] for k, height in zip(which.tolist(), round_values(np.degrees(heights[which]), 3), strict=True)
        ]
    shown = {"above": round_values(np.degrees(above), 4), "half": round(float(np.degrees(half)), 3), "near": near}
    return found | shown


def ground_map(
    terrain: Terrain, centre_m: tuple[float, float] = (0.0, 0.0), half_m: float | None = None
) -> dict[str, Any]:
    """`search_m`, the radius of the search area of a `terrain`; of a cylinder `rim_m`, else `relief`.

    The relief shows `half_m` on each side of `centre_m`, east and north.
    """
    shape: dict[str, Any] = {
        "search_m": terrain.search_radius_m,
        "site": terrain.site.body if terrain.site is not None else None,
    }
    if terrain.rim is not None:
        return {**shape, "rim_m": terrain.rim.radius_m}
    half_m = MAP_MARGIN * terrain.reach_m if half_m is None else half_m
    cells = RELIEF_CELLS, RELIEF_CELLS
    ground_m, known = ground_cells(terrain, (half_m, half_m), cells, centre_m)
    grey = np.rint(BRIGHTEST * hill_shading(ground_m, known, (half_m, half_m)))
    cover = np.rint(255 * edge_cover(known, cells))  # see-through where a camera cannot stand
    relief = data_uri(np.stack([grey, grey, grey, cover], axis=-1).astype(np.uint8))
    return {**shape, "half_m": half_m, "centre_m": list(centre_m), "relief": relief}


def picture_of(picture: Path, longest_px: int) -> dict[str, Any] | None:
    """`src` (a data URI), `width`, `height` [px of the picture], `scale` and `marks`; None without a picture.

    The image's pixel (x, y) lies at scale (x + 1/2), scale (y + 1/2) from the picture's top-left corner. `marks`: those
    of `overlay_of`, to be drawn on the picture. A file without layers is shown as it is, without these two.
    """
    data = picture.read_bytes() if picture.is_file() else b""
    layers = layers_of(data)
    found = picture_in(data) if layers is None else layers.bare
    if found is None:
        return None
    sky: Any = found[:, :, ::-1]
    shrink = longest_px / max(sky.shape[:2])
    if shrink < 1:
        size = tuple(max(1, round(n * shrink)) for n in sky.shape[1::-1])
        sky = cv2.resize(sky, size, interpolation=cv2.INTER_AREA)
    shown = {"src": data_uri(np.asarray(sky, dtype=np.uint8)), "width": sky.shape[1], "height": sky.shape[0]}
    if layers is None:
        return shown
    return {**shown, "scale": round(shown["width"] / layers.overlay["size"][0], 6), "marks": layers.overlay}


def data_uri(pixels: NDArray[np.uint8]) -> str:
    """A picture (H, W, 3), blue first, or (H, W, 4) with its cover, as a WebP data URI: a fifth of the PNG."""
    data = encoded_bytes(".webp", pixels, cv2.IMWRITE_WEBP_QUALITY, QUALITY)
    return f"data:image/webp;base64,{base64.b64encode(data).decode('ascii')}"


def round_values(values: NDArray[Any], decimals: int = 2) -> list[Any]:
    """Values for JSON, None for nan."""
    return [round(value, decimals) + 0.0 if np.isfinite(value) else None for value in values.tolist()]
