"""The folders of what startrack keeps between runs, and their limit."""

from __future__ import annotations

import os
import stat
import tempfile
from contextlib import suppress
from pathlib import Path

from startrack.core.errors import BadInput

LIMIT_VARIABLE = "STARTRACK_CACHE_GB"
LIMIT_GB = 2.0  # without the variable: fifteen tables of the largest kind
GB = 1e9


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
    """The most that tables of horizons take on the disk. Raises BadInput bad_terrain for a variable that is no size."""
    text = os.environ.get(LIMIT_VARIABLE) or str(LIMIT_GB)
    with suppress(ValueError):
        if float(text) >= 0.0:  # False for NaN
            return GB * float(text)
    raise BadInput("bad_terrain", f"{LIMIT_VARIABLE}={text[:20]}: is no size in GB, such as {LIMIT_GB:g}")


def remove_oldest(folder: Path, pattern: str, newest: Path) -> None:
    """Remove files of the `pattern`, the one that was used first first, until all take the limit at most.

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
