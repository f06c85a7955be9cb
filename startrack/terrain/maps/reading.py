"""Height maps from files, by rasterio, the shipped ones without it; and from arrays, which state no place."""

from __future__ import annotations

import json
import logging
import math
import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import ArrayLike

from startrack.core.errors import how_to_install
from startrack.core.files import MAX_CAUSE_CHARS, data_dir
from startrack.core.limits import memory_refusal
from startrack.core.types import MAX_PIXELS, BadInput, Bools
from startrack.terrain.maps.heights import Stored, heights_of, note_bands
from startrack.terrain.maps.projections import (
    EQUIRECTANGULAR,
    STEREOGRAPHIC,
    EarthProjection,
    Projection,
    is_earth,
    project_earth,
    projection_of,
)
from startrack.terrain.maps.raster import Raster

# Half the side of what is read about the origin. On the Moon 10 km mountains are below the horizontal farther away. On
# the Earth the highest stand 2.8 degrees high at most farther away, where the air leaves few stars.
WINDOW_HALF_M = {"moon": 300_000.0, "earth": 150_000.0}
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
HINTS = {  # by suffix
    ".img": " (of a PDS map give the label, {stem}.LBL)",
    ".vrt": ": a mosaic names other files; make one file of it (gdal_translate)",
}
NO_MAPS = {  # by suffix
    ".npy": "an array does not state how far apart its posts are: give terrain import --post M (metres)",
    ".npz": "an archive of arrays: give one of them, written by numpy.save, to terrain import --post M",
    ".toml": "no map: give a map to terrain import, and a terrain file with -t",
    ".zip": "an archive: give the map in it",
}
HEIGHT_NAMES = "altitude", "dem", "elevation", "height", "topo", "z"  # of the grid of heights among others of a file
GEOGRAPHIC = 2  # of GTModelTypeGeoKey
PROJECTIONS = {14: "stere", 15: "stere", 21: "ortho"}  # PROJ's names, by GeoTIFF's numbers (15: about a pole)
SUFFIX = ".npy"


def read_map(
    path: str | Path, *, scale: float | None = None, offset_m: float | None = None,
    near: tuple[float, float] | None = None, body: str | None = None, unusual_heights: bool = False,
) -> Raster:  # fmt: skip
    """The height map of the file `path`.

    scale and offset_m: height [m] = offset + scale x value, in the place of what the file states.
    near: latitude and longitude [rad] about which large maps are cut. body: that it must be of, "moon" or "earth".
    unusual_heights: the heights are right though no ground of the body is as high, as low or as flat; no value is then
    taken for a void that the file does not state.
    Raises BadInput bad_terrain for a file that is missing or damaged, or that is no height map of this body near there.
    """
    path = Path(path)
    if not os.path.isfile(path):  # False also for names that the system cannot take
        raise BadInput("bad_terrain", f"{path}: no such file")
    if _is_shipped(path):
        whole = read_shipped(path)
        if scale is not None or offset_m is not None:
            raise BadInput("bad_terrain", f"{path}: it states its scale; leave --scale and --offset out")
    else:
        stored = _read_with_rasterio(path, near)
        whole = heights_of(stored, str(path), scale, offset_m, unusual_heights)
    found = whole.projection.body
    if body is not None and found != body:
        raise BadInput(
            "bad_terrain", f"{path}: it is a map of the {found.title()}, and the terrain's body is the {body.title()}"
        )
    whole = replace(whole, source=path.name)
    cut = whole if near is None else whole.crop_around(*near, WINDOW_HALF_M[found])
    if min(cut.heights_m.shape) < 2:
        raise _not_on(str(path), whole)
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


def _read_with_rasterio(path: Path, near: tuple[float, float] | None) -> Stored:
    """Content of the file `path`, cut to a window about `near`. Raises BadInput bad_terrain."""
    from rasterio.io import DatasetReader

    hint = _hint_of(path)
    with _opened(path) as file:
        parts = file.subdatasets if file.crs is None else []
        if not parts:
            return _content_of(file, path, near, hint)
        with DatasetReader(_heights_among(parts, path), driver=DRIVERS) as part:
            return _content_of(part, path, near, hint)


