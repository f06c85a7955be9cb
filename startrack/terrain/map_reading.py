"""Height maps from files: GeoTIFF and SRTM decoded here, everything else (PDS, USGS DEM ...) through rasterio."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from startrack.core.errors import how_to_install
from startrack.core.types import MAX_PIXELS, BadInput
from startrack.frames import MOON_RADIUS_M
from startrack.terrain.earth_projection import FOOT_M, EarthProjection, is_earth, project_earth
from startrack.terrain.map_formats import UNITS_M, Stored, one_line_refusal, read_geotiff, read_hgt
from startrack.terrain.raster import MAX_NUMBER, Projection, Raster, projection_of
from startrack.terrain.shape import MAX_LENGTH_M

# Half the side of what is read about the origin. On the Moon 10 km mountains are below the horizontal farther away. On
# the Earth the highest stand 2.8 degrees high at most farther away, where the air leaves few stars.
WINDOW_HALF_M = {"moon": 300_000.0, "earth": 150_000.0}
LOWEST_M, HIGHEST_ABOVE_SEA_M = -11_050.0, 9_000.0  # of the Earth: the deepest sea and the highest mountain, and 100 m
MAX_BLOCK_POSTS = 50_000_000  # 200 MB of floating point, for any window
# GDAL's readers of heights in one file, or in a file that it names; mosaics and map services name any address.
DRIVERS = (
    "GTiff", "PDS", "PDS4", "ISIS2", "ISIS3", "VICAR", "USGSDEM", "SRTMHGT", "DTED", "SDTS", "HFA", "NITF", "JPEG",
    "PNG", "JP2OpenJPEG", "netCDF", "HDF5", "HDF5Image", "GRIB", "BAG", "GPKG", "AAIGrid", "GRASSASCIIGrid", "AIG",
    "GSAG", "GSBG", "GS7BG", "XYZ", "ENVI", "EHdr", "ERS", "GenBin", "RRASTER", "SAGA", "RST", "ILWIS", "PCIDSK",
    "PCRaster", "BT", "GXF", "HF2", "NWT_GRD", "SIGDEM", "Terragen", "ZMap", "ACE2", "ROI_PAC", "ISCE",
)  # fmt: skip
WITHOUT_NETWORK = {
    "CPL_VSIL_CURL_ALLOWED_FILENAME": "none",
    "GDAL_HTTP_PROXY": "0.0.0.0:0",
}  # for a label that names one
HEIGHT_NAMES = "altitude", "dem", "elevation", "height", "topo", "z"  # of the grid of heights among others of a file


def read_map(
    path: str | Path, *, scale: float | None = None, offset_m: float | None = None,
    near: tuple[float, float] | None = None, body: str | None = None,
) -> Raster:  # fmt: skip
    """The height map of the file `path`.

    scale and offset_m: height = offset + scale x value, unless the file states them.
    near: latitude and longitude [rad] about which large maps are cut. body: that it must be of, "moon" or "earth".
    Raises BadInput bad_terrain for a file that is missing or damaged, or that is no height map of this body near there.
    """
    path = Path(path)
    if not os.path.isfile(path):  # False also for names that the system cannot take
        raise BadInput("bad_terrain", f"{path}: no such file")
    reader = READERS.get(path.suffix.lower(), lambda _: None)
    stored = reader(path) or _read_with_rasterio(path, near)
    found = stored.values.projection.body
    if body is not None and found != body:
        raise BadInput(
            "bad_terrain", f"{path}: it is a map of the {found.title()}, and the terrain's body is the {body.title()}"
        )
    raster = _heights_of(stored, path, scale, offset_m)
    cut = raster if near is None else raster.crop_around(*near, WINDOW_HALF_M[found])
    if min(cut.heights_m.shape) < 2:
        raise _not_on(str(path), raster)
    return cut


def require_origin(maps: Sequence[Raster], latitude_rad: float, longitude_rad: float) -> None:
    """Raise BadInput bad_terrain, with the place of the first map, where none of the `maps` holds a place."""
    for one in maps:
        at = one.row_column(np.array(latitude_rad), np.array(longitude_rad))
        if np.all((at >= 0) & (at <= np.array(one.heights_m.shape) - 1)):
            return
    raise _not_on(maps[0].source, maps[0])


def _not_on(name: str, whole: Raster) -> BadInput:
    """The refusal of an origin that is not on the `whole` map called `name`: where it lies, and how large it is."""
    posts = np.array(whole.heights_m.shape)
    latitude, longitude = np.degrees(whole.projection.latlon_from_xy(*whole.xy(0.5 * (posts - 1))))
    height_km, width_km = posts * whole.spacings_m / 1000
    return BadInput(
        "bad_terrain",
        f"{name}: the origin is not on this map: its middle is at latitude {latitude:.2f}, longitude {longitude:.2f}, "
        f"and it is about {width_km:.3g} km x {height_km:.3g} km large; give the latitude and longitude of a place on "
        "it (north and east positive)",
    )


def _heights_of(stored: Stored, path: Path, scale: float | None, offset_m: float | None) -> Raster:
    """The heights [m above the sphere], NaN where the file has none. Raises BadInput bad_terrain."""
    raster, values = stored.values, stored.values.heights_m
    if values.ndim != 2 or min(values.shape) < 2:
        raise BadInput(
            "bad_terrain",
            f"{path}: too small for a height map: {' x '.join(map(str, values.shape))} posts; give a larger one",
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
    if not np.isfinite(numbers).all() or 0.0 in numbers[2:4] or max(map(abs, numbers)) > MAX_NUMBER:
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
    if raster.projection.body == "earth":
        _check_range(path, float(heights[~missing].min()), float(heights[~missing].max()))
    elif np.median(heights[~missing]) > MOON_RADIUS_M / 2:  # counted from the Moon's centre
        heights -= MOON_RADIUS_M
    heights[missing] = np.nan
    return replace(raster, heights_m=heights.astype(np.float32), source=path.name)


def _check_range(path: Path, lowest_m: float, highest_m: float) -> None:
    """Raise BadInput bad_terrain for heights that no ground of the Earth has."""
    if lowest_m >= LOWEST_M and highest_m <= HIGHEST_ABOVE_SEA_M:
        return
    fits = lowest_m * FOOT_M >= LOWEST_M and highest_m * FOOT_M <= HIGHEST_ABOVE_SEA_M
    cause = (
        f"are they feet? Then state --scale {FOOT_M} of terrain import, or scale = {FOOT_M} in [dem]"
        if fits
        else "is a value for voids unstated, or the unit another?"
    )
    raise BadInput(
        "bad_terrain",
        f"{path}: heights from {lowest_m:.0f} to {highest_m:.0f} m are not of the Earth's ground: {cause}",
    )


def _read_with_rasterio(path: Path, near: tuple[float, float] | None) -> Stored:
    """The content, cut to a window about `near`. Raises BadInput bad_terrain."""
    hints = {
        ".img": f" (of a PDS map give the label, {path.stem}.LBL)",
        ".vrt": ": a mosaic names other files; make one file of it (gdal_translate)",
    }
    hint = hints.get(path.suffix.lower(), "")
    if find_spec("rasterio") is None or find_spec("pyproj") is None:
        raise BadInput(
            "bad_terrain",
            f"{path}: not a GeoTIFF on the Moon in a known projection, or in longitude and latitude of WGS 84, with a "
            f"known compression; other maps need rasterio and pyproj: {how_to_install('dem')}",
        )
    import rasterio
    from rasterio.io import DatasetReader  # in place of rasterio.open, which takes one driver

    refusal = one_line_refusal(f"{path}: not a map that can be read{hint}")
    with refusal, rasterio.Env(**WITHOUT_NETWORK), warnings.catch_warnings():
        # About files without a position, which have their own message, and about terms that PROJ lacks beside WKT.
        warnings.simplefilter("ignore")
        with DatasetReader(os.fspath(path), driver=DRIVERS) as file:
            parts = file.subdatasets if file.crs is None else []
            if not parts:
                return _content_of(file, path, near, hint)
        with DatasetReader(_heights_among(parts, path), driver=DRIVERS) as file:
            return _content_of(file, path, near, hint)


def _heights_among(parts: Sequence[str], path: Path) -> str:
    """The part of a file of several grids that is named as heights are. Raises BadInput bad_terrain."""
    named = [part for part in parts if part.rpartition(":")[2].strip("/").lower() in HEIGHT_NAMES]
    if len(named) == 1:
        return named[0]
    names = ", ".join(part.rpartition(":")[2] for part in parts)
    raise BadInput("bad_terrain", f"{path}: which of its grids has the heights? It has {names}; cut out one (gdalwarp)")


def _content_of(file: Any, path: Path, near: tuple[float, float] | None, hint: str) -> Stored:
    """The content of an open rasterio file."""
    import pyproj
    from rasterio.windows import Window

    if file.crs is None or file.transform.is_identity:
        raise BadInput(
            "bad_terrain",
            f"{path}: it has no position on a body{hint or ': add its projection (gdal_translate -a_srs)'}",
        )
    t = file.transform
    if t.b or t.d:
        raise BadInput("bad_terrain", f"{path}: a rotated grid; bring it to north up (gdalwarp)")
    crs = pyproj.CRS.from_wkt(file.crs.to_wkt())
    projection: Projection | EarthProjection
    if crs.ellipsoid is not None and is_earth(crs.ellipsoid.semi_major_metre):
        projection = project_earth(crs, (t.c + 0.5 * t.a * file.width, t.f + 0.5 * t.e * file.height), near)
    else:
        projection = projection_of(crs.to_dict())
    raster = Raster(
        heights_m=np.broadcast_to(np.float32(0), (file.height, file.width)), projection=projection,
        x0_m=t.c + 0.5 * t.a, y0_m=t.f + 0.5 * t.e, dx_m=float(t.a), dy_m=float(t.e),
    )  # fmt: skip
    rows, columns = slice(0, file.height), slice(0, file.width)
    if near is not None:
        rows, columns = raster.window(*near, WINDOW_HALF_M[projection.body])
    shape = rows.stop - rows.start, columns.stop - columns.start
    if min(file.height, file.width) >= 2 > min(shape):
        raise _not_on(str(path), raster)
    if shape[0] * shape[1] > MAX_PIXELS:
        raise BadInput("bad_terrain", f"{path}: too large; cut it to the area (startrack terrain import --half)")
    if math.prod(file.block_shapes[0]) > MAX_BLOCK_POSTS:  # of which a window is a part
        raise BadInput("bad_terrain", f"{path}: stored in one piece; write it in tiles (gdal_translate -co TILED=YES)")
    values = file.read(1, window=Window(columns.start, rows.start, shape[1], shape[0]))
    scale, offset = file.scales[0], file.offsets[0]
    unit = UNITS_M.get(str(file.units[0]).lower())
    stated = (scale, offset) != (1.0, 0.0) or unit is not None
    x0_m, y0_m = raster.x0_m + columns.start * t.a, raster.y0_m + rows.start * t.e
    raster = replace(raster, heights_m=values, x0_m=x0_m, y0_m=y0_m)
    scale, offset = float(scale) * (unit or 1.0), float(offset) * (unit or 1.0)
    return Stored(raster, scale if stated else None, offset, file.nodata)


READERS = {".tif": read_geotiff, ".tiff": read_geotiff, ".hgt": read_hgt}  # by suffix: without rasterio
