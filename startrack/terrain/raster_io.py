"""Height maps from files: GeoTIFF by its own tags, everything else (COG, PDS, JPEG 2000 ...) through rasterio."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from startrack.frames import MOON_RADIUS_M
from startrack.terrain.projection import EQUIRECTANGULAR, ORTHOGRAPHIC, STEREOGRAPHIC, Projection
from startrack.terrain.raster import Raster
from startrack.types import Array, BadInput

MOST_PIXELS = 200_000_000
METRES = {"m", "meter", "meters", "metre", "metres"}
HALF_WINDOW_M = 300_000.0  # so far from the origin ground can matter: a 10 km mountain is at the horizontal
RADIUS_LIKE_M = 1_000_000.0  # heights like this are counted from the Moon's centre
STEREOGRAPHIC_CODES, ORTHOGRAPHIC_CODE, EQUIRECTANGULAR_CODE = (14, 15, 16), 21, 17  # GeoTIFF 1.1, annex


def read_map(
    path: str | Path, *, scale: float | None = None, offset_m: float | None = None,
    near: tuple[float, float] | None = None,
) -> Raster:  # fmt: skip
    """The height map of a file. scale and offset: height = offset + scale x value, where the file does not say.

    near: latitude and longitude [rad] about which large maps are cut. Raises BadInput bad_terrain.
    """
    path = Path(path)
    if not path.is_file():
        raise BadInput("bad_terrain", f"{path}: no such file")
    found = _by_its_tags(path) if path.suffix.lower() in (".tif", ".tiff") else None
    if found is None:
        found = _by_rasterio(path, near)
    values, projection, first, step, own_scale, own_offset, nodata = found
    if min(values.shape) < 2:
        raise BadInput("bad_terrain", f"{path}: too small for a height map, or not near the origin")
    scale = own_scale if scale is None else scale
    if scale is None and np.issubdtype(values.dtype, np.integer):
        raise BadInput(
            "bad_terrain",
            f"{path}: it holds whole numbers and no scale: say how many metres one of them is (1 where they are "
            "metres), with --scale of terrain import or as scale in [dem]",
        )
    heights = values.astype(np.float64) * (1.0 if scale is None else scale)
    heights += own_offset if offset_m is None else offset_m
    missing = ~np.isfinite(heights)
    if nodata is not None:
        missing |= values == nodata
    if np.nanmedian(np.where(missing, np.nan, heights)) > RADIUS_LIKE_M:
        heights -= MOON_RADIUS_M
    heights[missing] = np.nan
    found_map = Raster(
        heights_m=heights.astype(np.float32), projection=projection, x0_m=first[0], y0_m=first[1], dx_m=step[0],
        dy_m=step[1], source=path.name,
    )  # fmt: skip
    cut = found_map if near is None else found_map.around(*near, HALF_WINDOW_M)
    if min(cut.heights_m.shape) < 2:
        raise BadInput("bad_terrain", f"{path}: it is not near the origin")
    return cut


def projection_of(p: Mapping[str, Any]) -> Projection:
    """The projection of PROJ's parameters. Raises BadInput bad_terrain for one that is not known here."""
    radius = float(p.get("R", p.get("a", MOON_RADIUS_M)))
    if "a" in p and "b" in p and abs(float(p["a"]) - float(p["b"])) > 1:
        raise BadInput("bad_terrain", "the map is on an ellipsoid, not on the Moon's 1737.4 km sphere")
    if str(p.get("ellps", p.get("datum", ""))).upper() in ("WGS84", "GRS80"):
        raise BadInput("bad_terrain", "the map is of the Earth, not of the Moon")
    common = {
        "longitude_rad": float(np.radians(float(p.get("lon_0", 0.0)))), "radius_m": radius,
        "false_x_m": float(p.get("x_0", 0.0)), "false_y_m": float(p.get("y_0", 0.0)),
    }  # fmt: skip
    name, lat_0 = p.get("proj"), float(p.get("lat_0", 0.0))
    if name == "stere":
        scale = float(p.get("k_0", p.get("k", 1.0)))
        if "lat_ts" in p:
            scale = (1 + np.sin(np.radians(abs(float(p["lat_ts"]))))) / 2
        return Projection(kind=STEREOGRAPHIC, latitude_rad=float(np.radians(lat_0)), scale=float(scale), **common)
    if name == "ortho":
        return Projection(kind=ORTHOGRAPHIC, latitude_rad=float(np.radians(lat_0)), **common)
    if name == "eqc":
        scale = float(np.cos(np.radians(float(p.get("lat_ts", 0.0)))))
        common["false_y_m"] -= radius * float(np.radians(lat_0))
        return Projection(kind=EQUIRECTANGULAR, scale=scale, **common)
    if name == "longlat":
        degrees = float(180 / np.pi / radius)
        return Projection(kind=EQUIRECTANGULAR, scale=degrees, scale_y=degrees, **common)
    raise BadInput(
        "bad_terrain",
        f"projection {name!r} is not known: bring the map to polar stereographic, stereographic, orthographic or "
        "equirectangular (gdalwarp -r bilinear -t_srs ...)",
    )


# Values, projection, first post, step, scale (None where the file does not say), offset, no-data value.
Found = tuple[Array, Projection, tuple[float, float], tuple[float, float], float | None, float, float | None]