def _hint_of(path: Path) -> str:
    """Advice for a file that cannot be read, by its suffix."""
    return HINTS.get(path.suffix.lower(), "").format(stem=path.stem)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The open rasterio file `path`. Raises BadInput bad_terrain."""
    if path.suffix.lower() in NO_MAPS:
        raise BadInput("bad_terrain", f"{path}: {NO_MAPS[path.suffix.lower()]}")
    require_extra(str(path))
    import rasterio
    from rasterio.io import DatasetReader  # in place of rasterio.open, which takes one driver

    refusal = one_line_refusal(f"{path}: not a map that can be read{_hint_of(path)}")
    with refusal, rasterio.Env(**WITHOUT_NETWORK), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about files without a position, which have their own message
        with DatasetReader(os.fspath(path), driver=DRIVERS) as file:
            yield file


def files_of_map(path: Path) -> tuple[Path, ...]:
    """The files that the map `path` is read from: itself, and those that it names or that stand beside it."""
    found = {path: None}
    if not _is_shipped(path):
        with suppress(BadInput), _opened(path) as file:  # `read_map` reports it
            found |= dict.fromkeys(Path(one) for one in (*file.files, f"{path}.msk") if os.path.isfile(one))
    return tuple(found)


def _is_shipped(path: Path) -> bool:
    return path.suffix == ".tif" and path.resolve().parent == data_dir("terrain").resolve()


def _heights_among(parts: Sequence[str], path: Path) -> str:
    """The part of a file of several grids that is named as heights are. Raises BadInput bad_terrain."""
    named = [part for part in parts if part.rpartition(":")[2].strip("/").lower() in HEIGHT_NAMES]
    if len(named) == 1:
        return named[0]
    names = ", ".join(part.rpartition(":")[2] for part in parts)
    raise BadInput("bad_terrain", f"{path}: which of its grids has the heights? It has {names}; cut out one (gdalwarp)")


def require_extra(name: str) -> None:
    """Raise BadInput bad_terrain, with the `name` of a map, without the packages that read maps."""
    if find_spec("rasterio") is None or find_spec("pyproj") is None:
        raise BadInput("bad_terrain", f"{name}: maps are read by rasterio and pyproj: {how_to_install('dem')}")


def _content_of(file: Any, path: Path, near: tuple[float, float] | None, hint: str) -> Stored:
    """The content of an open rasterio file, cut to a window about `near`. Raises BadInput bad_terrain."""
    import pyproj
    from rasterio.windows import Window

    _require_place(file, path, hint)
    crs = pyproj.CRS.from_wkt(file.crs.to_wkt())
    t, unread = file.transform, np.broadcast_to(np.float32(0), (file.height, file.width))
    raster = place_on(crs, unread, (t.c + 0.5 * t.a, t.f + 0.5 * t.e), (float(t.a), float(t.e)), near)
    rows, columns = _rows_and_columns(file, path, raster, near)
    _require_small_blocks(file, path)
    window = Window(columns.start, rows.start, columns.stop - columns.start, rows.stop - rows.start)
    values, alphas = file.read(1, window=window), _alpha_bands(file)
    scale, offset = float(file.scales[0]), float(file.offsets[0])
    return Stored(
        values=replace(raster.crop(rows, columns), heights_m=values), missing=_voids(file, window, values, alphas),
        scale=None if (scale, offset) == (1.0, 0.0) else scale, offset=offset, units=tuple(_units_of(file, crs, path)),
        notes=note_bands(file.count, alphas, file.descriptions),
    )  # fmt: skip


def _require_place(file: Any, path: Path, hint: str) -> None:
    """Raise BadInput bad_terrain, with the `hint` of the file's kind, without a position or with a rotated grid."""
    t = file.transform
    if file.crs is None or t.is_identity:
        raise BadInput(
            "bad_terrain",
            f"{path}: it has no position on a body{hint or ': add its projection (gdal_translate -a_srs)'}",
        )
    if t.b or t.d:
        raise BadInput("bad_terrain", f"{path}: a rotated grid; bring it to north up (gdalwarp)")


