"""Height maps decoded without rasterio: GeoTIFF by its own tags, and tiles of SRTM."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from startrack.core.files import MAX_CAUSE_CHARS, MAX_TEXT_BYTES
from startrack.core.tiff_strips import TIFF_COMPRESSIONS, check_packed_strips
from startrack.core.types import MAX_PIXELS, BadInput
from startrack.terrain.earth_projection import FOOT_M, WGS84_CODE, EarthProjection, is_earth
from startrack.terrain.map_writing import DEGREE, METRE, PROJECTION_CODES
from startrack.terrain.raster import EQUIRECTANGULAR, ORTHOGRAPHIC, STEREOGRAPHIC, Projection, Raster, projection_of

SURVEY_FOOT_M = 1200 / 3937
UNITS_M = dict.fromkeys(("m", "meter", "meters", "metre", "metres"), 1.0)
UNITS_M |= dict.fromkeys(("ft", "foot", "feet", "international foot"), FOOT_M)
UNITS_M |= dict.fromkeys(("us-ft", "us survey foot", "us_survey_foot", "foot_us"), SURVEY_FOOT_M)
UNIT_CODES_M = {METRE: 1.0, 9002: FOOT_M, 9003: SURVEY_FOOT_M}  # of GeoTIFF's VerticalUnitsGeoKey
HGT_VOID = -32_768.0
WGS84_CODES = WGS84_CODE, 4979  # with and without heights
FLOATING_POINT = 3  # a predictor of TIFF that tifffile decodes with other packages only
STEREOGRAPHIC_CODES = (PROJECTION_CODES[STEREOGRAPHIC], 15, 16)  # oblique, and two variants of the polar one


class Stored(NamedTuple):
    """The content of a map file: height = offset + scale x value."""

    values: Raster  # as the file has them
    scale: float | None  # [m]; None where the file does not state it
    offset_m: float
    no_data: float | None


@contextmanager
def one_line_refusal(what: str) -> Iterator[None]:
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


def is_geotiff(path: Path) -> bool:
    """Whether the file `path` is a TIFF whose first directory has the tag of a map's keys (34735)."""
    import tifffile

    with suppress(BadInput), one_line_refusal(str(path)), tifffile.TiffFile(path) as file:
        return bool(file.pages.first.is_geotiff)
    return False


def read_geotiff(path: Path) -> Stored | None:
    """The content of a GeoTIFF, or None where its place, size, projection or compression is one for rasterio.

    Raises BadInput bad_terrain for a file that cannot be decoded.
    """
    import tifffile

    refusal = one_line_refusal(f"{path}: not a TIFF file that can be read")
    with refusal, tifffile.TiffFile(path) as file:
        page = file.pages.first
        keys = file.geotiff_metadata
        if not keys:
            raise BadInput("bad_terrain", f"{path}: it has no position on a body (no GeoTIFF tags)")
        if not isinstance(keys, dict) or "ModelPixelScale" not in keys or "ModelTiepoint" not in keys:
            return None
        i, j, _, x, y, _ = (float(v) for v in keys["ModelTiepoint"][:6])
        projection = _projection_of_keys(keys, x)
        decoded = page.compression in TIFF_COMPRESSIONS and page.size <= MAX_PIXELS and len(page.shape) == 2
        if projection is None or not decoded or page.predictor == FLOATING_POINT:
            return None
        check_packed_strips(page, file.filehandle)
        scale, offset = _gdal_scale(page.tags.valueof("GDAL_METADATA"))
        if "VerticalUnitsGeoKey" in keys and scale is None:
            scale = UNIT_CODES_M.get(int(keys["VerticalUnitsGeoKey"]))
        no_data = page.tags.valueof("GDAL_NODATA")
        dx, dy = float(keys["ModelPixelScale"][0]), -float(keys["ModelPixelScale"][1])
        middle = 0.0 if int(keys.get("GTRasterTypeGeoKey", 1)) == 2 else 0.5  # 2: the tie point is a post
        raster = Raster(
            heights_m=np.asarray(page.asarray()), projection=projection,
            x0_m=x + (middle - i) * dx, y0_m=y + (middle - j) * dy, dx_m=dx, dy_m=dy,
        )  # fmt: skip
        return Stored(raster, scale, offset, None if no_data is None else float(str(no_data).strip("\x00 ")))


def _gdal_scale(items: Any) -> tuple[float | None, float]:
    """SCALE and OFFSET of GDAL's metadata: None where the step is not known, and 0. Raises ValueError."""
    found = {}
    if isinstance(items, str):
        if len(items) > MAX_TEXT_BYTES:  # entities make much more of it
            raise ValueError(f"GDAL_METADATA of {len(items)} characters")
        found = {str(e.get("name")).upper(): e.text or "" for e in ElementTree.fromstring(items).iter("Item")}
    metres = UNITS_M.get(str(found.get("UNITTYPE", "")).lower())
    return (float(found["SCALE"]) if "SCALE" in found else metres), float(found.get("OFFSET", 0.0))


def read_hgt(path: Path) -> Stored | None:
    """The content of a tile of SRTM, whose name states its place; None for another size or name.

    Metres as whole numbers of 16 bits, the most significant byte first, by rows from the north; the outer posts are on
    the lines of whole degrees.
    """
    name = re.match(r"([NS])(\d\d)([EW])(\d\d\d)", path.name.upper())
    across = math.isqrt(path.stat().st_size // 2)
    if name is None or path.stat().st_size != 2 * across * across or across < 2:
        return None
    south, west = (int(name[k + 1]) * (1 if name[k] in "NE" else -1) for k in (1, 3))
    step = 1.0 / (across - 1)
    values: np.ndarray = np.fromfile(path, dtype=">i2").astype(np.int16).reshape(across, across)
    raster = Raster(
        heights_m=values, x0_m=float(west),
        y0_m=float(south + 1), dx_m=step, dy_m=-step, projection=EarthProjection(middle_x=west + 0.5),
    )  # fmt: skip
    return Stored(raster, 1.0, 0.0, HGT_VOID)


def _projection_of_keys(keys: Mapping[str, Any], middle_x: float) -> Projection | EarthProjection | None:
    """The projection that GeoTIFF keys state; None for those that only rasterio reads."""
    is_geographic = int(keys.get("GTModelTypeGeoKey", 0)) == 2
    in_degrees = int(keys.get("GeogAngularUnitsGeoKey", DEGREE)) == DEGREE
    if is_geographic and in_degrees and int(keys.get("GeographicTypeGeoKey", 0)) in WGS84_CODES:
        return EarthProjection(middle_x=middle_x)
    parameters = _proj_parameters(keys)
    if parameters is None or is_earth(parameters["a"]):
        return None
    return projection_of(parameters)


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
