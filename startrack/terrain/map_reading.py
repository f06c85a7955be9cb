"""Height maps from files: GeoTIFF by its own tags, everything else (COG, PDS, JPEG 2000 ...) through rasterio."""

from __future__ import annotations

import logging
import os
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from startrack.core.files import MAX_CAUSE_CHARS, TIFF_COMPRESSIONS
from startrack.core.types import MAX_PIXELS, BadInput
from startrack.frames import MOON_RADIUS_M
from startrack.terrain.map_writing import METRE, PROJECTION_CODES
from startrack.terrain.raster import EQUIRECTANGULAR, ORTHOGRAPHIC, STEREOGRAPHIC, Raster, projection_of
from startrack.terrain.shape import MAX_LENGTH_M

WINDOW_HALF_M = 300_000.0  # about the origin; farther away even 10 km mountains are below the horizontal
METRES = {"m", "meter", "meters", "metre", "metres"}
STEREOGRAPHIC_CODES = (PROJECTION_CODES[STEREOGRAPHIC], 15, 16)  # oblique, and two variants of the polar one


class Stored(NamedTuple):
    """The content of a map file: height = offset + scale x value."""

    values: Raster  # as the file has them
    scale: float | None  # [m]; None where the file does not state it
    offset_m: float
    no_data: float | None


def read_map(
    path: str | Path, *, scale: float | None = None, offset_m: float | None = None,
    near: tuple[float, float] | None = None,
) -> Raster:  # fmt: skip
    """The height map of the file `path`.

    scale and offset_m: height = offset + scale x value, unless the file states them.
    near: latitude and longitude [rad] about which large maps are cut. Raises BadInput bad_terrain for a file that is
    missing or damaged, or that is no height map of the Moon near there.
    """
    path = Path(path)
    if not os.path.isfile(path):  # False also for names that the system cannot take
        raise BadInput("bad_terrain", f"{path}: no such file")
    stored = _read_geotiff(path) if path.suffix.lower() in (".tif", ".tiff") else None
    raster = _heights_of(stored or _read_with_rasterio(path, near), path, scale, offset_m)
    cut = raster if near is None else raster.crop_around(*near, WINDOW_HALF_M)
    if min(cut.heights_m.shape) < 2:
        raise BadInput(
            "bad_terrain", f"{path}: it is not near the origin: give the latitude and longitude of a place on this map"
        )
    return cut


def _heights_of(stored: Stored, path: Path, scale: float | None, offset_m: float | None) -> Raster:
    """The heights [m above the sphere], NaN where the file has none. Raises BadInput bad_terrain."""
    raster, values = stored.values, stored.values.heights_m
    if values.ndim != 2 or min(values.shape) < 2:
        raise BadInput(
            "bad_terrain",
            f"{path}: too small for a height map, or not near the origin: give the place on it",
        )
    if values.dtype.kind not in "iuf":
        raise BadInput("bad_terrain", f"{path}: values of type {values.dtype} are no heights")
    scale = stored.scale if scale is None else scale
    offset = stored.offset_m if offset_m is None else offset_m
    if scale is None and np.issubdtype(values.dtype, np.integer):
        raise BadInput(
            "bad_terrain",
            f"{path}: it holds whole numbers and no scale: give the metres of one unit (1 where they are "
            "metres), with --scale of terrain import or as scale in [dem]",
        )
    scale = 1.0 if scale is None else scale
    numbers = (raster.x0_m, raster.y0_m, raster.dx_m, raster.dy_m, scale, offset)
    if not np.isfinite(numbers).all() or 0.0 in numbers[2:4] or max(map(abs, numbers)) > 1e12:
        raise BadInput(
            "bad_terrain", f"{path}: its position, its scale or its offset is not a usable number: {numbers}"
        )
    with np.errstate(over="ignore", invalid="ignore"):
        heights = values.astype(np.float64) * scale + offset
    missing = ~(np.abs(heights) < MAX_LENGTH_M)  # NaN too; larger values are marks
    if stored.no_data is not None:
        missing |= values == stored.no_data
    if missing.all():
        raise BadInput("bad_terrain", f"{path}: no post has a height")
    if np.median(heights[~missing]) > MOON_RADIUS_M / 2:  # counted from the Moon's centre
        heights -= MOON_RADIUS_M
    heights[missing] = np.nan
    return replace(raster, heights_m=heights.astype(np.float32), source=path.name)


@contextmanager
def _one_line_refusal(what: str) -> Iterator[None]:
    """Errors of a decoder as BadInput bad_terrain: damaged files make decoders raise errors of nearly any class."""
    log = logging.getLogger("tifffile")
    log.disabled = True  # the exception has the cause
    try:
        yield
    except BadInput:
        raise
    except Exception as cause:
        text = " ".join(str(cause).split())[:MAX_CAUSE_CHARS] or type(cause).__name__
        raise BadInput("bad_terrain", f"{what}: {text}") from cause
    finally:
        log.disabled = False


