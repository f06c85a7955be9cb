"""One batch at a time writes to a folder: a lock of the operating system's, which goes with the process, killed or not.

It holds for processes of one machine, and on a shared file system as far as that passes locks on.
"""

from __future__ import annotations

import errno
import logging
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from startrack.errors import BadInput

LOCK = ".startrack-batch.lock"
PID_BYTES = 20
TAKEN = {errno.EAGAIN, errno.EACCES, errno.EDEADLK}
AT = 2**30  # Windows locks bytes, and those may not be read: one beyond the process's number


@contextmanager
def only_writer(out: str | os.PathLike[str]) -> Iterator[None]:
    """While this lasts, no other batch writes to `out`. Raises BadInput (bad_image) where one does."""
    path = Path(out) / LOCK
    file = _held(path)
    try:
        yield
    finally:
        with suppress(OSError):  # Windows keeps an open file; an empty one left behind locks nobody out
            path.unlink()
        os.close(file)


def _held(path: Path) -> int:
    """The locked file. One that its former holder has just removed is no lock any more: then another is made."""
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            _lock(file)
        except OSError as cause:
            if cause.errno in TAKEN:
                raise _taken(path, file) from cause
            logging.getLogger(__name__).warning("%s: this file system has no locks: run one batch at a time", path)
            return file
        if _is_at(file, path):
            os.ftruncate(file, 0)
            os.write(file, str(os.getpid()).encode())
            return file
        os.close(file)


def _is_at(file: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file), os.stat(path))
    except FileNotFoundError:
        return False


def _taken(path: Path, file: int) -> BadInput:
    pid = os.read(file, PID_BYTES).decode(errors="replace") or "unknown"
    os.close(file)
    return BadInput(
        "bad_image", f"another batch is writing to {path.parent} (process {pid}): wait for it, or choose another -D"
    )


if sys.platform == "win32":
    import msvcrt

    def _lock(file: int) -> None:
        os.lseek(file, AT, os.SEEK_SET)
        msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
        os.lseek(file, 0, os.SEEK_SET)
else:
    import fcntl

    def _lock(file: int) -> None:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
