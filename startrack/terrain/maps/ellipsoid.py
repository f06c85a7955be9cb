"""Maps of the Earth as the kernels trace them, on a sphere about the origin; and heights that count from the geoid.

The sphere goes through the origin of enu, as curved as the ellipsoid is there; its centre is on the origin's vertical.
The exact place of a post in enu gives its direction from that centre and its height above that sphere. The column and
row of the map are a smooth function of the direction. The height of the ellipsoid above the sphere is one, too: 0 at
the origin, and some metres 100 km away.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from startrack.core.errors import how_to_install
from startrack.core.types import Array, BadInput
from startrack.frames import Site, enu_from_latlon, latlon_from_enu, sphere_radius_m
from startrack.terrain.maps.projections import FOOT_M
from startrack.terrain.maps.raster import Raster

MOST_DEGREE = 12
FIT_NODES, CHECK_NODES = 28, 41  # along each side, for the fit and for its check
MARGIN_POSTS, MARGIN_1 = 6.0, 0.02  # beyond the map's posts, where steps of a ray still ask for columns and rows
# Largest error of a place on the map: 1/100 of a post but no more than 10 cm, or, far away, 2e-6 of the distance from
# the origin. On ground of 45 degrees the latter changes a horizon by 0.0001 degrees.
TOLERANCE_POSTS, TOLERANCE_M, TOLERANCE_RAD = 0.01, 0.1, 2e-6
FOOT_TOLERANCE_1, LOW_M = 0.03, 100.0  # stated heights that low do not show the unit
HEIGHT_NODES = 65  # along each side of a map, between which the sphere's height is interpolated: it bends by 1e-9 / m
ELLIPSOID = "ellipsoid"  # in place of a grid of the geoid: heights are above the ellipsoid
BASE_M = 10_000.0  # from the site to the points that give the slope: the grids have posts every 2 to 30 km


def fit_cells(raster: Raster, site: Site) -> Array:
    """Numbers (n, 2) of a map for the kernels' `map_cell`, in two columns for x and y, or for column and row.

    The degree, the middle, 1 / half width, and the coefficients.
    x = east / up and y = north / up of a direction from the sphere's centre. Raises BadInput bad_terrain for a map
    whose projection no polynomial of the highest degree fits.
    """
    heights = raster.heights_m[np.isfinite(raster.heights_m)]
    low, high = (float(heights.min()), float(heights.max())) if heights.size else (0.0, 0.0)
    middle, half = _extent(raster, site, 0.5 * (low + high))
    nodes = np.cos(np.pi * (np.arange(FIT_NODES) + 0.5) / FIT_NODES)
    at = np.stack(np.meshgrid(nodes, nodes, indexing="ij"), axis=-1).reshape(-1, 2)
    cells = _cells_at(raster, site, middle + half * at, 0.5 * (low + high))
    line = np.linspace(-1.0, 1.0, CHECK_NODES)
    tests = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)
    wanted = [_cells_at(raster, site, middle + half * tests, height) for height in (low, high)]
    if not all(np.isfinite(one).all() for one in (cells, *wanted)):
        raise BadInput("bad_terrain", f"{raster.source}: its projection does not reach all of its own posts")
    away_m = np.hypot(*(middle + half * tests).T) * sphere_radius_m(site)
    allowed = np.maximum(min(TOLERANCE_POSTS * raster.post_m, TOLERANCE_M), TOLERANCE_RAD * away_m)
    off_m = np.inf
    for degree in range(1, MOST_DEGREE + 1):
        found = np.linalg.lstsq(_powers(at, degree), cells, rcond=None)[0]
        fitted = _powers(tests, degree) @ found
        off_m = max(float(np.max(np.hypot(*(fitted - one).T) * raster.post_m / allowed)) for one in wanted)
        if off_m <= 1.0:
            return np.concatenate([[[degree, 0.0], middle, 1 / half], found])
    raise BadInput(
        "bad_terrain",
        f"{raster.source}: the map's projection ({raster.projection.name}) bends too much over its area: "
        "cut the map to a smaller area (startrack terrain import --half), or bring it to UTM (gdalwarp -r bilinear)",
    )


def heights_above_sphere(raster: Raster, site: Site) -> NDArray[np.float32]:
    """Heights (rows, columns) [m] of the posts above the sphere through the origin; NaN where the map has none."""
    radius, height = sphere_radius_m(site), float(np.nanmean(raster.heights_m))
    centre = np.array([0.0, 0.0, -radius])
    above = _smooth_over_posts(raster, site, lambda points: np.linalg.norm(points - centre, axis=-1) - radius - height)
    return np.asarray(raster.heights_m + above, dtype=np.float32)


class Geoid(NamedTuple):
    """The geoid above the ellipsoid: its height at a site, and how it rises there to the east and to the north."""

    height_m: float
    slope_arcsec: tuple[float, float]


def geoid_at(grid: str, site: Site) -> Geoid:
    """The geoid at a `site` on the Earth by a `grid`: a name that PROJ finds, or the path of a GTX or GeoTIFF grid.

    Raises BadInput (bad_terrain) where PROJ has no such grid, or it does not reach the site.
    """
    if find_spec("pyproj") is None:
        raise BadInput("bad_terrain", f"grids of the geoid need pyproj: {how_to_install('dem')}")
    from pyproj import Transformer
    from pyproj.exceptions import ProjError

    try:
        shift = Transformer.from_pipeline(f"+proj=vgridshift +grids={grid} +multiplier=1")
    except ProjError as cause:
        advice = f"projsync --file {grid} fetches those of PROJ"
        raise BadInput("bad_terrain", f"{grid}: PROJ finds no such grid of the geoid: {advice}") from cause
    east_m, north_m = BASE_M * np.array([[0, -1, 1, 0, 0], [0, 0, 0, -1, 1]])
    latitude, longitude = latlon_from_enu(site, east_m, north_m, np.zeros(5))
    here, west, east, south, north = shift.transform(longitude, latitude, np.zeros(5), radians=True)[2]
    if not np.isfinite([here, west, east, south, north]).all():
        raise BadInput("bad_terrain", f"{grid}: this grid of the geoid does not reach the origin")
    slope = np.degrees(np.arctan([(east - west) / (2 * BASE_M), (north - south) / (2 * BASE_M)])) * 3600.0
    return Geoid(float(here), (float(slope[0]), float(slope[1])))


def above_ellipsoid(raster: Raster, site: Site, geoid_m: float, slope_arcsec: Sequence[float]) -> Raster:
    """Copy of a map with heights above the ellipsoid; `raster` has them above a geoid `geoid_m` high at the site.

    slope_arcsec: how the geoid rises there above the ellipsoid to the east and to the north.
    """
    if not (geoid_m or any(slope_arcsec)):
        return raster
    slope = np.tan(np.radians(np.array(slope_arcsec) / 3600.0))
    raised = _smooth_over_posts(raster, site, lambda points: geoid_m + points[..., :2] @ slope)
    return replace(raster, heights_m=np.asarray(raster.heights_m + raised, dtype=np.float32))


def maps_above_ellipsoid(maps: Sequence[Raster], dem: Mapping[str, Any], site: Site) -> tuple[Raster, ...]:
    """Copies of the `maps` with heights above the ellipsoid, by what the table `dem` of a file states of their geoid.

    Raises BadInput bad_terrain where it states it of another number of maps.
    """
    stated = (_of_each_map(dem, "geoid_m", 0.0, maps), _of_each_map(dem, "geoid_slope_arcsec", (0.0, 0.0), maps))
    return tuple(above_ellipsoid(one, site, *geoid) for one, *geoid in zip(maps, *stated, strict=True))


def _of_each_map(dem: Mapping[str, Any], key: str, absent: Any, maps: Sequence[Raster]) -> Sequence[Any]:
    """The value of a `key` for each of the `maps`: one for all, or a list of them."""
    value = dem.get(key, absent)
    if np.ndim(value) == np.ndim(absent):
        return [value] * len(maps)
    if len(value) != len(maps):
        raise BadInput(
            "bad_terrain", f"dem.{key} has {len(value)} entries for {len(maps)} maps: give one, or one for each"
        )
    return tuple(value)


def check_height(site: Site, maps: Sequence[Raster]) -> None:
    """Raise BadInput bad_terrain if the maps have the site's stated height in other units than metres."""
    at = np.array([site.latitude_rad]), np.array([site.longitude_rad])
    for one in maps:
        found = float(one.sample(one.row_column(*at))[0])
        feet = [found / site.height_m, site.height_m / found] if abs(site.height_m) > LOW_M and found else []
        if any(abs(ratio * FOOT_M - 1.0) < FOOT_TOLERANCE_1 for ratio in feet):
            raise BadInput(
                "bad_terrain",
                f"{one.source}: at the origin it has {found:.0f}, where the terrain file states height_m = "
                f"{site.height_m:.0f}: one of them is in feet; of the map state scale = {FOOT_M} in [dem] (--scale of "
                "terrain import)",
            )


