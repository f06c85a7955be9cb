"""The table of horizons of a height map: loaded from memory or disk, else traced once and kept."""

from __future__ import annotations

import logging
import time as clock
from typing import TYPE_CHECKING

import numpy as np

from startrack.core.types import Array, Ints
from startrack.terrain import table_cache as cache
from startrack.terrain import tracing
from startrack.terrain.horizon_table import BINS, HorizonTable, build_table
from startrack.terrain.protocol import Progress

if TYPE_CHECKING:
    from startrack.terrain.height_map import HeightMap

LOG = logging.getLogger(__name__)
UNKNOWN_FROM = 12  # points across the square at which the ends of the maps are looked up


def load_or_build_table(terrain: HeightMap, key: str, progress: Progress | None = None) -> HorizonTable:
    """The table of a terrain from memory or disk under its key, else computed and kept."""
    table = cache.load_table(key, terrain.square)
    if table is None:
        with cache.single_builder(key, terrain.name):
            table = cache.load_table(key, terrain.square) or _build_and_keep(terrain, key, progress)
    return table


def _build_and_keep(terrain: HeightMap, key: str, progress: Progress | None) -> HorizonTable:
    LOG.info("horizons of %s: computed now, once; this takes a minute or two", terrain.name)
    start = clock.perf_counter()
    table = _build(terrain, progress)
    path = cache.keep_table(key, table)
    where = f"kept in {path}" if path else f"not kept: {cache.cache_dir()} cannot be written"
    LOG.debug("horizons of %s: done in %.0f s, %s", terrain.name, clock.perf_counter() - start, where)
    return table


def _build(terrain: HeightMap, progress: Progress | None) -> HorizonTable:
    square = terrain.square
    centres = square.centres_m
    wanted = np.hypot(*centres.T) < terrain.reach_m + 1.42 * square.half_m  # all that contain a position within reach
    middles = (np.arange(BINS) + 0.5) * 2 * np.pi / BINS

    def fill(cells: Ints) -> Array:
        return tracing.trace_cells(terrain, centres[cells], square.half_m, middles, np.pi / BINS)

    return build_table(square, wanted, fill, _unknown_rad(terrain), progress)


def _unknown_rad(terrain: HeightMap) -> Array:
    """(BINS,) elevation below which ground beyond the maps might be seen from somewhere in the search area."""
    line = np.linspace(-1, 1, UNKNOWN_FROM) * terrain.search_radius_m
    places = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    places = places[np.hypot(*places.T) <= terrain.search_radius_m]
    azimuths = np.repeat((np.arange(BINS)[:, None] + [0.02, 0.5, 0.98]).ravel(), len(places)) * 2 * np.pi / BINS
    where = np.tile(places, (3 * BINS, 1))
    tan, _, edge = terrain.horizons(where, azimuths)
    up = terrain.ground_m(places) + terrain.camera_height_m
    away = where + edge[:, None] * np.stack([np.sin(azimuths), np.cos(azimuths)], axis=-1)
    drop = np.sum(np.minimum(np.abs(away), 1e7) ** 2, axis=-1) / (2 * terrain.ground.radius_m)
    possible = (terrain.ground.highest_m - drop - np.tile(up, 3 * BINS)) / edge
    unknown = np.where((edge < 1e9) & (possible > tan), np.arctan(possible), -np.pi / 2)
    return np.asarray(unknown.reshape(BINS, -1).max(axis=1))
