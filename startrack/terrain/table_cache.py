"""Tables of horizons: loaded from memory or disk by a hash of all that they follow from, else traced once and kept."""

from __future__ import annotations

import hashlib
import logging
import os
import time as clock
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from weakref import WeakValueDictionary
from zipfile import BadZipFile

import numpy as np

from startrack.core.files import atomic_file, hold_lock
from startrack.core.types import Array, Ints
from startrack.frames import Site
from startrack.terrain.horizon_table import (
    AZIMUTH_BINS,
    FARTHEST,
    FIELDS,
    NOT_KNOWN_M,
    HorizonTable,
    Square,
    quantize_fields,
)
from startrack.terrain.protocol import Progress
from startrack.terrain.raster import Raster
from startrack.terrain.tracing import Tracer, cpu_count

LOG = logging.getLogger(__name__)
VERSION = 3  # of the tracing and of the table's format
UNKNOWN_FROM = 12  # points across the square at which the ends of the maps are looked up

# Terrains that need the same table share one in memory, for as long as one of them lives.
TABLES_IN_MEMORY: WeakValueDictionary[str, HorizonTable] = WeakValueDictionary()


def cache_dir() -> Path:
    """Folder of the tables: $XDG_CACHE_HOME/startrack/horizons, or ~/.cache/startrack/horizons."""
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / "startrack" / "horizons"


@dataclass(frozen=True, eq=False, kw_only=True)
class KeptTable:
    """The table of some maps, a search area and a height of the camera, kept in memory and on disk."""

    name: str  # of the terrain, for the log
    site: Site
    maps: tuple[Raster, ...]
    camera_height_m: float
    search_radius_m: float
    square: Square

    @cached_property
    def key(self) -> str:
        """SHA-256 over the maps' posts and geometry, the origin, the square, the camera's height and the format."""
        digest = hashlib.sha256(f"startrack horizons {VERSION} {AZIMUTH_BINS}".encode())
        numbers = [self.site.latitude_rad, self.site.longitude_rad, self.site.height_m, self.camera_height_m]
        numbers += [self.square.reach_m, float(self.square.across), self.search_radius_m]
        digest.update(np.array(numbers).tobytes())
        for raster in self.maps:
            digest.update(raster.grid_numbers(self.site).tobytes())
            digest.update(np.ascontiguousarray(raster.heights_m).data)
        return digest.hexdigest()

    @property
    def path(self) -> Path:
        """File of the table."""
        return cache_dir() / f"{self.key[:40]}.npz"

    @property
    def in_memory(self) -> HorizonTable | None:
        """The table, where some terrain of this process has it already."""
        return TABLES_IN_MEMORY.get(self.key)

    def load(self) -> HorizonTable | None:
        """The table from memory or disk; None if there is none that can be read."""
        table = self.in_memory
        if table is None:
            try:
                with self.path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
                    values, unknown = arrays["values"], arrays["unknown_rad"]
            except (OSError, ValueError, KeyError, EOFError, BadZipFile):
                return None
            if values.shape != (self.square.across**2, AZIMUTH_BINS, FIELDS) or unknown.shape != (AZIMUTH_BINS,):
                return None
            TABLES_IN_MEMORY[self.key] = table = HorizonTable(self.square, values, unknown)
        return table

    def load_or_build(self, tracer: Tracer, progress: Progress | None = None) -> HorizonTable:
        """The table from memory or disk, else computed and kept. Of several processes one computes it."""
        table = self.load()
        if table is None:
            with self._single_builder():
                table = self.load() or self._build_and_keep(tracer, progress)
        return table

    def _build_and_keep(self, tracer: Tracer, progress: Progress | None) -> HorizonTable:
        LOG.info("horizons of %s: computed now, once; this takes a minute or two", self.name)
        start = clock.perf_counter()
        table = build_table(tracer, self.square, self.search_radius_m, progress)
        where = f"kept in {self.path}" if self.keep(table) else f"not kept: {cache_dir()} cannot be written"
        LOG.debug("horizons of %s: done in %.0f s, %s", self.name, clock.perf_counter() - start, where)
        return table

    def keep(self, table: HorizonTable) -> bool:
        """Keep the table in memory and, if the folder can be written, on disk; whether it can."""
        TABLES_IN_MEMORY[self.key] = table
        try:
            with atomic_file(self.path) as temporary, temporary.open("xb") as file:
                np.savez(file, values=table.values, unknown_rad=table.unknown_rad)
        except OSError:
            return False
        return True

    def discard(self) -> None:
        """Remove the table from memory and disk."""
        TABLES_IN_MEMORY.pop(self.key, None)
        with suppress(OSError):
            self.path.unlink()

    @contextmanager
    def _single_builder(self) -> Iterator[None]:
        """Within the block this process alone makes the table; others wait until it is done or has died.

        Where files cannot be locked (a read-only folder, some network disks) no process waits, and each makes its own.
        """
        path = self.path.with_suffix(".lock")

        def announce() -> None:
            LOG.info("horizons of %s: another process works them out, waiting for it", self.name)

        with ExitStack() as stack:
            with suppress(OSError):
                path.parent.mkdir(parents=True, exist_ok=True)
                stack.enter_context(hold_lock(path, on_wait=announce))
            yield


