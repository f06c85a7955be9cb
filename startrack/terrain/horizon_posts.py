"""The posts of height maps that make the horizon: how much it rises with the height of each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.core.types import Array, Ints
from startrack.frames import Site, enu_from_latlon, latlon_from_enu
from startrack.terrain.raster import Raster

CORNERS = np.array([[0, 0], [0, 1], [1, 0], [1, 1]])  # (row, column) of the posts of a cell
NO_POST = -1


@dataclass(frozen=True, eq=False)
class HorizonPosts:
    """The four posts about the place where each of n sight lines touches the ground, in the numbering of a terrain."""

    post: Ints  # (n, 4); NO_POST where no map reaches
    rad_per_m: Array  # (n, 4) rise of the horizon with the height of each
    horizon_rad: Array  # (n,) of the map; NaN of ground without posts

    @classmethod
    def create_empty(cls, rays: int) -> HorizonPosts:
        """Of ground without posts."""
        return cls(np.full((rays, 4), NO_POST), np.zeros((rays, 4)), np.full(rays, np.nan))


def cell_posts(site: Site, maps: tuple[Raster, ...], points_enu_m: Array) -> tuple[Ints, Array]:
    """Posts (n, 4) of the cells that hold points (n, 3) in enu, and their bilinear weights (n, 4).

    The posts of all maps are numbered one map after the other, the finest first, row by row.
    """
    latitude, longitude = latlon_from_enu(site, *points_enu_m.T)
    post, weight = np.full((len(points_enu_m), 4), NO_POST), np.zeros((len(points_enu_m), 4))
    first = 0
    for raster in maps:
        rows, columns = raster.heights_m.shape
        at = raster.row_column(latitude, longitude)
        cell = np.floor(at).astype(np.int64)
        inside = (cell >= 0).all(axis=1) & (cell[:, 0] < rows - 1) & (cell[:, 1] < columns - 1)
        new = inside & (post[:, 0] == NO_POST)
        corner = cell[new, None] + CORNERS
        post[new] = first + corner[..., 0] * columns + corner[..., 1]
        weight[new] = np.prod(1.0 - np.abs(at[new, None] - corner), axis=-1)
        first += raster.heights_m.size
    return post, weight


def post_positions(site: Site, maps: tuple[Raster, ...], posts: Ints) -> Array:
    """East, north and up (n, 3) in enu of posts (n,), by the map."""
    found, first = np.zeros((len(posts), 3)), 0
    for raster in maps:
        columns, last = raster.heights_m.shape[1], first + raster.heights_m.size
        here = (posts >= first) & (posts < last)
        row_column = np.stack(np.divmod(posts[here] - first, columns), axis=-1)
        latitude, longitude = raster.projection.latlon_from_xy(*raster.xy(row_column))
        height = raster.heights_m.ravel()[posts[here] - first]
        found[here] = enu_from_latlon(site, latitude, longitude, height)
        first = last
    return found
