"""Files that a later run reads again: their folders and the limit of these, data with their hash, and JSON."""

from __future__ import annotations

import hashlib
import json
import os
import stat
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any

from startrack.core.declaration import LARGEST
from startrack.core.errors import BadInput
from startrack.core.files import FilePath, write_atomically

SEAL_BYTES = hashlib.sha256().digest_size
LIMIT_VARIABLE = "STARTRACK_CACHE_GB"
LIMIT_GB = 2.0  # without the variable: fifteen tables of the largest kind
GB = 1e9


def write_sealed(path: FilePath, data: bytes) -> None:
    """Write `data` and behind them their SHA-256 in the place of a file at `path`. Raises as `write_atomically`.

    An archive or a pickle with that hash opens as without.
    """
    write_atomically(path, data + hashlib.sha256(data).digest(), overwrite=True)


def read_sealed(path: FilePath) -> bytearray | None:
    """The data that `write_sealed` wrote to `path`; None where there is no such file, or any byte of it has changed."""
    try:
        if not os.path.isfile(path):  # reading a pipe would block
            return None
        with open(path, "rb") as file:
            data = bytearray(os.fstat(file.fileno()).st_size)  # read in place: tables of horizons have 130 MB
            file.readinto(data)
    except OSError:
        return None
    seal = bytes(data[-SEAL_BYTES:])
    del data[-SEAL_BYTES:]
    return data if hashlib.sha256(data).digest() == seal else None


def read_json_object(path: FilePath) -> dict[str, Any] | None:
    """The JSON object in the file at `path`; None if it cannot be read, or is nested too deep."""
    try:
        found = json.loads(Path(path).read_text(encoding="utf-8")) if os.path.isfile(path) else None
    except (OSError, ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def finite_json(text: str | bytes) -> Any:
    """Content of a JSON `text`; None for NaN and infinity, which JSON has not, and for numbers larger than any of ours.

    Raises ValueError or RecursionError for what is no JSON.
    """

    def usual(digits: str) -> float | int | None:
        value = float(digits)
        return None if abs(value) > LARGEST else value if {*digits} & {*".eE"} else int(digits)

    return json.loads(text, parse_constant=lambda _: None, parse_float=usual, parse_int=usual)


def cache_folder(kind: str) -> Path:
    """Folder of the files of a `kind`: $XDG_CACHE_HOME/startrack/KIND, or ~/.cache/startrack/KIND.

    For a user without a home it lies in a temporary folder that is this user's alone. Without such a one it is a path
    that takes no file.
    """
    base = os.environ.get("XDG_CACHE_HOME")
    if base:
        return Path(base) / "startrack" / kind
    try:
        return Path.home() / ".cache" / "startrack" / kind
    except RuntimeError:  # HOME is not set, and the system does not know the user
        return _temporary_folder() / kind


def _temporary_folder() -> Path:
    """A folder that only this user can write to, the same in each process: others could change positions there."""
    owner = os.getuid() if hasattr(os, "getuid") else 0  # as st_uid is on Windows
    try:
        folder = Path(tempfile.gettempdir()) / f"startrack-{owner}"
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
    except OSError:  # no folder can be written to
        return Path(os.devnull)
    is_own = stat.S_ISDIR(status.st_mode) and status.st_uid == owner and not status.st_mode & 0o022
    return folder if is_own or os.name == "nt" else Path(os.devnull)


def limit_bytes() -> float:
    """Largest size [bytes] of all horizon tables on disk. Raises BadInput bad_terrain for what is no size."""
    text = os.environ.get(LIMIT_VARIABLE) or str(LIMIT_GB)
    with suppress(ValueError):
        if float(text) >= 0.0:  # False for NaN
            return GB * float(text)
    raise BadInput("bad_terrain", f"{LIMIT_VARIABLE}={text[:20]}: is no size in GB, such as {LIMIT_GB:g}")


def remove_oldest(folder: Path, pattern: str, newest: Path) -> None:
    """Remove files of the `pattern` from `folder`, the least recently used first, until the rest keep within the limit.

    The `newest` stays, whatever its size. What cannot be listed or removed stays.
    """
    found = []
    for path in folder.glob(pattern):
        with suppress(OSError):  # another process removes as well
            status = path.stat()
            found.append((status.st_mtime, status.st_size, path))
    excess = sum(size for _, size, _ in found) - limit_bytes()
    for _, size, path in sorted(found):
        if excess > 0 and path != newest:
            excess -= size
            with suppress(OSError):
                path.unlink()
