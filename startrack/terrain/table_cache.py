"""Tables of horizons: loaded by a hash of all that they follow from, else traced once and kept; and what that costs."""

from __future__ import annotations

import hashlib
import logging
import os
import time as clock
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING
from weakref import WeakValueDictionary

import numpy as np

from startrack.core.errors import BadInput
from startrack.core.files import hold_lock
from startrack.core.limits import uncounted_time
from startrack.core.runner import count_cores
from startrack.core.stored import cache_folder, limit_bytes, read_sealed, remove_oldest, write_sealed
from startrack.core.types import Ints
from startrack.terrain.horizon_table import (
    AZIMUTH_BINS,
    FARTHEST,
    FIELDS,
    MIDDLES_RAD,
    NOT_KNOWN_M,
    HorizonTable,
    Square,
    fill_table,
    quantize_fields,
)
from startrack.terrain.map_ends import unknown_elevations_rad
from startrack.terrain.protocol import Progress

if TYPE_CHECKING:
    from startrack.terrain.traced_map import TracedMap

LOG = logging.getLogger(__name__)
FOLDER, SUFFIX = "horizons", ".table"  # of the tables in the cache
VERSION = 8  # of the tracing and of the table's format
PART_CELLS = 64  # at least, of a part that is traced and kept by itself: 0.5 MB

# Terrains that need the same table share one in memory, for as long as one of them lives.
TABLES_IN_MEMORY: WeakValueDictionary[str, HorizonTable] = WeakValueDictionary()
PROBES, PROBE_S = 24, 0.3  # parts that are measured; about how long all of them may take
ENDS_S = 1.0  # of the ends of the maps, for the table
# Of an image of 1024 px in a crater 12 km wide, with posts of 240, 60 and 15 m (5, 8 and 12 us a horizon), in search
# areas of 0.6 and 2.5 km: 1.7 to 3.4 s of CPU time, which few of its parts share out among cores.
FRAME_S, HORIZONS_OF_FRAME = 1.5, 100_000.0


def key_of_table(ground: TracedMap) -> str:
    """SHA-256 over the maps' posts and geometry, the origin, the square, the camera's height and the format."""
    digest = hashlib.sha256(f"startrack horizons {VERSION} {AZIMUTH_BINS}".encode())
    site, square = ground.site, ground.square
    numbers = [site.latitude_rad, site.longitude_rad, site.height_m, ground.camera_height_m]
    numbers += [square.reach_m, float(square.across), ground.search_radius_m]
    if ground.terrestrial_refraction_1 or ground.highest_beyond_m > -np.inf:
        numbers += [ground.terrestrial_refraction_1, ground.highest_beyond_m]
    digest.update(np.array(numbers).tobytes())
    for raster in ground.maps:
        digest.update(raster.place_bytes(site))
        digest.update(np.ascontiguousarray(raster.heights_m).data)
    return digest.hexdigest()


def path_of_table(key: str) -> Path:
    """File of the table with this key."""
    return cache_folder(FOLDER) / f"{key[:40]}{SUFFIX}"


def load_table(key: str, square: Square) -> HorizonTable | None:
    """The table of a `square` from memory or disk; None if there is none, or any byte of it has changed."""
    table = TABLES_IN_MEMORY.get(key)
    if table is None and (data := read_sealed(path_of_table(key))) is not None:
        unknown_rad = np.frombuffer(data, np.float64, AZIMUTH_BINS)
        values = np.frombuffer(data, np.uint16, offset=unknown_rad.nbytes).reshape(-1, AZIMUTH_BINS, FIELDS)
        TABLES_IN_MEMORY[key] = table = HorizonTable(square, values, unknown_rad)
        with suppress(OSError):  # the time of its last use, by which the oldest leave
            os.utime(path_of_table(key))
    return table


def keep_table(key: str, table: HorizonTable) -> bool:
    """Keep the table in memory and, if the folder can be written, on disk; return whether it can."""
    TABLES_IN_MEMORY[key] = table
    try:
        write_sealed(path_of_table(key), table.unknown_rad.tobytes() + table.values.tobytes())
    except BadInput:
        return False
    remove_oldest(path_of_table(key).parent, f"*{SUFFIX}", path_of_table(key))
    return True


def discard_table(key: str) -> None:
    """Remove the table from memory and disk."""
    TABLES_IN_MEMORY.pop(key, None)
    discard_parts(key)
    with suppress(OSError):
        path_of_table(key).unlink()


def path_of_part(key: str, cells: Ints) -> Path:
    """File of the part with these cells (k,), in order, of the table with this key; the name of a table, too."""
    path = path_of_table(key)
    return path.with_stem(f"{path.stem}-{cells[0]}-{cells[-1]}")


def discard_parts(key: str) -> None:
    """Remove the parts of the table with this key."""
    path = path_of_table(key)
    for part in path.parent.glob(f"{path.stem}-*{SUFFIX}"):
        with suppress(OSError):
            part.unlink()


