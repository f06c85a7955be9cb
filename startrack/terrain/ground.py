"""Several height maps as one ground, the finest first: packed for tracing; heights and posts at places.

For tracing all posts are in one array, with pyramids of the highest ground and of its slopes.

Level L of a pyramid has blocks of 2^L x 2^L cells, a cell lying between four posts. Of each block the pyramid holds the
highest post, the highest of it and its eight neighbours, and the range of the slopes of these nine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from startrack.core.types import Array, Bools, Ints
from startrack.frames import Site, enu_from_latlon, latlon_from_enu, sphere_radius_m
from startrack.kernels.library import kernel
from startrack.kernels.records import Record, declare_record
from startrack.terrain.maps.raster import Raster
from startrack.terrain.shape import NO_POST

SLOPE_STEPS = np.iinfo(np.int8).max  # a slope is kept as a whole number of 1/127 of the map's steepest, rounded up
SURFACE_ROUNDS = 6  # of the height of the ground, each with the place of the last one's height
SMALLEST_BLOCKS = 4  # a pyramid ends where a level has no more blocks than this along an axis


@dataclass(frozen=True, eq=False)
class Ground:
    """The maps as the kernels read them: plain arrays."""

    grid: Array  # (maps, 16) on the Moon, (maps, n, 2) on the Earth, see Raster.grid_numbers
    heights: NDArray[np.float32]  # all posts [m above the sphere through the origin of enu]
    posts: Ints  # (maps, 3): where a map's posts begin, rows, columns
    tops: NDArray[np.float32]  # highest post of each block [m]
    wide_tops: NDArray[np.float32]  # highest post of each block and its neighbours [m]
    slopes: NDArray[np.int8]  # (blocks, 8): most fall and rise per step along column, row, both, and -column +row
    blocks: Ints  # (maps, levels, 3): where a level's blocks begin, block rows, block columns
    levels: Ints  # (maps,)
    slope_unit: Array  # (maps,) [m per post]
    post_m: Array  # (maps,) spacing of the posts
    radius_m: float  # of that sphere
    highest_m: float  # highest post of all maps
    sag_per_m: float = 0.0  # half the curvature of a sight line in air

    @cached_property
    def record(self) -> Record:
        """Record of the maps for the compiled kernels."""
        return Record(
            "ground", self.grid.reshape(*self.grid.shape[:2], -1), self.heights, self.posts, self.tops, self.wide_tops,
            self.slopes, self.blocks, self.levels, self.slope_unit, self.post_m, self.radius_m, self.highest_m,
            self.sag_per_m,
        )  # fmt: skip


declare_record(
    "ground", "grid: float64[maps, numbers, coordinates]", "heights: float32[all_posts]", "posts: int64[maps, 3]",
    "tops: float32[all_blocks]", "wide_tops: float32[all_blocks]", "slopes: int8[all_blocks, 8]",
    "blocks: int64[maps, most_levels, 3]", "levels: int64[maps]", "slope_unit: float64[maps]", "post_m: float64[maps]",
    "radius: float64", "highest: float64", "sag: float64",
)  # fmt: skip
surfaces = kernel("surfaces", "ground: ground", "points: float64[n, 2]", "up: out float64[n]")


def pack_maps(site: Site, maps: Sequence[Raster], *, keep_voids: bool = False) -> Ground:
    """Ground of the `maps`, finest first, packed for tracing in the enu of the `site`.

    Voids have the ground of a coarser map, else the height of the nearest post. With `keep_voids` the latter have NaN,
    for tracing where the known ground ends.
    """
    heights, posts, tops, wide, slopes, blocks = [], [], [], [], [], []
    first_post, first_block = 0, 0
    units = []
    for number, height_map in enumerate(maps):
        h = height_map.heights_above_origin_m(site)
        voids = np.isnan(h)
        if voids.any():
            h = _fill_voids(h, voids, site, height_map, maps[number + 1 :])
            voids = np.isnan(h)
            known = h
            if voids.any():
                from scipy.ndimage import distance_transform_edt

                nearest = distance_transform_edt(voids, return_distances=False, return_indices=True)
                known = np.asarray(h[tuple(nearest)])
            h = h if keep_voids else known
        heights.append(h.ravel())
        posts.append((first_post, *h.shape))
        first_post += h.size
        sloping = known if keep_voids and voids.any() else h
        steepest = max(np.abs(sloping[:, 1:] - sloping[:, :-1]).max(), np.abs(sloping[1:] - sloping[:-1]).max())
        unit = max(float(steepest) * 2.05 / SLOPE_STEPS, 1e-6)  # across the corner too
        units.append(unit)
        block_table = []
        top, slope = _raise_to_finer_maps(_cell_tops(h), height_map, maps[:number], site), _cell_slopes(sloping, unit)
        while True:
            tops.append(top.ravel())
            wide.append(_spread_largest(top).ravel())
            slopes.append(_spread_largest(slope).reshape(-1, 8))
            block_table.append((first_block, *top.shape))
            first_block += top.size
            if max(top.shape) <= SMALLEST_BLOCKS:
                break
            top = merge_blocks(top, np.maximum)
            slope = merge_blocks(slope, np.maximum)
        blocks.append(block_table)
    most = max(len(table) for table in blocks)
    grid = [m.grid_numbers(site) for m in maps]
    most_numbers = max(map(len, grid))
    return Ground(
        grid=np.array([np.concatenate([one, np.zeros((most_numbers - len(one), *one.shape[1:]))]) for one in grid]),
        heights=np.concatenate(heights),
        posts=np.array(posts, dtype=np.int64),
        tops=np.concatenate(tops),
        wide_tops=np.concatenate(wide),
        slopes=np.concatenate(slopes),
        blocks=np.array([table + [table[-1]] * (most - len(table)) for table in blocks], dtype=np.int64),
        levels=np.array([len(table) for table in blocks], dtype=np.int64),
        slope_unit=np.array(units),
        post_m=np.array([m.post_m for m in maps]),
        radius_m=sphere_radius_m(site),
        highest_m=float(max(np.nanmax(part) for part in heights)),
    )


def fill_cut_out(raster: Raster, widest_m: float) -> Raster:
    """Map like `raster` without its voids that are no wider than `widest_m` [m], which known posts surround.

    What was cut out of the map, such as roofs and trees: the ground is linear between the posts around.
    """
    from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
    from scipy.ndimage import binary_dilation, find_objects, label

    voids = np.isnan(raster.heights_m)
    labels, _ = label(voids)
    heights, last = raster.heights_m.copy(), np.array(voids.shape) - 1
    for number, where in enumerate(find_objects(labels), 1):
        span = np.array([[part.start, part.stop - 1] for part in where])
        wide_m = (span[:, 1] - span[:, 0] + 1) * raster.spacings_m
        if (wide_m > widest_m).any() or (span[:, 0] == 0).any() or (span[:, 1] == last).any():
            continue
        around = tuple(slice(low - 1, high + 2) for low, high in span)
        own = labels[around] == number
        ring = np.argwhere(binary_dilation(own, np.ones((3, 3))) & ~voids[around])
        at, known = np.argwhere(own), heights[around][tuple(ring.T)]
        found = LinearNDInterpolator(ring * raster.spacings_m, known)(at * raster.spacings_m)
        beside = NearestNDInterpolator(ring, known)(at)  # of a post that the ring's hull does not hold
        heights[around][own] = np.where(np.isfinite(found), found, beside)
    return replace(raster, heights_m=heights)


def _fill_voids(
    h: NDArray[np.float32], voids: Bools, site: Site, height_map: Raster, coarser: Sequence[Raster]
) -> NDArray[np.float32]:
    """Heights (rows, columns) of a map with those of coarser maps in its voids, where they have any."""
    h, where = h.copy(), np.argwhere(voids).astype(np.float64)
    place = height_map.projection.latlon_from_xy(*height_map.xy(where))
    found = np.full(len(where), np.nan)
    for one in coarser:
        above = replace(one, heights_m=one.heights_above_origin_m(site))
        found = np.where(np.isnan(found), above.sample(above.row_column(*place)), found)
    h[voids] = found
    return h


def _cell_tops(h: NDArray[np.float32]) -> NDArray[np.float32]:
    """Highest post (rows - 1, columns - 1) of each cell between the posts `h` (rows, columns) [m]."""
    return np.maximum(np.maximum(h[:-1, :-1], h[:-1, 1:]), np.maximum(h[1:, :-1], h[1:, 1:]))


def _cell_slopes(h: NDArray[np.float32], unit: float) -> NDArray[np.int8]:
    """Slopes (rows, columns, 8): most fall, then most rise, per step along (1, 0), (0, 1), (1, 1), (-1, 1), in units.

    Steps are (column, row), units `unit` [m]. In a bilinear cell the rise along columns lies between those of its two
    edges, whatever the row, and so for rows.
    """
    h = h * np.float32(1 / unit)
    along, down = h[:, 1:] - h[:, :-1], h[1:] - h[:-1]
    low_c, high_c = np.minimum(along[:-1], along[1:]), np.maximum(along[:-1], along[1:])
    low_r, high_r = np.minimum(down[:, :-1], down[:, 1:]), np.maximum(down[:, :-1], down[:, 1:])
    out = np.empty((*low_c.shape, 8), dtype=np.int8)
    slack = np.float32(0.01)  # of a step: more than single precision can lose
    falls = -low_c, -low_r, -(low_c + low_r), high_c - low_r
    rises = high_c, high_r, high_c + high_r, high_r - low_c
    for k, most in enumerate((*falls, *rises)):
        out[..., k] = np.ceil(most + slack)
    return out


def merge_blocks(a: np.ndarray, choose: np.ufunc) -> np.ndarray:
    """Array (rows, columns, ...) at half the resolution: of two by two blocks the value that `choose` prefers."""
    a = np.pad(a, [(0, n % 2) for n in a.shape[:2]] + [(0, 0)] * (a.ndim - 2), mode="edge")
    return np.asarray(choose(choose(a[::2, ::2], a[1::2, ::2]), choose(a[::2, 1::2], a[1::2, 1::2])))


def _spread_largest(a: np.ndarray) -> np.ndarray:
    """Largest values (rows, columns, ...) of each block of `a` and its eight neighbours."""
    tall = a.copy()
    np.maximum(tall[1:], a[:-1], out=tall[1:])
    np.maximum(tall[:-1], a[1:], out=tall[:-1])
    wide = tall.copy()
    np.maximum(wide[:, 1:], tall[:, :-1], out=wide[:, 1:])
    np.maximum(wide[:, :-1], tall[:, 1:], out=wide[:, :-1])
    return wide


def _raise_to_finer_maps(
    tops: NDArray[np.float32], height_map: Raster, finer: Sequence[Raster], site: Site
) -> NDArray[np.float32]:
    """Copy of the `tops` of a coarse map's cells, raised to the posts of finer maps there or close by."""
    tops = tops.copy()
    for fine in finer:
        size = 1
        high = _cell_tops(fine.heights_above_origin_m(site))
        while size * fine.post_m < 0.5 * height_map.post_m and max(high.shape) > 1:
            high, size = merge_blocks(high, np.maximum), 2 * size
        rows, columns = (np.indices(high.shape) + 0.5) * size
        middles = np.stack([rows.ravel(), columns.ravel()], axis=-1)
        at = height_map.row_column(*fine.projection.latlon_from_xy(*fine.xy(middles)))
        reach = min(0.71 * size * fine.post_m / height_map.post_m + 0.01, 0.5)
        for d_row, d_column in ((-reach, -reach), (-reach, reach), (reach, -reach), (reach, reach)):
            cell = np.floor(at + np.array([d_row, d_column])).astype(np.int64)
            inside = ((cell >= 0) & (cell < tops.shape)).all(axis=-1)
            np.maximum.at(tops, tuple(cell[inside].T), high.ravel()[inside])
    return tops


