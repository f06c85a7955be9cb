"""Height maps and other maps, written as GeoTIFF by rasterio."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.core.errors import how_to_install
from startrack.core.files import write_atomically
from startrack.core.types import BadInput
from startrack.terrain.maps.projections import WGS84_CODE, EarthProjection
from startrack.terrain.maps.raster import Raster

MIN_STEP_M = 0.01  # of the heights in files that are written
NO_HEIGHT = np.iinfo(np.uint16).max
UNIT = "metre"


def can_write_maps() -> bool:
    """Whether the extra `dem`, which writes maps, is installed."""
    return find_spec("rasterio") is not None


def write_map(path: str | Path, raster: Raster, *, step_m: float | None = None, offset_m: float | None = None) -> None:
    """Write the map `raster` to `path` as deflated 16-bit steps with scale, offset and unit, as GDAL reads them.

    Heights are rounded to `offset_m`, by default the lowest, plus multiples of `step_m`, by default a 65,000th of
    their range. The file appears when complete. Raises BadInput bad_terrain or disk_full where it cannot be written.
    """
    h = raster.heights_m.astype(np.float64)
    low, high = float(np.nanmin(h)), float(np.nanmax(h))
    offset = low if offset_m is None else offset_m
    step = max((high - low) / 65_000, MIN_STEP_M) if step_m is None else step_m
    values = np.where(np.isnan(h), NO_HEIGHT, np.round((np.nan_to_num(h) - offset) / step)).astype(np.uint16)
    no_data = NO_HEIGHT if np.isnan(h).any() else None
    data = _tiff_bytes(path, raster, values[None], no_data, scales=(step,), offsets=(offset,), units=(UNIT,))
    write_atomically(path, data, overwrite=True, reason="bad_terrain")


def write_bands(path: str | Path, frame: Raster, bands: Mapping[str, NDArray[np.float32]]) -> None:
    """Write named `bands` (rows, columns) to `path`, at the posts of a `frame`; NaN where there is no value.

    The file appears when complete. Raises BadInput bad_image or disk_full where it cannot be written.
    """
    values = np.stack([np.asarray(band, dtype=np.float32) for band in bands.values()])
    data = _tiff_bytes(path, frame, values, np.nan, descriptions=tuple(bands))
    write_atomically(path, data, overwrite=True)


def _tiff_bytes(
    path: str | Path, frame: Raster, values: NDArray[Any], no_data: float | None, **facts: tuple[Any, ...]
) -> bytes:  # fmt: skip
    """GeoTIFF of bands (bands, rows, columns) at the posts of a map; `facts` of each by rasterio's names.

    Made in memory: GDAL does not tell why a disk takes no file. Raises BadInput bad_terrain without rasterio.
    """
    if not can_write_maps():
        raise BadInput("bad_terrain", f"{path}: writing maps needs rasterio: {how_to_install('dem')}")
    import rasterio

    projection, west_m = frame.projection, frame.x0_m - 0.5 * frame.dx_m
    if isinstance(projection, EarthProjection):
        crs = projection.wkt or f"EPSG:{WGS84_CODE}"
    else:
        crs = projection.proj_text
        if projection.is_in_degrees:  # which count from the central meridian
            west_m += float(np.degrees(projection.longitude_rad)) - projection.false_x_m
    place = rasterio.Affine(frame.dx_m, 0.0, west_m, 0.0, frame.dy_m, frame.y0_m - 0.5 * frame.dy_m)
    with rasterio.MemoryFile() as memory:
        with memory.open(
            driver="GTiff", height=values.shape[1], width=values.shape[2], count=len(values), dtype=values.dtype,
            crs=crs, transform=place, nodata=no_data, compress="deflate", zlevel=9,
            predictor=2 if values.dtype == np.uint16 else 1,
        ) as file:  # fmt: skip
            file.write(values)
            for name, value in facts.items():
                setattr(file, name, value)
        return bytes(memory.read())
