"""numba's cache of compiled kernels: where it lies, and what of it is of other sources.

The kernels are compiled at their first use after an installation and then loaded from the cache. It lies in a folder
of the user's, as numba's NUMBA_CACHE_DIR is set, so that nothing stays of a package that is removed; of a checkout that
can be written to beside the sources.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from startrack import __version__
from startrack.core.cache import cache_folder
from startrack.core.files import PACKAGE, data_dir

FOLDER = "numba"  # in the user's cache
VARIABLE = "NUMBA_CACHE_DIR"
ABOVE_KERNELS = {  # no kernel of numba is in these packages, or uses them
    "api", "applications", "chain", "cli", "evidence", "exposure", "kernels", "localization", "output", "rendering",
    "simulation",
}  # fmt: skip


def choose_cache_folder() -> bool:
    """Set NUMBA_CACHE_DIR unless the package is a checkout, or the variable is set. Called before numba loads.

    Without a folder that stays, the cache is temporary. False where no folder at all can be written to: numba would
    then refuse to load kernels that are to be kept.
    """
    is_checkout = data_dir("calib").parent == PACKAGE.parent
    if VARIABLE in os.environ or (is_checkout and os.access(PACKAGE, os.W_OK)):
        return True
    folder = cache_folder(FOLDER)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError:
        try:  # a fresh folder that only this user can write to: numba unpickles the files in its cache
            folder = Path(tempfile.mkdtemp(prefix="startrack-numba-"))
        except OSError:
            return False
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
    os.environ[VARIABLE] = str(folder)
    return True


def discard_stale_kernels() -> None:
    """Have numba forget the kernels that it compiled from other sources of startrack than these.

    numba compares only the file of a kernel itself, by size and time, and neither those of the kernels that it calls
    nor the types of its arguments. Called before numba loads.
    """
    key = hashlib.sha256(__version__.encode())
    sources = sorted(p for p in PACKAGE.rglob("*.py") if p.relative_to(PACKAGE).parts[0] not in ABOVE_KERNELS)
    for source in sources:
        status = source.stat()
        key.update(f"{source.name} {status.st_size} {status.st_mtime_ns}".encode())
    file = _key_file()
    with suppress(OSError):  # another process may be doing the same
        if file.is_file() and file.read_text() == key.hexdigest():
            return
        for source in sources:
            for index in _indices_of(source):
                index.unlink(missing_ok=True)
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(key.hexdigest())


def _indices_of(source: Path) -> Iterator[Path]:
    """numba's index files of a source: MODULE.FUNCTION-LINE.pyXY.nbi, in __pycache__ or below NUMBA_CACHE_DIR."""
    name = f"{source.stem}.*.py{sys.version_info.major}{sys.version_info.minor}.nbi"
    return _cache_of(source.parent).glob(name)


def _cache_of(folder: Path) -> Path:
    """Where numba keeps the compiled code of the sources in a `folder`."""
    named = os.environ.get(VARIABLE)
    if not named:
        return folder / "__pycache__"
    of_folder = hashlib.sha1(str(folder).encode(), usedforsecurity=False).hexdigest()
    return Path(named) / f"{folder.name}_{of_folder}"


def _key_file() -> Path:
    """The file with the key of the sources that the compiled code is of."""
    name = f"startrack-{hashlib.sha256(str(PACKAGE).encode()).hexdigest()[:12]}.key"
    return Path(os.environ.get(VARIABLE) or PACKAGE / "__pycache__") / name
