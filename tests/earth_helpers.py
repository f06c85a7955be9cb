"""Ground of the Earth for tests: SRTM heights that come with matplotlib, on grids of several projections."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pyproj
from matplotlib import cbook

from startrack.frames import Site
from startrack.terrain import Raster
from startrack.terrain.maps.projections import EarthProjection, project_earth

PLACE_DEG = 36.59, -84.246  # in the middle of the map
SITE = Site("earth", *map(float, np.radians(PLACE_DEG)), 300.0)


@cache
def jacksboro() -> Raster:
    """Posts of 3 arcsec about the Jacksboro fault, Tennessee."""
    data = cbook.get_sample_data("jacksboro_fault_dem.npz")
    step = float(data["dx"])
    x0, y0 = float(data["xmin"]) + step / 2, float(data["ymin"]) - step / 2  # its ymin is the northern edge
    heights = data["elevation"].astype(np.float32)
    return Raster(
        heights_m=heights, projection=EarthProjection(middle_x=x0 + 200 * step), x0_m=x0, y0_m=y0, dx_m=step,
        dy_m=-step, source="jacksboro",
    )  # fmt: skip


def in_projection(code: str, step_m: float, posts: int = 280) -> Raster:
    """The ground of `jacksboro` at the posts of another grid."""
    projection = project_earth(pyproj.CRS(code), (0.0, 0.0), (SITE.latitude_rad, SITE.longitude_rad))
    x, y = (float(v) for v in projection.xy_from_latlon(SITE.latitude_rad, SITE.longitude_rad))
    half = posts // 2 * step_m
    empty = Raster(
        heights_m=np.zeros((posts, posts), np.float32), projection=projection, x0_m=x - half, y0_m=y + half,
        dx_m=step_m, dy_m=-step_m, source=code,
    )  # fmt: skip
    at = np.stack(np.meshgrid(*2 * [np.arange(posts, dtype=np.float64)], indexing="ij"), axis=-1)
    heights = jacksboro().sample(jacksboro().row_column(*projection.latlon_from_xy(*empty.xy(at))))
    return replace(empty, heights_m=heights.astype(np.float32))


def march(
    maps: Sequence[Raster], point_m: np.ndarray, eye_m: float, azimuths: np.ndarray, coefficient: float, s: np.ndarray
) -> np.ndarray:
    """tan of the horizon, its distance, and that of the maps' end (3, n), from points at distances `s` along each ray.

    The points are found by pyproj, in the frame of the Earth's centre. At each the first of the `maps` holds.
    """
    to_fixed = pyproj.Transformer.from_crs(4979, 4978, always_xy=True)
    to_maps = [pyproj.Transformer.from_crs(4326, one.projection.wkt or 4326, always_xy=True) for one in maps]
    lat, lon = SITE.latitude_rad, SITE.longitude_rad
    origin = np.array(to_fixed.transform(np.degrees(lon), np.degrees(lat), SITE.height_m))
    axes = np.array([
        [-np.sin(lon), np.cos(lon), 0.0],
        [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
        [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)],
    ])  # fmt: skip

    def up_of(east: np.ndarray, north: np.ndarray) -> np.ndarray:
        up = np.zeros(np.shape(east))
        for _ in range(6):
            points = np.stack([east, north, up], axis=-1) @ axes + origin
            x, y, height = to_fixed.transform(*points.T, direction="INVERSE")
            ground = np.full(np.shape(east), np.nan)
            for one, to_map in zip(maps, to_maps, strict=True):
                column, row = to_map.transform(x, y)
                where = np.stack([(row - one.y0_m) / one.dy_m, (column - one.x0_m) / one.dx_m], axis=-1)
                ground = np.where(np.isnan(ground), one.sample(where), ground)
            up = up + ground - height
        return up

    eye = up_of(point_m[:1], point_m[1:])[0] + eye_m
    found = []
    for azimuth in azimuths:
        here, end_m = s, 0.0
        for _ in range(2):  # once more in small steps about the crest: it may be a kink
            up = up_of(point_m[0] + here * np.sin(azimuth), point_m[1] + here * np.cos(azimuth))
            tan = (up - eye) / here + coefficient * here / (2 * 6_371_000.0)
            best, end_m = int(np.nanargmax(tan)), max(end_m, here[np.isfinite(tan)].max())
            top = tan[best], here[best], end_m
            here = np.linspace(here[max(best - 1, 0)], here[min(best + 1, len(here) - 1)], 201)
        found.append(top)
    return np.array(found).T