def _rows_and_columns(
    file: Any, path: Path, raster: Raster, near: tuple[float, float] | None
) -> tuple[slice, slice]:  # fmt: skip
    """The rows and columns of a `raster` that are read: those about `near`, or all. Raises BadInput bad_terrain."""
    rows, columns = slice(0, file.height), slice(0, file.width)
    if near is not None:
        rows, columns = raster.window(*near, WINDOW_HALF_M[raster.projection.body])
    shape = rows.stop - rows.start, columns.stop - columns.start
    if min(file.height, file.width) >= 2 > min(shape):
        raise _not_on(str(path), raster)
    if shape[0] * shape[1] > MAX_PIXELS:
        raise BadInput("bad_terrain", f"{path}: too large; cut it to the area (startrack terrain import --half)")
    return rows, columns


def _alpha_bands(file: Any) -> list[int]:
    """Numbers, from 0, of the bands that say which posts are voids."""
    from rasterio.enums import ColorInterp

    return [k for k, kind in enumerate(file.colorinterp) if kind == ColorInterp.alpha]


def _voids(file: Any, window: Any, values: np.ndarray, alphas: Sequence[int]) -> Bools:
    """Whether the posts of a window with these `values` (rows, columns) are voids: by mask, value or alpha band."""
    missing: Bools = file.read_masks(1, window=window) == 0
    if file.nodata is not None:
        missing |= values == file.nodata  # where the file has a mask too, that is not in it
    for k in alphas:
        missing |= file.read(k + 1, window=window) == 0
    return missing


def place_on(
    crs: Any, heights_m: np.ndarray, first_xy: tuple[float, float], steps: tuple[float, float],
    near: tuple[float, float] | None,
) -> Raster:  # fmt: skip
    """Map of heights (rows, columns) in a system `crs` of pyproj, by the first post's place and the steps dx, dy.

    Raises BadInput bad_terrain for a system that is not known.
    """
    rows, columns = heights_m.shape
    middle = first_xy[0] + 0.5 * steps[0] * (columns - 1), first_xy[1] + 0.5 * steps[1] * (rows - 1)
    projection: Projection | EarthProjection
    metres = 1.0
    if crs.ellipsoid is not None and is_earth(crs.ellipsoid.semi_major_metre):
        projection = project_earth(crs, middle, near)
    else:
        horizontal = crs.sub_crs_list[0] if crs.is_compound else crs
        if not (horizontal.is_geographic or horizontal.is_projected):
            raise BadInput("bad_terrain", f"the reference system {crs.name!r} is not known: bring the map to another")
        if "west" in [axis.direction for axis in horizontal.axis_info]:
            raise BadInput("bad_terrain", "the map counts to the west: bring it to east and north (gdalwarp)")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about terms that PROJ's parameters lack
            projection = projection_of(horizontal.to_dict())
        axis = horizontal.axis_info[0]
        if horizontal.is_projected:
            metres = axis.unit_conversion_factor
        elif abs(np.radians(1.0) / axis.unit_conversion_factor - 1.0) > 1e-9:
            raise BadInput("bad_terrain", f"{crs.name!r} counts angles in {axis.unit_name}, not degrees")
        half_turn = math.pi * projection.radius_m * projection.scale
        reach = abs(metres * middle[0] - projection.false_x_m) + 0.5 * metres * abs(steps[0]) * columns
        if projection.kind == EQUIRECTANGULAR and reach > half_turn * (1 + 1e-9):
            projection = projection.centred_at(metres * middle[0])
    return Raster(
        heights_m=heights_m, projection=projection, x0_m=metres * first_xy[0], y0_m=metres * first_xy[1],
        dx_m=metres * steps[0], dy_m=metres * steps[1],
    )  # fmt: skip


