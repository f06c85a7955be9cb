"""The geoid at a place, from a grid of PROJ."""

from __future__ import annotations

from importlib.util import find_spec
from typing import NamedTuple

import numpy as np

from startrack.core.errors import how_to_install
from startrack.core.types import BadInput
from startrack.frames import Site, latlon_from_enu

BASE_M = 10_000.0  # from the site to the points that give the slope: the grids have posts every 2 to 30 km


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