def _read_geotiff(path: Path) -> Stored | None:
    """The content of a GeoTIFF, or None where its place, size, projection or compression is one for rasterio.

    Raises BadInput bad_terrain for a file that cannot be decoded.
    """
    import tifffile

    refusal = _one_line_refusal(f"{path}: not a TIFF file that can be read")
    with refusal, tifffile.TiffFile(path) as file:
        page = file.pages.first
        keys = file.geotiff_metadata
        if not keys:
            raise BadInput("bad_terrain", f"{path}: it has no position on the Moon (no GeoTIFF tags)")
        if not isinstance(keys, dict) or "ModelPixelScale" not in keys or "ModelTiepoint" not in keys:
            return None
        parameters = _proj_parameters(keys)
        decoded = page.compression in TIFF_COMPRESSIONS and page.size <= MAX_PIXELS and len(page.shape) == 2
        if parameters is None or not decoded:
            return None
        scale, offset = _gdal_scale(page.tags.valueof("GDAL_METADATA"))
        no_data = page.tags.valueof("GDAL_NODATA")
        dx, dy = float(keys["ModelPixelScale"][0]), -float(keys["ModelPixelScale"][1])
        i, j, _, x, y, _ = (float(v) for v in keys["ModelTiepoint"][:6])
        middle = 0.0 if int(keys.get("GTRasterTypeGeoKey", 1)) == 2 else 0.5  # 2: the tie point is a post
        raster = Raster(
            heights_m=np.asarray(page.asarray()), projection=projection_of(parameters),
            x0_m=x + (middle - i) * dx, y0_m=y + (middle - j) * dy, dx_m=dx, dy_m=dy,
        )  # fmt: skip
        return Stored(raster, scale, offset, None if no_data is None else float(str(no_data).strip("\x00 ")))


def _gdal_scale(items: Any) -> tuple[float | None, float]:
    """SCALE and OFFSET of GDAL's metadata: None where the step is not known, and 0."""
    found = {}
    if isinstance(items, str):
        found = {str(e.get("name")).upper(): e.text or "" for e in ElementTree.fromstring(items).iter("Item")}
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
    if "ProjLinearUnitsGeoKey" in keys and int(keys["ProjLinearUnitsGeoKey"]) != METRE:
        return None
    code = int(keys.get("ProjCoordTransGeoKey", 0))
    p["lon_0"] = number("ProjStraightVertPoleLongGeoKey", "ProjCenterLongGeoKey", "ProjNatOriginLongGeoKey")
    p["lat_0"] = number("ProjCenterLatGeoKey", "ProjNatOriginLatGeoKey")
    if code in STEREOGRAPHIC_CODES:
        p["k_0"] = number("ProjScaleAtNatOriginGeoKey", default=1.0)
        if code == 15 and abs(p["lat_0"]) < 90:  # the variant that names the latitude of true scale
            p["lat_ts"], p["lat_0"] = p["lat_0"], 90.0 if p["lat_0"] > 0 else -90.0
        return {**p, "proj": "stere"}
    if code == PROJECTION_CODES[ORTHOGRAPHIC]:
        return {**p, "proj": "ortho"}
    if code == PROJECTION_CODES[EQUIRECTANGULAR]:
        return {**p, "proj": "eqc", "lat_ts": number("ProjStdParallel1GeoKey")}
    return None


def _read_with_rasterio(path: Path, near: tuple[float, float] | None) -> Stored:
    """The content, cut to a window about `near`. Raises BadInput bad_terrain."""
    hint = f" (of a PDS map give the label, {path.stem}.LBL)" if path.suffix.lower() == ".img" else ""
    if find_spec("rasterio") is None or find_spec("pyproj") is None:
        raise BadInput(
            "bad_terrain",
            f"{path}: not a GeoTIFF on the Moon in a known projection and compression; other maps need "
            "rasterio and pyproj: pip install '.[dem]' in a clone of startrack",
        )
    import rasterio

    with _one_line_refusal(f"{path}: not a map that can be read{hint}"), warnings.catch_warnings():
        # About files without a position, which have their own message, and about terms that PROJ lacks beside WKT.
        warnings.simplefilter("ignore")
        with rasterio.open(path) as file:
            return _content_of(file, path, near, hint)


def _content_of(file: Any, path: Path, near: tuple[float, float] | None, hint: str) -> Stored:
    """The content of an open rasterio file."""
    import pyproj
    from rasterio.windows import Window

    if file.crs is None or file.transform.is_identity:
        raise BadInput("bad_terrain", f"{path}: it has no position on the Moon{hint}")
    t = file.transform
    if t.b or t.d:
        raise BadInput("bad_terrain", f"{path}: a rotated grid; bring it to north up (gdalwarp)")
    projection = projection_of(pyproj.CRS.from_wkt(file.crs.to_wkt()).to_dict())
    raster = Raster(
        heights_m=np.broadcast_to(np.float32(0), (file.height, file.width)), projection=projection,
        x0_m=t.c + 0.5 * t.a, y0_m=t.f + 0.5 * t.e, dx_m=float(t.a), dy_m=float(t.e),
    )  # fmt: skip
    rows, columns = slice(0, file.height), slice(0, file.width)
    if near is not None:
        rows, columns = raster.window(*near, WINDOW_HALF_M)
    shape = rows.stop - rows.start, columns.stop - columns.start
    if shape[0] * shape[1] > MAX_PIXELS:
        raise BadInput("bad_terrain", f"{path}: too large; cut it to the area (startrack terrain import --half)")
    values = file.read(1, window=Window(columns.start, rows.start, shape[1], shape[0]))
    scale, offset = file.scales[0], file.offsets[0]
    stated = (scale, offset) != (1.0, 0.0) or str(file.units[0]).lower() in METRES
    x0_m, y0_m = raster.x0_m + columns.start * t.a, raster.y0_m + rows.start * t.e
    raster = replace(raster, heights_m=values, x0_m=x0_m, y0_m=y0_m)
    return Stored(raster, float(scale) if stated else None, float(offset), file.nodata)
