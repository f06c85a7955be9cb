"""GeoTIFF files by their own tags, read and written: the ground of height maps on the Moon's sphere."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from startrack.core.files import atomic_file
from startrack.core.types import BadInput
from startrack.terrain.raster import (
    EQUIRECTANGULAR,
    ORTHOGRAPHIC,
    STEREOGRAPHIC,
    Grid,
    Projection,
    Raster,
    projection_of,
)

MAX_PIXELS = 200_000_000
MIN_STEP_M = 0.01  # of the heights in files that are written
NO_HEIGHT = 65_535
METRES = {"m", "meter", "meters", "metre", "metres"}
STEREOGRAPHIC_CODES, ORTHOGRAPHIC_CODE, EQUIRECTANGULAR_CODE = (14, 15, 16), 21, 17  # GeoTIFF 1.1, annex
DOUBLES_TAG, ASCII_TAG, METADATA_TAG, NO_DATA_TAG = 34736, 34737, 42112, 42113
DECODED = (1, 8, 32773, 32946)  # codes of compression: none, deflate, PackBits, deflate
USER_DEFINED, METRE, DEGREE = 32767, 9001, 9102


def read_geotiff(path: Path) -> Grid | None:
    """The grid of a GeoTIFF, or None where its place, size, projection or compression is one for rasterio.

    Raises BadInput bad_terrain for a file that cannot be decoded.
    """
    import tifffile

    try:
        with _suppress_tifffile_log(), tifffile.TiffFile(path) as file:
            page = file.pages.first
            keys, gdal = file.geotiff_metadata, file.gdal_metadata
            if not keys:
                raise BadInput("bad_terrain", f"{path}: it has no position on the Moon (no GeoTIFF tags)")
            if not isinstance(keys, dict) or "ModelPixelScale" not in keys or "ModelTiepoint" not in keys:
                return None
            parameters = _proj_parameters(keys)
            if page.compression not in DECODED:
                return None
            if parameters is None or page.size > MAX_PIXELS or len(page.shape) != 2:
                return None
            scale, offset = _gdal_scale(gdal)
            no_data = page.tags.get(NO_DATA_TAG)
            dx, dy = float(keys["ModelPixelScale"][0]), -float(keys["ModelPixelScale"][1])
            i, j, _, x, y, _ = (float(v) for v in keys["ModelTiepoint"][:6])
            middle = 0.0 if int(keys.get("GTRasterTypeGeoKey", 1)) == 2 else 0.5  # 2: the tie point is a post
            return Grid(
                values=np.asarray(page.asarray()),
                projection=projection_of(parameters),
                first_m=(x + (middle - i) * dx, y + (middle - j) * dy),
                step_m=(dx, dy),
                scale=scale,
                offset_m=offset,
                no_data=None if no_data is None else float(str(no_data.value).strip("\x00 ")),
            )
    except BadInput:
        raise
    except Exception as cause:  # a damaged file makes the decoders raise errors of nearly any class
        raise BadInput("bad_terrain", f"{path}: not a TIFF file that can be read: {_one_line(cause)}") from cause


@contextmanager
def _suppress_tifffile_log() -> Iterator[None]:
    """Suppress tifffile's log of errors in a file: the exception has the cause."""
    log = logging.getLogger("tifffile")
    level = log.level
    log.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        log.setLevel(level)


def _one_line(cause: Exception) -> str:
    return " ".join(str(cause).split())[:200] or type(cause).__name__


def _gdal_scale(items: Any) -> tuple[float | None, float]:
    """SCALE and OFFSET of GDAL's metadata: None where the step is not known, and 0."""
    if isinstance(items, str):
        items = {e.get("name"): e.text for e in ElementTree.fromstring(items).iter("Item")}
    found = {}
    if isinstance(items, dict):
        for key, value in items.items():
            name = key[0] if isinstance(key, tuple) else key
            found[str(name).upper()] = value
        for value in [v for v in items.values() if isinstance(v, dict)]:
            found.update({str(k).upper(): v for k, v in value.items()})
    metres = 1.0 if str(found.get("UNITTYPE", "")).lower() in METRES else None
    return (float(found["SCALE"]) if "SCALE" in found else metres), float(found.get("OFFSET", 0.0))


def _proj_parameters(keys: Mapping[str, Any]) -> dict[str, Any] | None:
    """PROJ's parameters of GeoTIFF keys; None for projections that only rasterio reads."""

    def number(*names: str, default: float = 0.0) -> float:
        return next((float(keys[name]) for name in names if name in keys), default)

    p: dict[str, Any] = {"x_0": number("ProjFalseEastingGeoKey", "ProjFalseOriginEastingGeoKey")}
    p["y_0"] = number("ProjFalseNorthingGeoKey", "ProjFalseOriginNorthingGeoKey")
    if "GeogSemiMajorAxisGeoKey" not in keys:
        return None
    p["a"] = number("GeogSemiMajorAxisGeoKey")
    p["b"] = number("GeogSemiMinorAxisGeoKey", default=p["a"])
    if int(keys.get("GTModelTypeGeoKey", 0)) == 2:
        return {**p, "proj": "longlat", "lon_0": 0.0}
    if "ProjLinearUnitsGeoKey" in keys and int(keys["ProjLinearUnitsGeoKey"]) != 9001:
        return None
    code = int(keys.get("ProjCoordTransGeoKey", 0))
    p["lon_0"] = number("ProjStraightVertPoleLongGeoKey", "ProjCenterLongGeoKey", "ProjNatOriginLongGeoKey")
    p["lat_0"] = number("ProjCenterLatGeoKey", "ProjNatOriginLatGeoKey")
    if code in STEREOGRAPHIC_CODES:
        p["k_0"] = number("ProjScaleAtNatOriginGeoKey", default=1.0)
        if code == 15 and abs(p["lat_0"]) < 90:  # the variant that names the latitude of true scale
            p["lat_ts"], p["lat_0"] = p["lat_0"], 90.0 if p["lat_0"] > 0 else -90.0
        return {**p, "proj": "stere"}
    if code == ORTHOGRAPHIC_CODE:
        return {**p, "proj": "ortho"}
    if code == EQUIRECTANGULAR_CODE:
        return {**p, "proj": "eqc", "lat_ts": number("ProjStdParallel1GeoKey")}
    return None