def _smooth_over_posts(raster: Raster, site: Site, function: Callable[[Array], Array]) -> Array:
    """Values (rows, columns) at the posts of a smooth function of points (..., 3) in enu, interpolated."""
    from scipy.interpolate import RectBivariateSpline

    lines = [np.linspace(0, n - 1, min(n, HEIGHT_NODES)) for n in raster.heights_m.shape]
    at = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1)
    height = float(np.nanmean(raster.heights_m))
    points = enu_from_latlon(site, *raster.projection.latlon_from_xy(*raster.xy(at)), height)
    order = [min(len(line) - 1, 3) for line in lines]
    every = [np.arange(n, dtype=np.float64) for n in raster.heights_m.shape]
    return np.asarray(RectBivariateSpline(*lines, function(points), kx=order[0], ky=order[1])(*every))


def _extent(raster: Raster, site: Site, height_m: float) -> tuple[Array, Array]:
    """Middle (2,) and half widths (2,) of x and y of the directions to a map's posts, with a margin."""
    lines = [np.linspace(0, n - 1, CHECK_NODES) for n in raster.heights_m.shape]
    at = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 2)
    points = enu_from_latlon(site, *raster.projection.latlon_from_xy(*raster.xy(at)), height_m)
    radius = sphere_radius_m(site)
    up = points[:, 2:] + radius
    if not np.isfinite(points).all() or not (up > 0.5 * radius).all():
        raise BadInput("bad_terrain", f"{raster.source}: its posts are not all near the origin: cut it (--half)")
    low, high = (points[:, :2] / up).min(axis=0), (points[:, :2] / up).max(axis=0)
    half = 0.5 * (high - low) * (1.0 + MARGIN_1) + MARGIN_POSTS * raster.post_m / radius
    return 0.5 * (low + high), half


def _cells_at(raster: Raster, site: Site, xy: Array, height_m: float) -> Array:
    """Column and row (n, 2) of the map in the directions x, y (n, 2), of ground at this height."""
    radius = sphere_radius_m(site)
    rays = np.column_stack([xy, np.ones(len(xy))])
    points = rays * ((radius - site.height_m + height_m) / np.linalg.norm(rays, axis=1, keepdims=True))
    place = latlon_from_enu(site, points[:, 0], points[:, 1], points[:, 2] - radius)
    return raster.row_column(*place)[:, ::-1]


def _powers(xy: Array, degree: int) -> Array:
    """Powers x^i y^j (n, terms), i + j at most the degree, in the order in which Horner's rule reads them."""
    x, y = xy.T
    return np.stack([x**i * y**j for i in range(degree, -1, -1) for j in range(degree - i, -1, -1)], axis=-1)
