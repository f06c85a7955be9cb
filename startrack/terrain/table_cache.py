"""Tables of horizons kept on disk, by a hash of all that they follow from."""

from __future__ import annotations

import hashlib
import logging
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING
from zipfile import BadZipFile

import numpy as np

from startrack.terrain.horizon_table import BINS, FIELDS, HorizonTable, Square

if TYPE_CHECKING:
    from startrack.terrain.height_map import HeightMap

LOG = logging.getLogger(__name__)
VERSION = 2  # of the tracing and of the table's format


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
    for height_map in terrain.maps:
        digest.update(height_map.grid_numbers(site).tobytes())
        digest.update(np.ascontiguousarray(height_map.heights_m).data)
    return digest.hexdigest()


def path_of(key: str) -> Path:
    """Where the table of a key is kept."""
    return cache_dir() / f"{key[:40]}.npz"


def loaded(key: str, square: Square) -> HorizonTable | None:
    """The table of a key; None where there is none, or none that can be read."""
    try:
        with np.load(path_of(key), allow_pickle=False) as file:
            values, unknown = file["values"], file["unknown_rad"]
    except (OSError, ValueError, KeyError, EOFError, BadZipFile):
        return None
    if values.shape != (square.across**2, BINS, FIELDS) or unknown.shape != (BINS,):
        return None
    return HorizonTable(square, values, unknown)


def save(key: str, table: HorizonTable) -> Path | None:
    """Keep the table, whole or not at all; None where the folder cannot be written (the table is then made again)."""
    path = path_of(key)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=".making-", suffix=".npz")
        try:
            with os.fdopen(handle, "wb") as file:
                np.savez(file, values=table.values, unknown_rad=table.unknown_rad)
            os.replace(name, path)
        except BaseException:
            Path(name).unlink(missing_ok=True)
            raise
    except OSError:
        return None
    return path


@contextmanager
def one_at_a_time(key: str, name: str) -> Iterator[None]:
    """Within, this process alone makes the table of the key; others that come here wait until it is done or has died.

    Where files cannot be locked (a folder that cannot be written, some network disks, Windows) nobody waits: the table
    is then made by each.
    """
    handle = _locked(path_of(key).with_suffix(".lock"), name)
    try:
        yield
    finally:
        if handle is not None:
            path_of(key).with_suffix(".lock").unlink(missing_ok=True)
            os.close(handle)


def _locked(path: Path, name: str) -> int | None:
    """An open file that is locked while it is open; None where there are no locks."""
    try:
        import fcntl
    except ImportError:
        return None
    handle = -1
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        while True:
            handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                LOG.info("horizons of %s: another process works them out, waiting for it", name)
                fcntl.flock(handle, fcntl.LOCK_EX)
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(handle), path.stat()):
                    return handle
            os.close(handle)  # its last owner has removed the file: what is locked is no longer what others see
            handle = -1
    except OSError:
        if handle >= 0:
            os.close(handle)
        return None
