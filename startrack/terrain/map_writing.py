"""Height maps and other maps, written as GeoTIFF: with own tags, or on the Earth with those of rasterio."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.core.files import write_atomically
from startrack.terrain.earth_projection import WGS84_CODE, EarthProjection
from startrack.terrain.raster import EQUIRECTANGULAR, ORTHOGRAPHIC, STEREOGRAPHIC, Projection, Raster

MIN_STEP_M = 0.01  # of the heights in files that are written
NO_HEIGHT = np.iinfo(np.uint16).max
USER_DEFINED, METRE, DEGREE = 32767, 9001, 9102  # values of keys, GeoTIFF 1.1
PROJECTION_CODES = {STEREOGRAPHIC: 14, ORTHOGRAPHIC: 21, EQUIRECTANGULAR: 17}  # polar stereographic: 15


def write_map(path: str | Path, raster: Raster, *, step_m: float | None = None, offset_m: float | None = None) -> None:
    """Write the map `raster` to `path` as deflated 16-bit steps with scale and offset, as GDAL reads them.

    Heights are rounded to `offset_m`, by default the lowest, plus multiples of `step_m`, by default a 65,000th of
    their range. The file appears when complete. Raises BadInput bad_terrain or disk_full where it cannot be written.
    """
    import tifffile

    h = raster.heights_m.astype(np.float64)
    low, high = float(np.nanmin(h)), float(np.nanmax(h))
    offset = low if offset_m is None else offset_m
    step = max((high - low) / 65_000, MIN_STEP_M) if step_m is None else step_m
    values = np.where(np.isnan(h), NO_HEIGHT, np.round((np.nan_to_num(h) - offset) / step)).astype(np.uint16)
    items = (
        f'<Item name="SCALE" sample="0" role="scale">{step!r}</Item>'
        f'<Item name="OFFSET" sample="0" role="offset">{offset!r}</Item>'
    )
    no_data = NO_HEIGHT if np.isnan(h).any() else None
    if raster.projection.wkt:
        data = _rasterio_bytes(raster, values[None], no_data, scales=(step,), offsets=(offset,))
    else:
        tifffile.imwrite(
            file := io.BytesIO(), values, compression="deflate", compressionargs={"level": 9}, predictor=True,
            extratags=_tags(raster, items, None if no_data is None else str(no_data)), metadata=None, rowsperstrip=256,
            software="startrack",
        )  # fmt: skip
        data = file.getvalue()
    write_atomically(path, data, overwrite=True, reason="bad_terrain")


def write_bands(path: str | Path, frame: Raster, bands: Mapping[str, NDArray[np.float32]]) -> None:
    """Write named `bands` (rows, columns) to `path`, at the posts of a `frame`; NaN where there is no value.

    The file appears when complete. Raises BadInput bad_image or disk_full where it cannot be written.
    """
    import tifffile

    items = "".join(
        f'<Item name="DESCRIPTION" sample="{k}" role="description">{name}</Item>' for k, name in enumerate(bands)
    )
    values = np.stack([np.asarray(band, dtype=np.float32) for band in bands.values()])
    if frame.projection.wkt:
        data = _rasterio_bytes(frame, values, np.nan, descriptions=tuple(bands))
    else:
        tifffile.imwrite(
            file := io.BytesIO(), values, photometric="minisblack", planarconfig="separate", compression="deflate",
            compressionargs={"level": 9}, extratags=_tags(frame, items, "nan"), metadata=None, software="startrack",
        )  # fmt: skip
        data = file.getvalue()
    write_atomically(path, data, overwrite=True)


def _rasterio_bytes(
    frame: Raster, values: NDArray[Any], no_data: float | None, **facts: tuple[Any, ...]
) -> bytes:  # fmt: skip
    """GeoTIFF of bands (bands, rows, columns) at the posts of a map of the Earth; `facts` of each by rasterio's names.

    Made in memory: GDAL does not tell why a disk takes no file.
    """
    import rasterio

    place = rasterio.Affine(
        frame.dx_m, 0.0, frame.x0_m - 0.5 * frame.dx_m, 0.0, frame.dy_m, frame.y0_m - 0.5 * frame.dy_m
    )
    with rasterio.MemoryFile() as memory:
        with memory.open(
            driver="GTiff", height=values.shape[1], width=values.shape[2], count=len(values), dtype=values.dtype,
            crs=frame.projection.wkt, transform=place, nodata=no_data, compress="deflate", zlevel=9,
            predictor=2 if values.dtype == np.uint16 else 1,
        ) as file:  # fmt: skip
            file.write(values)
            for name, value in facts.items():
                setattr(file, name, value)
        return bytes(memory.read())


def _tags(m: Raster, items: str, no_data: str | None) -> list[tuple[int, str, int, Any, bool]]:
    """The tags of a map's place (posts are pixel centres: raster type "area"), of GDAL's `items`, and of `no_data`."""
    import tifffile

    codes = tifffile.TIFF.TAGS
    doubles: list[float] = []
    directory, text = [], ""
    for key, value in _geo_keys(m.projection).items():
        if isinstance(value, str):
            directory.append((key, codes["GeoAsciiParamsTag"], len(value), len(text)))
            text += value
        elif isinstance(value, float):
            directory.append((key, codes["GeoDoubleParamsTag"], 1, len(doubles)))
            doubles.append(value)
        else:
            directory.append((key, 0, 1, value))
    numbers = 1, 1, 1, len(directory), *(number for entry in sorted(directory) for number in entry)
    tags = {
        "GDAL_METADATA": ("s", 0, f"<GDALMetadata>{items}</GDALMetadata>"),
        "ModelPixelScaleTag": ("d", 3, (m.dx_m, -m.dy_m, 0.0)),
        "ModelTiepointTag": ("d", 6, (0.0, 0.0, 0.0, m.x0_m - 0.5 * m.dx_m, m.y0_m - 0.5 * m.dy_m, 0.0)),
        "GeoKeyDirectoryTag": ("H", len(numbers), numbers),
        "GeoDoubleParamsTag": ("d", len(doubles), tuple(doubles)),
        "GeoAsciiParamsTag": ("s", 0, text),
    }
    if no_data is not None:
        tags["GDAL_NODATA"] = ("s", 0, no_data)
    return [(codes[name], *tag, True) for name, tag in tags.items()]


def _geo_keys(p: Projection | EarthProjection) -> dict[int, int | float | str]:
    """Keys of a projection: whole numbers as such, others as floats, texts with their end mark."""
    if isinstance(p, EarthProjection):
        return {1024: 2, 1025: 1, 2048: WGS84_CODE, 2054: DEGREE}
    degrees = p.kind == EQUIRECTANGULAR and p.scale_y != 1.0  # latitude and longitude themselves
    radius = float(p.radius_m)
    keys: dict[int, int | float | str] = {
        1024: 2 if degrees else 1, 1025: 1, 2048: USER_DEFINED, 2049: "Moon 2015 sphere|", 2050: USER_DEFINED,
        2054: DEGREE, 2056: USER_DEFINED, 2057: radius, 2058: radius,
    }  # fmt: skip
    if degrees:
        return keys
    latitude, longitude, scale = float(np.degrees(p.latitude_rad)), float(np.degrees(p.longitude_rad)), float(p.scale)
    polar = p.kind == STEREOGRAPHIC and abs(latitude) == 90.0
    keys |= {3072: USER_DEFINED, 3074: USER_DEFINED, 3075: PROJECTION_CODES[p.kind] + polar, 3076: METRE}
    if polar:
        keys |= {3081: latitude, 3095: longitude, 3092: scale}
    elif p.kind == EQUIRECTANGULAR:
        keys |= {3078: float(np.degrees(np.arccos(scale))), 3088: longitude, 3089: 0.0}
    else:
        keys |= {3088: longitude, 3089: latitude, 3092: scale}
    return {**keys, 3082: float(p.false_x_m), 3083: float(p.false_y_m)}
