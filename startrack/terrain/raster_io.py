"""Height maps from files: GeoTIFF by its own tags, everything else (COG, PDS, JPEG 2000 ...) through rasterio."""

from __future__ import annotations

import warnings
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from startrack.core.types import BadInput
from startrack.frames import MOON_RADIUS_M
from startrack.terrain.geotiff import MAX_PIXELS, METRES, read_geotiff
from startrack.terrain.raster import Grid, Projection, Raster, projection_of

WINDOW_HALF_M = 300_000.0  # about the origin; farther away even 10 km mountains are below the horizontal
MIN_RADIUS_M = 1_000_000.0  # larger heights are counted from the Moon's centre
MAX_HEIGHT_M = 1e7  # larger values are marks of missing heights


def read_map(
    path: str | Path, *, scale: float | None = None, offset_m: float | None = None,
    near: tuple[float, float] | None = None,
) -> Raster:  # fmt: skip
    """The height map of a file. scale and offset_m: height = offset + scale x value, unless the file states them.

    near: latitude and longitude [rad] about which large maps are cut. Raises BadInput bad_terrain for a file that is
    missing or damaged, or that is no height map of the Moon near there.
    """
    path = Path(path)
    if not _is_file(path):
        raise BadInput("bad_terrain", f"{path}: no such file")
    grid = read_geotiff(path) if path.suffix.lower() in (".tif", ".tiff") else None
    if grid is None:
        grid = _read_with_rasterio(path, near)
    raster = _raster_of(grid, path, scale, offset_m)
    cut = raster if near is None else raster.crop_around(*near, WINDOW_HALF_M)
    if min(cut.heights_m.shape) < 2:
        raise BadInput(
            "bad_terrain", f"{path}: it is not near the origin: give the latitude and longitude of a place on this map"
        )
    return cut


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # a name that the system cannot take
        return False


def _raster_of(grid: Grid, path: Path, scale: float | None, offset_m: float | None) -> Raster:
    """The heights [m above the sphere], NaN where the file has none. Raises BadInput bad_terrain."""
    values = grid.values
    if values.ndim != 2 or min(values.shape) < 2:
        raise BadInput(
            "bad_terrain",
            f"{path}: too small for a height map, or not near the origin: give the place on it",
        )
    if values.dtype.kind not in "iuf":
        raise BadInput("bad_terrain", f"{path}: values of type {values.dtype} are no heights")
    scale = grid.scale if scale is None else scale
    offset = grid.offset_m if offset_m is None else offset_m
    if scale is None and np.issubdtype(values.dtype, np.integer):
        raise BadInput(
            "bad_terrain",
            f"{path}: it holds whole numbers and no scale: give the metres of one unit (1 where they are "
            "metres), with --scale of terrain import or as scale in [dem]",
        )
    scale = 1.0 if scale is None else scale
    numbers = (*grid.first_m, *grid.step_m, scale, offset)
    if not np.isfinite(numbers).all() or 0.0 in grid.step_m or max(map(abs, numbers)) > 1e12:
        raise BadInput(
            "bad_terrain", f"{path}: its position, its scale or its offset is not a usable number: {numbers}"
        )
    with np.errstate(over="ignore", invalid="ignore"):
        heights = values.astype(np.float64) * scale + offset
    missing = ~(np.abs(heights) < MAX_HEIGHT_M)  # NaN too
    if grid.no_data is not None:
        missing |= values == grid.no_data
    if missing.all():
        raise BadInput("bad_terrain", f"{path}: no post has a height")
    if np.median(heights[~missing]) > MIN_RADIUS_M:
        heights -= MOON_RADIUS_M
    heights[missing] = np.nan
    return Raster(
        heights_m=heights.astype(np.float32), projection=grid.projection, x0_m=grid.first_m[0], y0_m=grid.first_m[1],
        dx_m=grid.step_m[0], dy_m=grid.step_m[1], source=path.name,
    )  # fmt: skip


def _read_with_rasterio(path: Path, near: tuple[float, float] | None) -> Grid:
    """The grid, cut to a window about `near`. Raises BadInput bad_terrain."""
    hint = f" (of a PDS map give the label, {path.stem}.LBL)" if path.suffix.lower() == ".img" else ""
    if find_spec("rasterio") is None or find_spec("pyproj") is None:
        raise BadInput(
            "bad_terrain",
            f"{path}: not a GeoTIFF on the Moon in a known projection and compression; other maps need "
            "rasterio and pyproj: pip install '.[dem]' in a clone of startrack",
        )
    import rasterio

    try:
        with warnings.catch_warnings():
            # About files without a position, which have their own message, and about terms that PROJ lacks beside WKT.
            warnings.simplefilter("ignore")
            with rasterio.open(path) as file:
                return _grid_of(file, path, near, hint)
    except BadInput:
        raise
    except Exception as cause:  # a damaged file makes the decoders raise errors of nearly any class
        text = " ".join(str(cause).split())[:200] or type(cause).__name__
        raise BadInput("bad_terrain", f"{path}: not a map that can be read{hint}: {text}") from cause


def _grid_of(file: Any, path: Path, near: tuple[float, float] | None, hint: str) -> Grid:
    """The grid of an open rasterio file."""
    import pyproj
    from rasterio.windows import Window

    if file.crs is None or file.transform.is_identity:
        raise BadInput("bad_terrain", f"{path}: it has no position on the Moon{hint}")
    t = file.transform
    if t.b or t.d:
        raise BadInput("bad_terrain", f"{path}: a rotated grid; bring it to north up (gdalwarp)")
    projection = projection_of(pyproj.CRS.from_wkt(file.crs.to_wkt()).to_dict())
    first = t.c + 0.5 * t.a, t.f + 0.5 * t.e
    rows, columns = slice(0, file.height), slice(0, file.width)
    if near is not None:
        rows, columns = _window(projection, first, (t.a, t.e), (file.height, file.width), near)
    shape = rows.stop - rows.start, columns.stop - columns.start
    if shape[0] * shape[1] > MAX_PIXELS:
        raise BadInput("bad_terrain", f"{path}: too large; cut it to the area (startrack terrain import --half)")
    values = file.read(1, window=Window(columns.start, rows.start, shape[1], shape[0]))
    scale, offset = file.scales[0], file.offsets[0]
    stated = (scale, offset) != (1.0, 0.0) or str(file.units[0]).lower() in METRES
    return Grid(
        values=values,
        projection=projection,
        first_m=(first[0] + columns.start * t.a, first[1] + rows.start * t.e),
        step_m=(float(t.a), float(t.e)),
        scale=float(scale) if stated else None,
        offset_m=float(offset),
        no_data=file.nodata,
    )


def _window(
    projection: Projection, first: tuple[float, float], step: tuple[float, float], shape: tuple[int, int],
    near: tuple[float, float],
) -> tuple[slice, slice]:  # fmt: skip
    """Rows and columns within reach of a place, without the map being read."""
    probe = Raster(
        heights_m=np.broadcast_to(np.float32(0), shape), projection=projection, x0_m=first[0], y0_m=first[1],
        dx_m=step[0], dy_m=step[1],
    )  # fmt: skip
    return probe.window(*near, WINDOW_HALF_M)