def load_or_build_table(ground: TracedMap, progress: Progress | None = None) -> HorizonTable:
    """The table of the ground from memory or disk, else computed and kept. Of several processes one computes it."""
    key = ground.table_key
    table = load_table(key, ground.square)
    if table is not None:
        return table
    with _single_builder(path_of_table(key).with_suffix(".lock"), ground.name):
        table = load_table(key, ground.square)
        if table is None:
            if os.path.lexists(path_of_table(key)):
                LOG.warning("the table of horizons %s is damaged: made anew", path_of_table(key))
            limit_bytes()  # a wrong one is refused before the work
            about_s = seconds_of_table(ground)
            about = f"{float(f'{about_s:.2g}'):g}"  # no power of ten
            LOG.info("horizons of %s: computed now, once; this takes about %s s", ground.name, about)
            start = clock.perf_counter()
            with uncounted_time():
                table = build_table(ground, progress)
            is_kept, path = keep_table(key, table), path_of_table(key)
            discard_parts(key)
            is_kept = is_kept or keep_table(key, table)  # with the room on the disk that the parts had
            where = f"kept in {path}" if is_kept else f"not kept: {path.parent} cannot be written"
            LOG.debug("horizons of %s: done in %.0f s, %s", ground.name, clock.perf_counter() - start, where)
        return table


@contextmanager
def _single_builder(path: Path, name: str) -> Iterator[None]:
    """Context in which this process alone makes the table; others wait until it is done or has died.

    Where files cannot be locked (a read-only folder, some network disks) no process waits, and each makes its own.
    """
    text = f"horizons of {name}: another process works them out, waiting for it"
    with ExitStack() as stack:
        with suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            stack.enter_context(hold_lock(path, on_wait=lambda: LOG.info(text)))
        yield


def build_table(ground: TracedMap, progress: Progress | None = None) -> HorizonTable:
    """The table of the ground, traced on all cores: the kernels release Python's lock.

    Cells that contain no position within reach have bounds of -+ pi/2. Parts of it that are traced lie on disk, if that
    takes them, so that a build that was stopped goes on where it was.
    """
    square, packed, height_m = ground.square, ground.ground.record, ground.camera_height_m
    values = np.zeros((square.across**2, AZIMUTH_BINS, FIELDS), dtype=np.uint16)
    values[..., 1] = values[..., 3] = FARTHEST
    values[..., 8] = np.array(NOT_KNOWN_M, dtype=np.int16).view(np.uint16)
    centres, half_turn = square.centres_m, np.pi / AZIMUTH_BINS
    sines, cosines = np.sin(MIDDLES_RAD), np.cos(MIDDLES_RAD)
    cells = square.cells_within_reach
    done = 0

    def fill_part(part: Ints) -> int:
        """Write the fields of cells (k,) to `values`, traced or from disk; return the number of these cells."""
        path = path_of_part(ground.table_key, part)
        kept = read_sealed(path)
        if kept is not None:
            values[part] = np.frombuffer(kept, np.uint16).reshape(-1, AZIMUTH_BINS, FIELDS)
            return len(part)
        found = np.empty((len(part), AZIMUTH_BINS, FIELDS))
        fill_table(packed, centres[part], square.half_m, height_m, sines, cosines, half_turn, found)
        values[part] = quantize_fields(found)
        with suppress(BadInput):
            write_sealed(path, values[part].tobytes())
        return len(part)

    pool = ThreadPoolExecutor(count_cores())
    try:
        for count in pool.map(fill_part, np.array_split(cells, max(1, len(cells) // PART_CELLS))):
            done += count
            if progress is not None:
                progress(done, len(cells))
    finally:
        pool.shutdown(cancel_futures=True)  # an interrupted build does not wait for the other parts
    return HorizonTable(square, values, unknown_elevations_rad(ground))


def costs_of(ground: TracedMap) -> dict[str, float]:
    """Times [s] of a `ground`, as `Terrain.costs_s` names them."""
    table = {} if ground.is_prepared else {"horizons": seconds_of_table(ground)}
    return table | {"frame": seconds_of_frame(ground)}


def seconds_of_table(ground: TracedMap) -> float:
    """Time [s] that the table of horizons of a `ground` takes on all cores, by cells all over it."""
    square, cells = ground.square, ground.square.cells_within_reach
    sines, cosines, found = np.sin(MIDDLES_RAD), np.cos(MIDDLES_RAD), np.empty((1, AZIMUTH_BINS, FIELDS))

    def trace(part: float) -> None:
        cell = cells[int(part * len(cells))]
        place = square.centres_m[cell : cell + 1], square.half_m, ground.camera_height_m
        fill_table(ground.ground.record, *place, sines, cosines, np.pi / AZIMUTH_BINS, found)

    return ENDS_S + _mean_seconds(trace) * len(cells) / count_cores()


def seconds_of_frame(ground: TracedMap) -> float:
    """Time [s] that the position of an image on a `ground` takes, by horizons seen from places all over it."""
    whole = ground.without_table()

    def trace(part: float) -> None:
        radius_m = ground.search_radius_m * np.sqrt(part)
        turn = 2.4 * PROBES * part  # the golden angle, nearly
        whole.horizons(radius_m * np.array([np.sin(turn), np.cos(turn)]), MIDDLES_RAD)

    return FRAME_S + _mean_seconds(trace) / AZIMUTH_BINS * HORIZONS_OF_FRAME


def _mean_seconds(work: Callable[[float], None]) -> float:
    """Mean time [s] of `work` on parts all over the whole, which it takes by a number from 0 to 1."""
    parts = [(0.618 * number + 0.5) % 1.0 for number in range(PROBES)]  # evenly spread, the first of them too
    start, done = clock.perf_counter(), 0
    while done < PROBES and clock.perf_counter() - start < PROBE_S:
        work(parts[done])
        done += 1
    return (clock.perf_counter() - start) / done
