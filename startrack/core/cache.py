"""The folders of what startrack keeps between runs."""

from __future__ import annotations

import os
import stat
import tempfile
from pathlib import Path


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
    """A folder that only this user can write to, the same in each process: code is loaded from files in it."""
    owner = os.getuid() if hasattr(os, "getuid") else 0  # as st_uid is on Windows
    try:
        folder = Path(tempfile.gettempdir()) / f"startrack-{owner}"
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
    except OSError:  # no folder can be written to
        return Path(os.devnull)
    is_own = stat.S_ISDIR(status.st_mode) and status.st_uid == owner and not status.st_mode & 0o022
    return folder if is_own or os.name == "nt" else Path(os.devnull)
