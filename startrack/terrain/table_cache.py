"""Tables of horizons, kept on disk and in memory by a hash of all that they follow from."""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING
from weakref import WeakValueDictionary
from zipfile import BadZipFile

import numpy as np

from startrack.core.files import atomic_file, hold_lock
from startrack.terrain.horizon_table import BINS, FIELDS, HorizonTable, Square

if TYPE_CHECKING:
    from startrack.terrain.height_map import HeightMap

LOG = logging.getLogger(__name__)
VERSION = 3  # of the tracing and of the table's format

# Terrains that need the same table share one in memory, for as long as one of them lives.
TABLES_IN_MEMORY: WeakValueDictionary[str, HorizonTable] = WeakValueDictionary()


def cache_dir() -> Path:
    """Folder of the tables: $XDG_CACHE_HOME/startrack/horizons, or ~/.cache/startrack/horizons."""
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / "startrack" / "horizons"


def key_of(terrain: HeightMap) -> str:
    """SHA-256 over the maps' posts and geometry, the origin, the square, the camera's height and the format."""
    digest = hashlib.sha256(f"startrack horizons {VERSION} {BINS}".encode())
    site = terrain.site
    numbers = [site.latitude_rad, site.longitude_rad, site.height_m, terrain.camera_height_m]
    numbers += [terrain.reach_m, float(terrain.square.across), terrain.search_radius_m]
    digest.update(np.array(numbers).tobytes())
    for raster in terrain.maps:
        digest.update(raster.grid_numbers(site).tobytes())
        digest.update(np.ascontiguousarray(raster.heights_m).data)
    return digest.hexdigest()


def path_of(key: str) -> Path:
    """File of the table of a key."""
    return cache_dir() / f"{key[:40]}.npz"


def load_table(key: str, square: Square) -> HorizonTable | None:
    """The table of a key from memory or disk; None if there is none that can be read."""
    table = TABLES_IN_MEMORY.get(key)
    if table is None:
        table = _read_table(path_of(key), square)
        if table is not None:
            TABLES_IN_MEMORY[key] = table
    return table


def _read_table(path: Path, square: Square) -> HorizonTable | None:
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            values, unknown = arrays["values"], arrays["unknown_rad"]
    except (OSError, ValueError, KeyError, EOFError, BadZipFile):
        return None
    if values.shape != (square.across**2, BINS, FIELDS) or unknown.shape != (BINS,):
        return None
    return HorizonTable(square, values, unknown)


def keep_table(key: str, table: HorizonTable) -> Path | None:
    """Keep the table in memory and, if the folder can be written, in the file that is returned."""
    TABLES_IN_MEMORY[key] = table
    path = path_of(key)
    try:
        with atomic_file(path) as temporary, temporary.open("xb") as file:
            np.savez(file, values=table.values, unknown_rad=table.unknown_rad)
    except OSError:
        return None
    return path


def discard_table(key: str) -> None:
    """Remove the table from memory and disk."""
    TABLES_IN_MEMORY.pop(key, None)
    with suppress(OSError):
        path_of(key).unlink()


@contextmanager
def single_builder(key: str, name: str) -> Iterator[None]:
    """Within the block this process alone makes the table of the key; others wait until it is done or has died.

    Where files cannot be locked (a read-only folder, some network disks) no process waits, and each makes its own.
    """
    path = path_of(key).with_suffix(".lock")

    def announce() -> None:
        LOG.info("horizons of %s: another process works them out, waiting for it", name)

    with ExitStack() as stack:
        with suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            stack.enter_context(hold_lock(path, on_wait=announce))
        yield