def _require_small_blocks(file: Any, path: Path) -> None:
    """Raise BadInput bad_terrain where a window takes the decoding of much more, also of the mask beside the file."""
    from rasterio.io import DatasetReader

    blocks = [math.prod(file.block_shapes[0]) * file.count]
    if os.path.isfile(f"{file.name}.msk"):
        with DatasetReader(f"{file.name}.msk", driver=DRIVERS) as mask:
            blocks.append(math.prod(mask.block_shapes[0]))
    if max(blocks) > MAX_BLOCK_POSTS:
        raise BadInput("bad_terrain", f"{path}: stored in one piece; write it in tiles (gdal_translate -co TILED=YES)")


def _units_of(file: Any, crs: Any, path: Path) -> Iterator[str]:
    """Every unit of heights that a file states: of its first band, its reference system, and a PDS3 label."""
    if file.units[0]:
        yield file.units[0]
    for axis in crs.axis_info[2:]:
        if axis.direction != "up":
            raise BadInput("bad_terrain", f"{path}: it counts depths ({axis.name}): turn it to heights")
        yield axis.unit_name
    for head, rest in file.tags(ns="json:PDS").items():  # rasterio cuts the text at its first colon
        yield from _label_units(json.loads(f"{head}:{rest}"))


def _label_units(label: dict[str, Any]) -> Iterator[str]:
    """UNIT of each image that a PDS3 `label` describes, which GDAL does not tell."""
    for name, entry in label.items():
        if isinstance(entry, dict):
            if name.endswith("IMAGE") and "UNIT" in entry:
                yield str(entry["UNIT"])
            yield from _label_units(entry)


@contextmanager
def one_line_refusal(what: str) -> Iterator[None]:
    """Context that makes BadInput bad_terrain of a decoder's errors, which damaged files raise of nearly any class."""
    log = logging.getLogger("tifffile")
    log.disabled = True  # the exception has the cause
    try:
        yield
    except BadInput:
        raise
    except Exception as cause:
        text = " ".join(str(cause).split())[:MAX_CAUSE_CHARS] or type(cause).__name__
        raise memory_refusal(cause) or BadInput("bad_terrain", f"{what}: {text}") from cause
    finally:
        log.disabled = False


def is_geotiff(path: Path) -> bool:
    """Whether the file `path` is a TIFF whose first directory has the tag of a map's keys (34735)."""
    import tifffile

    with suppress(BadInput), one_line_refusal(str(path)), tifffile.TiffFile(path) as file:
        return bool(file.pages.first.is_geotiff)
    return False


def read_shipped(path: Path) -> Raster:
    """A map that `terrain/build_maps.py` wrote: whole steps with scale and offset [m], every post with a height.

    Raises BadInput bad_terrain for another or a damaged file.
    """
    import tifffile

    with one_line_refusal(f"{path}: not a map as startrack ships it"), tifffile.TiffFile(path) as file:
        page, keys = file.pages.first, file.geotiff_metadata or {}
        items = ElementTree.fromstring(page.tags.valueof("GDAL_METADATA")).iter("Item")
        step = {item.get("name"): float(item.text or "") for item in items if item.get("name") in ("SCALE", "OFFSET")}
        west, north = keys["ModelTiepoint"][3:5]
        dx, dy = keys["ModelPixelScale"][0], -keys["ModelPixelScale"][1]
        return Raster(
            heights_m=(page.asarray() * step["SCALE"] + step["OFFSET"]).astype(np.float32),
            projection=_projection_of(keys), x0_m=west + 0.5 * dx, y0_m=north + 0.5 * dy, dx_m=dx, dy_m=dy,
        )  # fmt: skip


