"""numba's cache of compiled kernels: where it lies, and whether this machine has compiled them already.

The kernels are compiled at their first use after an installation and then loaded from the cache. It lies in a folder
of the user's, as numba's NUMBA_CACHE_DIR is set, so that nothing stays of a package that is removed; of a checkout that
can be written to beside the sources.
"""

from __future__ import annotations

import atexit
import hashlib
import logging
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from startrack import __version__
from startrack.core.cache import cache_folder
from startrack.core.files import PACKAGE, data_dir
from startrack.core.time_limit import CLOCK

if TYPE_CHECKING:
    from multiprocessing.context import BaseContext
    from multiprocessing.synchronize import Semaphore

LOG = logging.getLogger(__name__)
FOLDER = "numba"  # in the user's cache
VARIABLE = "NUMBA_CACHE_DIR"
CACHED = "@njit(cache=True"  # of a kernel that is kept on disk
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


class Turn:
    """Whether this process announces compilations: of the processes that share a semaphore the first one does."""

    def __init__(self) -> None:
        self.is_taken = self.is_mine = False
        self.shared: Semaphore | None = None  # of a pool, in its processes

    def take(self) -> bool:
        """True in the process that was the first of all to call this."""
        if not self.is_taken:
            self.is_taken = True
            self.is_mine = self.shared is None or bool(self.shared.acquire(block=False))
        return self.is_mine

    def semaphore(self, context: BaseContext) -> Semaphore:
        """For `shared` of the processes that a multiprocessing `context` starts; none announces where this one has."""
        return context.Semaphore(int(not self.is_taken))


ANNOUNCEMENT_TURN = Turn()


@cache
def announce_compilation() -> None:
    """From now on, log one line when numba compiles the first kernel of a package of startrack in this process.

    Compilation does not count towards a limit of time. Nothing is logged where all kernels come from the cache. Call
    this before the first use of a kernel.
    """
    from numba.core import event

    announced: set[str] = set()

    class Announcement(event.Listener):  # type: ignore[misc]
        def on_start(self, event: Any) -> None:
            CLOCK.pause()
            root, _, module = event.data["dispatcher"].py_func.__module__.partition(".")
            package = module.partition(".")[0]
            if root == PACKAGE.name and package not in announced and ANNOUNCEMENT_TURN.take():
                announced.add(package)
                LOG.warning("compiling %s, once for this installation: %s", package, _compiled_text(package))

        def on_end(self, event: Any) -> None:
            CLOCK.resume()

    event.register("numba:compile", Announcement())


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


def is_compiled() -> bool:
    """Whether numba's cache holds kernels of a terrain for this Python.

    For a decision that costs only time if it is wrong: kernels of changed sources count too.
    """
    return any(True for source in (PACKAGE / "terrain").glob("*.py") for _ in _indices_of(source))


def compiled_files() -> dict[Path, list[Path]]:
    """Files of compiled code by folder: in the user's cache those of all installations, elsewhere those of this one."""
    own, named = cache_folder(FOLDER), os.environ.get(VARIABLE)
    found = {own: [path for path in own.rglob("*") if path.is_file()]}
    place = Path(named) if named else PACKAGE
    if place != own:
        folders = {_cache_of(source.parent) for source in PACKAGE.rglob("*.py")}
        kernels = [path for folder in folders for path in folder.glob("*.nb[ic]")]
        found[place] = sorted([*kernels, *([_key_file()] if _key_file().is_file() else [])])
    return found


def _compiled_text(package: str) -> str:
    """How many of the kernels of a `package` of startrack are compiled."""
    sources = [*(PACKAGE / package).rglob("*.py")]
    total = sum(source.read_text(encoding="utf-8").count(CACHED) for source in sources)
    ready = sum(1 for source in sources for _ in _indices_of(source))
    return f"{ready} of {total} kernels are ready" if ready < total else "for another kind of data"


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