def _by_its_tags(path: Path) -> Found | None:
    """What a GeoTIFF's own tags say; None where they are of a kind for rasterio."""
    import tifffile

    try:
        with tifffile.TiffFile(path) as file:
            page = file.pages.first
            keys, gdal = file.geotiff_metadata, file.gdal_metadata
            if not isinstance(keys, dict) or "ModelPixelScale" not in keys or "ModelTiepoint" not in keys:
                if find_spec("rasterio") is None or not keys:
                    raise BadInput(
                        "bad_terrain", f"{path}: it does not say where on the Moon it lies (no GeoTIFF tags)"
                    )
                return None
            if page.size > MOST_PIXELS or len(page.shape) != 2:
                return None
            nodata = page.tags.get(42113)
            values = np.asarray(page.asarray())
            scale, offset = _gdal_scale(gdal)
    except (tifffile.TiffFileError, ValueError, KeyError, IndexError, OSError) as cause:
        raise BadInput("bad_terrain", f"{path}: not a TIFF file that can be read: {cause}") from cause
    parameters = _proj_of_keys(keys)
    if parameters is None:
        return None
    dx, dy = float(keys["ModelPixelScale"][0]), -float(keys["ModelPixelScale"][1])
    i, j, _, x, y, _ = (float(v) for v in keys["ModelTiepoint"][:6])
    middle = 0.0 if int(keys.get("GTRasterTypeGeoKey", 1)) == 2 else 0.5  # 2: the tie point is a post
    first = x + (middle - i) * dx, y + (middle - j) * dy
    missing = float(str(nodata.value).strip("\x00 ")) if nodata is not None else None
    return values, projection_of(parameters), first, (dx, dy), scale, offset, missing


def _gdal_scale(items: Any) -> tuple[float | None, float]:
    """SCALE and OFFSET of GDAL's metadata: None where nothing says what one step is, and 0."""
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


def _proj_of_keys(keys: Mapping[str, Any]) -> dict[str, Any] | None:
    """PROJ's parameters of GeoTIFF keys; None for what only rasterio knows."""

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


def _by_rasterio(path: Path, near: tuple[float, float] | None) -> Found:
    if find_spec("rasterio") is None or find_spec("pyproj") is None:
        raise BadInput(
            "bad_terrain",
            f"{path}: such a map needs rasterio and pyproj: pip install '.[dem]' in a clone of startrack",
        )
    import pyproj
    import rasterio
    from rasterio.windows import Window

    hint = _label_hint(path)
    try:
        with _opened(rasterio, path) as file, warnings.catch_warnings():
            # That PROJ's words hold less than WKT: enough for spheres.
            warnings.simplefilter("ignore", UserWarning)
            if file.crs is None or file.transform.is_identity:
                raise BadInput("bad_terrain", f"{path}: it does not say where on the Moon it lies{hint}")
            t = file.transform
            if t.b or t.d:
                raise BadInput("bad_terrain", f"{path}: a rotated grid; bring it to north up (gdalwarp)")
            projection = projection_of(pyproj.CRS.from_wkt(file.crs.to_wkt()).to_dict())
            first = t.c + 0.5 * t.a, t.f + 0.5 * t.e
            rows, columns = slice(0, file.height), slice(0, file.width)
            if near is not None:
                row, column = _window(projection, first, (t.a, t.e), (file.height, file.width), near)
                rows, columns = row, column
            if (rows.stop - rows.start) * (columns.stop - columns.start) > MOST_PIXELS:
                raise BadInput(
                    "bad_terrain", f"{path}: too large; cut it to the area (startrack terrain import --half)"
                )
            window = Window(columns.start, rows.start, columns.stop - columns.start, rows.stop - rows.start)
            values = file.read(1, window=window)
            first = first[0] + columns.start * t.a, first[1] + rows.start * t.e
            scale, offset, nodata = file.scales[0], file.offsets[0], file.nodata
            said = (scale, offset) != (1.0, 0.0) or str(file.units[0]).lower() in METRES
    except rasterio.errors.RasterioIOError as cause:
        raise BadInput("bad_terrain", f"{path}: not a map that can be read{hint}: {cause}") from cause
    return values, projection, first, (float(t.a), float(t.e)), float(scale) if said else None, float(offset), nodata


def _opened(rasterio: Any, path: Path) -> Any:
    """The file, without a word on stderr where it has no place: that is said in our own."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        return rasterio.open(path)


def _label_hint(path: Path) -> str:
    """What to do where a PDS map's bare pixels are given instead of the label that says what they are."""
    return f" (of a PDS map give the label, {path.stem}.LBL)" if path.suffix.lower() == ".img" else ""


def _window(
    projection: Projection, first: tuple[float, float], step: tuple[float, float], shape: tuple[int, int],
    near: tuple[float, float],
) -> tuple[slice, slice]:  # fmt: skip
    """Rows and columns within reach of a place, without the map being read."""
    probe = Raster(
        heights_m=np.broadcast_to(np.float32(0), shape), projection=projection, x0_m=first[0], y0_m=first[1],
        dx_m=step[0], dy_m=step[1],
    )  # fmt: skip
    return probe.window(*near, HALF_WINDOW_M)
