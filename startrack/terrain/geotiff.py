"""Height maps to GeoTIFF files: 16-bit steps with scale and offset, deflated, as GDAL and this library read them."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from startrack.terrain.projection import EQUIRECTANGULAR, ORTHOGRAPHIC, STEREOGRAPHIC, Projection
from startrack.terrain.raster import Raster

FINEST_STEP_M = 0.01
NO_HEIGHT = 65_535
DOUBLES_TAG, ASCII_TAG = 34736, 34737
USER_DEFINED, METRE, DEGREE = 32767, 9001, 9102


def write_map(
    path: str | Path, height_map: Raster, *, step_m: float | None = None, offset_m: float | None = None
) -> None:
    """Write the map, whole or not at all. Heights are kept to `step_m`, by default a 65,000th of their range."""
    import tifffile

    h = height_map.heights_m.astype(np.float64)
    low, high = float(np.nanmin(h)), float(np.nanmax(h))
    offset = low if offset_m is None else offset_m
    step = max((high - low) / 65_000, FINEST_STEP_M) if step_m is None else step_m
    values = np.where(np.isnan(h), NO_HEIGHT, np.round((np.nan_to_num(h) - offset) / step)).astype(np.uint16)
    metadata = (
        f'<GDALMetadata><Item name="SCALE" sample="0" role="scale">{step!r}</Item>'
        f'<Item name="OFFSET" sample="0" role="offset">{offset!r}</Item></GDALMetadata>'
    )
    tags = [(42112, "s", 0, metadata, True), *_where(height_map)]
    if np.isnan(h).any():
        tags.append((42113, "s", 0, str(NO_HEIGHT), True))
    path = Path(path)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=".making-", suffix=".tif")
    os.close(handle)
    try:
        tifffile.imwrite(
            name, values, compression="deflate", compressionargs={"level": 9}, predictor=True, extratags=tags,
            metadata=None, rowsperstrip=256, software="startrack",
        )  # fmt: skip
        Path(name).chmod(0o644)
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def _where(height_map: Raster) -> list[tuple[int, str, int, Any, bool]]:
    """The tags that say where the map lies: posts are pixel centres (raster type "area")."""
    m = height_map
    corner = m.x0_m - 0.5 * m.dx_m, m.y0_m - 0.5 * m.dy_m
    keys, doubles, text = _geo_keys(m.projection)
    directory = [1, 1, 1, len(keys), *(number for key in sorted(keys) for number in key)]
    return [
        (33550, "d", 3, (m.dx_m, -m.dy_m, 0.0), True),
        (33922, "d", 6, (0.0, 0.0, 0.0, *corner, 0.0), True),
        (34735, "H", len(directory), tuple(directory), True),
        (DOUBLES_TAG, "d", len(doubles), tuple(doubles), True),
        (ASCII_TAG, "s", 0, text, True),
    ]


def _geo_keys(p: Projection) -> tuple[list[tuple[int, int, int, int]], list[float], str]:
    """Entries of the key directory, the numbers and the text they point to."""
    text = "Moon 2015 sphere|"
    doubles: list[float] = []
    keys: list[tuple[int, int, int, int]] = []

    def short(key: int, value: int) -> None:
        keys.append((key, 0, 1, value))

    def double(key: int, value: float) -> None:
        keys.append((key, DOUBLES_TAG, 1, len(doubles)))
        doubles.append(float(value))

    degrees = p.kind == EQUIRECTANGULAR and p.scale_y != 1.0  # latitude and longitude themselves
    short(1024, 2 if degrees else 1)
    short(1025, 1)
    short(2048, USER_DEFINED)
    keys.append((2049, ASCII_TAG, len(text), 0))
    short(2050, USER_DEFINED)
    short(2054, DEGREE)
    short(2056, USER_DEFINED)
    double(2057, p.radius_m)
    double(2058, p.radius_m)
    if degrees:
        return keys, doubles, text
    short(3072, USER_DEFINED)
    short(3074, USER_DEFINED)
    short(3075, {STEREOGRAPHIC: 14, ORTHOGRAPHIC: 21, EQUIRECTANGULAR: 17}[p.kind])
    short(3076, METRE)
    latitude, longitude = np.degrees(p.latitude_rad), np.degrees(p.longitude_rad)
    polar = p.kind == STEREOGRAPHIC and abs(latitude) == 90.0
    if polar:
        keys[[key[0] for key in keys].index(3075)] = (3075, 0, 1, 15)
        double(3081, latitude)
        double(3095, longitude)
        double(3092, p.scale)
    elif p.kind == EQUIRECTANGULAR:
        double(3078, np.degrees(np.arccos(p.scale)))
        double(3088, longitude)
        double(3089, 0.0)
    else:
        double(3088, longitude)
        double(3089, latitude)
        double(3092, p.scale)
    double(3082, p.false_x_m)
    double(3083, p.false_y_m)
    return keys, doubles, text