def _projection_of(keys: dict[str, float]) -> Projection:
    """The projection of the keys of a shipped map."""
    if keys["GTModelTypeGeoKey"] == GEOGRAPHIC:
        return projection_of({"proj": "longlat", "R": keys["GeogSemiMajorAxisGeoKey"]})
    longitude = keys.get("ProjStraightVertPoleLongGeoKey", keys.get("ProjCenterLongGeoKey"))
    return projection_of({
        "proj": PROJECTIONS[int(keys["ProjCoordTransGeoKey"])], "R": keys["GeogSemiMajorAxisGeoKey"],
        "lat_0": keys.get("ProjNatOriginLatGeoKey", keys.get("ProjCenterLatGeoKey")), "lon_0": longitude,
        "k_0": keys.get("ProjScaleAtNatOriginGeoKey", 1.0), "x_0": keys["ProjFalseEastingGeoKey"],
        "y_0": keys["ProjFalseNorthingGeoKey"],
    })  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Grid:
    """Places of the posts of an array: the first row is the northern one, columns go to the east.

    post: distance between posts. crs: reference system as PROJ reads it; "" is the stereographic plane of the Moon
    about the origin. corner: x, y of the first post; None where the array's middle stands at the origin. Lengths are in
    the units of `crs`, metres without it.
    """

    post: float
    crs: str = ""
    corner: tuple[float, float] | None = None

    def place(self, heights_m: np.ndarray, near: tuple[float, float]) -> Raster:
        """Map of the array `heights_m` (rows, columns), `near` the latitude and longitude [rad] of the origin.

        Raises BadInput bad_terrain for a reference system that is not known.
        """
        rows, columns = heights_m.shape
        half = 0.5 * self.post * np.array([columns - 1, 1 - rows])
        if not self.crs:
            projection = Projection(kind=STEREOGRAPHIC, latitude_rad=near[0], longitude_rad=near[1])
            x0, y0 = -half if self.corner is None else self.corner
            return Raster(
                heights_m=heights_m, projection=projection, x0_m=float(x0), y0_m=float(y0), dx_m=self.post,
                dy_m=-self.post,
            )  # fmt: skip
        require_extra(f"--crs {self.crs}")
        import pyproj

        with one_line_refusal(f"{self.crs}: PROJ knows no such reference system"):
            crs = pyproj.CRS.from_user_input(self.crs)
        if self.corner is None:
            whole = place_on(crs, heights_m, (0.0, 0.0), (self.post, -self.post), near)
            x, y = whole.projection.xy_from_latlon(*near)
            metres = whole.dx_m / self.post
            x0, y0 = np.array([float(x), float(y)]) / metres - half
        else:
            x0, y0 = self.corner
        return place_on(crs, heights_m, (float(x0), float(y0)), (self.post, -self.post), near)


def map_of_array(
    heights: ArrayLike, grid: Grid, *, latitude_rad: float, longitude_rad: float, scale: float | None = None,
    offset_m: float | None = None, unusual_heights: bool = False, source: str = "array",
) -> Raster:  # fmt: skip
    """The height map of an array (rows, columns) of heights on a `grid`; NaN is a void.

    latitude_rad, longitude_rad: the origin. scale, offset_m: height [m] = offset + scale x value; whole numbers need a
    scale. unusual_heights: see `read_map`. source: its name in messages. Raises BadInput bad_terrain.
    """
    values = np.asarray(heights)
    if values.ndim != 2 or values.size > MAX_PIXELS:
        raise BadInput("bad_terrain", f"{source}: an array of shape {values.shape}: give rows and columns of heights")
    values = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("="))
    placed = grid.place(values, (latitude_rad, longitude_rad))
    stored = Stored(values=placed, missing=np.zeros(values.shape, dtype=bool))
    found = heights_of(stored, source, scale, offset_m, unusual_heights)
    return replace(found, source=source)


def read_array(path: str | Path) -> np.ndarray:
    """The array of a `.npy` file, as it lies on the disk. Raises BadInput bad_terrain."""
    with one_line_refusal(f"{path}: not an array that numpy reads"):
        return np.asarray(np.load(path, mmap_mode="r", allow_pickle=False))