def ground_up_m(site: Site, maps: Sequence[Raster], points_m: Array) -> Array:
    """Height (...) [m] in enu of the surface at east and north (..., 2) [m]; NaN where no map reaches."""
    east, north = points_m[..., 0], points_m[..., 1]
    up = np.zeros(np.shape(east))
    for _ in range(SURFACE_ROUNDS):
        lat, lon = latlon_from_enu(site, east, north, np.nan_to_num(up))
        height = np.full(np.shape(east), np.nan)
        for height_map in maps:
            missing = np.isnan(height)
            if not missing.any():
                break
            height = np.where(missing, height_map.sample(height_map.row_column(lat, lon)), height)
        up = enu_from_latlon(site, lat, lon, height)[..., 2]
    return np.asarray(up)


def cell_posts(site: Site, maps: Sequence[Raster], points_enu_m: Array) -> tuple[Ints, Array]:
    """Posts (n, 4) of the cells that hold `points_enu_m` (n, 3) in enu of a `site`, and their weights (n, 4), bilinear.

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
        corner = cell[new, None] + [[0, 0], [0, 1], [1, 0], [1, 1]]  # (row, column)
        post[new] = first + corner[..., 0] * columns + corner[..., 1]
        weight[new] = np.prod(1.0 - np.abs(at[new, None] - corner), axis=-1)
        first += raster.heights_m.size
    return post, weight


def number_of_maps(site: Site, maps: Sequence[Raster], points_enu_m: Array) -> Ints:
    """Number (n,) of the map that has the ground below points (n, 3) in enu, the finest first; -1 where none has."""
    latitude, longitude = latlon_from_enu(site, *points_enu_m.T)
    found = np.full(len(points_enu_m), -1)
    for number in reversed(range(len(maps))):
        known = np.isfinite(maps[number].sample(maps[number].row_column(latitude, longitude)))
        found[known] = number
    return found


def post_positions(site: Site, maps: Sequence[Raster], posts: Ints) -> Array:
    """Positions (n, 3) [m] in enu, east, north and up, of the `posts` (n,) at the heights of the maps."""
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