def build_table(
    tracer: Tracer, square: Square, search_radius_m: float, progress: Progress | None = None
) -> HorizonTable:
    """The table of a square, traced on all cores: the kernels release Python's lock.

    Cells that contain no position within reach have bounds of -+ pi/2.
    """
    values = np.zeros((square.across**2, AZIMUTH_BINS, FIELDS), dtype=np.uint16)
    values[..., 1] = values[..., 3] = FARTHEST
    values[..., 8] = np.array(NOT_KNOWN_M, dtype=np.int16).view(np.uint16)
    centres, middles = square.centres_m, (np.arange(AZIMUTH_BINS) + 0.5) * 2 * np.pi / AZIMUTH_BINS
    cells = np.flatnonzero(np.hypot(*centres.T) < square.reach_m + 1.42 * square.half_m)
    done = 0

    def trace(part: Ints) -> int:
        values[part] = quantize_fields(tracer.cell_fields(centres[part], square.half_m, middles, np.pi / AZIMUTH_BINS))
        return len(part)

    pool = ThreadPoolExecutor(cpu_count())
    try:
        for count in pool.map(trace, np.array_split(cells, max(1, len(cells) // 64))):
            done += count
            if progress is not None:
                progress(done, len(cells))
    finally:
        pool.shutdown(cancel_futures=True)  # an interrupted build does not wait for the other parts
    return HorizonTable(square, values, _unknown_rad(tracer, search_radius_m))


def _unknown_rad(tracer: Tracer, radius_m: float) -> Array:
    """(AZIMUTH_BINS,) elevation below which ground beyond the maps might be seen from somewhere in the search area."""
    line = np.linspace(-1, 1, UNKNOWN_FROM) * radius_m
    places = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    places = places[np.hypot(*places.T) <= radius_m]
    azimuths = (
        np.repeat((np.arange(AZIMUTH_BINS)[:, None] + [0.02, 0.5, 0.98]).ravel(), len(places))
        * 2
        * np.pi
        / AZIMUTH_BINS
    )
    where = np.tile(places, (3 * AZIMUTH_BINS, 1))
    tan, _, edge = tracer.horizons(None, where, azimuths)
    up = tracer.heights_m(places) + tracer.camera_height_m
    away = where + edge[:, None] * np.stack([np.sin(azimuths), np.cos(azimuths)], axis=-1)
    drop = np.sum(np.minimum(np.abs(away), 1e7) ** 2, axis=-1) / (2 * tracer.ground.radius_m)
    possible = (tracer.ground.highest_m - drop - np.tile(up, 3 * AZIMUTH_BINS)) / edge
    unknown = np.where((edge < 1e9) & (possible > tan), np.arctan(possible), -np.pi / 2)
    return np.asarray(unknown.reshape(AZIMUTH_BINS, -1).max(axis=1))
