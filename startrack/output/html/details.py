"""Details of one image on a page: ground, horizon and skyline, and the picture with the marks to be drawn on it."""

from __future__ import annotations

import base64
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from startrack.core.types import Array, BadInput
from startrack.output.html.stars import Horizon, read_ecsv
from startrack.output.picture.annotate import layers_of
from startrack.output.picture.canvas import encoded_bytes
from startrack.output.picture.relief import edge_cover, ground_cells, hill_shading
from startrack.output.tables import half_range_rad
from startrack.terrain import Terrain, load_terrain

RELIEF_CELLS = 420
MAP_MARGIN = 1.03  # beyond the map, for its edge
BRIGHTEST = 215.0


def load_or_none(name: str) -> Terrain | None:
    """The terrain of a name or path; None where its file is not here."""
    try:
        return load_terrain(name)
    except BadInput:  # the page needs only the results: it states what is missing
        return None


def horizon_from(terrain: Terrain, east_m: float, north_m: float) -> Horizon:
    """The horizon seen from a position."""

    def horizon_rad(azimuth_rad: Array) -> Array:
        place = np.broadcast_to([east_m, north_m], (len(azimuth_rad), 2))
        return np.asarray(terrain.horizon_rad(place, azimuth_rad))

    return horizon_rad


def horizon_line(horizon: Horizon, count: int) -> list[float] | None:
    """Elevation of the `horizon` [deg] at `count` azimuths, evenly from 0 to 360 degrees, both ends included.

    None from where it is not known: a position off the map.
    """
    elevation = horizon(np.linspace(0.0, 2 * np.pi, count))
    return _round_values(np.degrees(elevation), 3) if np.isfinite(elevation).all() else None


SOURCES = ("", "stars", "sky light", "both")  # of a skyline; the page has their places in this list


def skyline_of(path: Path, horizon: Horizon | None, stars: dict[str, Any] | None) -> dict[str, Any] | None:
    """The skyline of a table NAME.skyline.ecsv as columns of its known directions [deg]; None where there is none.

    Of a known `horizon` also `above`, the heights above it, `half`, the range of them to
    be shown, and `near`: the indices of the `stars` within that range, and their heights above the horizon.
    """
    if not path.is_file():
        return None
    with path.open(encoding="utf-8", newline="") as file:
        rows = [row for row in read_ecsv(file)[1] if row.get("source") in SOURCES[1:]]
    if not rows:
        return None
    azimuth, elevation, sigma = (
        np.radians([float(row[f"{name}_deg"]) for row in rows]) for name in ("azimuth", "elevation", "sigma")
    )
    found: dict[str, Any] = {
        "az": _round_values(np.degrees(azimuth), 2),
        "el": _round_values(np.degrees(elevation), 3),
        "sigma": _round_values(np.degrees(sigma), 4),
        "source": [SOURCES.index(row["source"]) for row in rows],
    }
    if horizon is None:
        return found
    above = elevation - horizon(azimuth)
    half = half_range_rad(above, sigma)
    return {
        **found,
        "above": _round_values(np.degrees(above), 4),
        "half": round(math.degrees(half), 3),
        "near": _stars_near(stars, horizon, half),
    }


def _stars_near(stars: dict[str, Any] | None, horizon: Horizon, half_rad: float) -> list[list[float]]:
    """Index and height above the `horizon` [deg] of each star within `half_rad` of it."""
    columns = stars["columns"] if stars is not None else {}
    if "az" not in columns or "el" not in columns:
        return []
    above = np.radians(columns["el"]) - horizon(np.radians(columns["az"]))
    near = np.flatnonzero(np.abs(above) < half_rad)
    return [list(pair) for pair in zip(near.tolist(), _round_values(np.degrees(above[near]), 3), strict=True)]


def _round_values(values: Array, decimals: int) -> list[float]:
    return [round(value, decimals) for value in values.tolist()]


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
    if terrain.rim_radius_m is not None:
        return {**shape, "rim_m": terrain.rim_radius_m}
    half_m = MAP_MARGIN * terrain.reach_m if half_m is None else half_m
    return {**shape, "half_m": half_m, "centre_m": list(centre_m), "relief": _relief(terrain, centre_m, half_m)}


def _relief(terrain: Terrain, centre_m: tuple[float, float], half_m: float) -> str:
    """The ground's shape, lit from the north-west as maps are; see-through where a camera cannot stand."""
    halves_m, shape = (half_m, half_m), (RELIEF_CELLS, RELIEF_CELLS)
    ground_m, known = ground_cells(terrain, halves_m, shape, centre_m)
    grey = np.rint(BRIGHTEST * hill_shading(ground_m, known, halves_m)).astype(np.uint8)
    cover = np.rint(255 * edge_cover(known, shape)).astype(np.uint8)
    return data_uri(np.stack([grey, grey, grey, cover], axis=-1))


QUALITY = 82


def picture_of(picture: Path, longest_px: int) -> dict[str, Any] | None:
    """`src` (a data URI), `width`, `height` [px of the picture], `scale` and `marks`; None without a picture.

    The image's pixel (x, y) lies at scale (x + 1/2), scale (y + 1/2) from the picture's top-left corner. `marks`: those
    of `overlay_of`, to be drawn on the picture. A file without layers is shown as it is, without these two.
    """
    data = picture.read_bytes() if picture.is_file() else b""
    layers = layers_of(data)
    if layers is not None:
        shown = _shown(layers.bare[:, :, ::-1], longest_px)
        return {**shown, "scale": round(shown["width"] / layers.overlay["size"][0], 6), "marks": layers.overlay}
    whole = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
    return None if whole is None else _shown(np.asarray(whole, dtype=np.uint8), longest_px)


def _shown(sky: NDArray[np.uint8], longest_px: int) -> dict[str, Any]:
    """The picture (H, W, 3), blue first, for the page."""
    shrink = min(1.0, longest_px / max(sky.shape[:2]))
    if shrink < 1:
        size = tuple(max(1, round(n * shrink)) for n in sky.shape[1::-1])
        sky = np.asarray(cv2.resize(sky, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return {"src": data_uri(sky), "width": sky.shape[1], "height": sky.shape[0]}


def data_uri(pixels: NDArray[np.uint8]) -> str:
    """A picture (H, W, 3), blue first, or (H, W, 4) with its cover, as a WebP data URI: a fifth of the PNG."""
    data = encoded_bytes(".webp", pixels, cv2.IMWRITE_WEBP_QUALITY, QUALITY)
    return f"data:image/webp;base64,{base64.b64encode(data).decode('ascii')}"
