"""numba's cache of compiled kernels: where it lies, and whether this machine has compiled them already.

The kernels are compiled at their first use after an installation and then loaded from the cache. numba writes the
cache beside the package; where that folder is read-only, NUMBA_CACHE_DIR is set to a folder of the user's.
"""

from __future__ import annotations

import atexit
import logging
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from startrack.files import PACKAGE

LOG = logging.getLogger(__name__)
VARIABLE = "NUMBA_CACHE_DIR"
KERNEL_MARK = b"@njit("
TERRAIN = PACKAGE / "terrain"  # kernels that only height maps need; all others serve every terrain
CYLINDER_S, HEIGHT_MAP_S = 15, 40  # of one core, from an empty cache to the first fix


def choose_cache_folder() -> None:
    """Set NUMBA_CACHE_DIR unless numba can write beside the package, or the variable is set. Called before numba loads.

    Without any folder to write to, the cache is temporary: without one numba would refuse to load the kernels.
    """
    if VARIABLE in os.environ or os.access(PACKAGE, os.W_OK):
        return
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "startrack" / "numba"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError:
        # A fresh folder that only this user can write to: numba unpickles what it finds in its cache.
        folder = Path(tempfile.mkdtemp(prefix="startrack-numba-"))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
    os.environ[VARIABLE] = str(folder)


@cache
def announce(*, height_map: bool) -> bool:
    """Log one line if the next fix has to compile its kernels first, once a process; whether it has to.

    Args:
        height_map: Whether the terrain is a height map, which needs further kernels.
    """
    seconds = 0
    if not _any_compiled(path for path in _kernel_files() if TERRAIN not in path.parents):
        seconds = CYLINDER_S
    if height_map and not _any_compiled(path for path in _kernel_files() if TERRAIN in path.parents):
        seconds = HEIGHT_MAP_S
    if seconds:
        LOG.warning("compiling for this machine, once: about %d s", seconds)
    return bool(seconds)


def _kernel_files() -> Iterator[Path]:
    """Sources with kernels that numba compiles."""
    return (path for path in sorted(PACKAGE.rglob("*.py")) if KERNEL_MARK in path.read_bytes())


def _any_compiled(sources: Iterator[Path]) -> bool:
    """Whether numba's cache holds a kernel of any of the sources for this Python, compiled since the source changed."""
    return any(index.stat().st_mtime >= source.stat().st_mtime for source in sources for index in _indices_of(source))


def _indices_of(source: Path) -> Iterator[Path]:
    """numba's index files of a source: MODULE.FUNCTION-LINE.pyXY.nbi, in __pycache__ or below NUMBA_CACHE_DIR."""
    name = f"{source.stem}.*.py{sys.version_info.major}{sys.version_info.minor}.nbi"
    folder = os.environ.get(VARIABLE)
    return Path(folder).glob(f"*/{name}") if folder else (source.parent / "__pycache__").glob(name)