def write_map(path: str | Path, raster: Raster, *, step_m: float | None = None, offset_m: float | None = None) -> None:
    """Write a map as deflated 16-bit steps with scale and offset, as GDAL reads them; the file appears when complete.

    Heights are rounded to `step_m`, by default a 65,000th of their range. Raises OSError.
    """
    import tifffile

    h = raster.heights_m.astype(np.float64)
    low, high = float(np.nanmin(h)), float(np.nanmax(h))
    offset = low if offset_m is None else offset_m
    step = max((high - low) / 65_000, MIN_STEP_M) if step_m is None else step_m
    values = np.where(np.isnan(h), NO_HEIGHT, np.round((np.nan_to_num(h) - offset) / step)).astype(np.uint16)
    metadata = (
        f'<GDALMetadata><Item name="SCALE" sample="0" role="scale">{step!r}</Item>'
        f'<Item name="OFFSET" sample="0" role="offset">{offset!r}</Item></GDALMetadata>'
    )
    tags = [(METADATA_TAG, "s", 0, metadata, True), *_place_tags(raster)]
    if np.isnan(h).any():
        tags.append((NO_DATA_TAG, "s", 0, str(NO_HEIGHT), True))
    with atomic_file(path) as temporary:
        tifffile.imwrite(
            temporary, values, compression="deflate", compressionargs={"level": 9}, predictor=True, extratags=tags,
            metadata=None, rowsperstrip=256, software="startrack",
        )  # fmt: skip


def write_bands(path: str | Path, frame: Raster, bands: Mapping[str, NDArray[np.float32]]) -> None:
    """Write named bands (rows, columns) at the place of a `frame`'s posts, NaN where there is no value. Raises OSError.

    The file appears when complete.
    """
    import tifffile

    names = "".join(
        f'<Item name="DESCRIPTION" sample="{k}" role="description">{name}</Item>' for k, name in enumerate(bands)
    )
    metadata = f"<GDALMetadata>{names}</GDALMetadata>"
    tags = [(METADATA_TAG, "s", 0, metadata, True), *_place_tags(frame), (NO_DATA_TAG, "s", 0, "nan", True)]
    values = np.stack([np.asarray(band, dtype=np.float32) for band in bands.values()])
    with atomic_file(path) as temporary:
        tifffile.imwrite(
            temporary, values, photometric="minisblack", planarconfig="separate", compression="deflate",
            compressionargs={"level": 9}, extratags=tags, metadata=None, software="startrack",
        )  # fmt: skip


def _place_tags(raster: Raster) -> list[tuple[int, str, int, Any, bool]]:
    """The tags of the map's place: posts are pixel centres (raster type "area")."""
    m = raster
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

    def add_short(key: int, value: int) -> None:
        keys.append((key, 0, 1, value))

    def add_double(key: int, value: float) -> None:
        keys.append((key, DOUBLES_TAG, 1, len(doubles)))
        doubles.append(float(value))

    degrees = p.kind == EQUIRECTANGULAR and p.scale_y != 1.0  # latitude and longitude themselves
    add_short(1024, 2 if degrees else 1)
    add_short(1025, 1)
    add_short(2048, USER_DEFINED)
    keys.append((2049, ASCII_TAG, len(text), 0))
    add_short(2050, USER_DEFINED)
    add_short(2054, DEGREE)
    add_short(2056, USER_DEFINED)
    add_double(2057, p.radius_m)
    add_double(2058, p.radius_m)
    if degrees:
        return keys, doubles, text
    add_short(3072, USER_DEFINED)
    add_short(3074, USER_DEFINED)
    add_short(3075, {STEREOGRAPHIC: 14, ORTHOGRAPHIC: 21, EQUIRECTANGULAR: 17}[p.kind])
    add_short(3076, METRE)
    latitude, longitude = np.degrees(p.latitude_rad), np.degrees(p.longitude_rad)
    polar = p.kind == STEREOGRAPHIC and abs(latitude) == 90.0
    if polar:
        keys[[key[0] for key in keys].index(3075)] = (3075, 0, 1, 15)
        add_double(3081, latitude)
        add_double(3095, longitude)
        add_double(3092, p.scale)
    elif p.kind == EQUIRECTANGULAR:
        add_double(3078, np.degrees(np.arccos(p.scale)))
        add_double(3088, longitude)
        add_double(3089, 0.0)
    else:
        add_double(3088, longitude)
        add_double(3089, latitude)
        add_double(3092, p.scale)
    add_double(3082, p.false_x_m)
    add_double(3083, p.false_y_m)
    return keys, doubles, text
