"""Height maps from arrays, which have no place of their own."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from startrack.core.types import MAX_PIXELS, BadInput
from startrack.terrain.map_heights import Stored, heights_of
from startrack.terrain.map_reading import place_on, require_extra
from startrack.terrain.plain_tiff import one_line_refusal
from startrack.terrain.projection import STEREOGRAPHIC, Projection
from startrack.terrain.raster import Raster

SUFFIX = ".npy"


@dataclass(frozen=True, kw_only=True)
class Grid:
    """Where the posts of an array stand: the first row is the northern one, columns go to the east.

    post: distance between posts. crs: reference system as PROJ reads it; "" is the stereographic plane of the Moon
    about the origin. corner: x, y of the first post; None where the array's middle stands at the origin. Lengths are in
    the units of `crs`, metres without it.
    """

    post: float
    crs: str = ""
    corner: tuple[float, float] | None = None

    def place(self, heights_m: np.ndarray, near: tuple[float, float]) -> Raster:
        """The array `heights_m` (rows, columns) in its place, `near` the latitude and longitude [rad] of the origin.

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
