"""The shipped height maps, plain TIFF files that are read without rasterio; and which TIFF files are maps."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from startrack.core.files import MAX_CAUSE_CHARS
from startrack.core.memory import memory_refusal
from startrack.core.types import BadInput
from startrack.terrain.projection import Projection, projection_of
from startrack.terrain.raster import Raster

GEOGRAPHIC = 2  # of GTModelTypeGeoKey
PROJECTIONS = {14: "stere", 15: "stere", 21: "ortho"}  # PROJ's names, by GeoTIFF's numbers (15: about a pole)


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
