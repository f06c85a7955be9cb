"""Files that take their place when they are complete, and the end of those that never were."""

from __future__ import annotations

import os
import re
import time
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from uuid import uuid4

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

PART = re.compile(r"\.[0-9a-f]{32}\.part")  # name of a file that is being written
PART_LIVES_S = 86_400.0  # since the last byte: longer than any writing, on file systems whose locks hold on one host


def replace_file(target: Path, data: bytes) -> None:
    """Write the `data` to a part, which then takes the place of `target`; remove those of killed processes beside it.

    Raises OSError, and ValueError for a name with a null character.
    """
    _remove_parts(target.parent.absolute())
    # In the same folder, because a rename does not cross file systems; tempfile would make the file private.
    part = target.parent / f".{uuid4().hex}.part"
    try:
        with part.open("xb") as file:
            if fcntl is not None:
                with suppress(OSError):  # a file system without locks: there no process removes parts
                    fcntl.flock(file, fcntl.LOCK_EX)
            file.write(data)
            file.flush()
            if fcntl is None:
                file.close()  # Windows renames no open file
            os.replace(part, target)
    finally:
        with suppress(OSError):  # renamed already; and a failed clean-up must not hide the cause
            part.unlink()


@lru_cache(maxsize=4096)
def _remove_parts(folder: Path) -> None:
    """Remove what killed processes left half-written in a `folder`, once a process: it is listed once.

    A process holds the lock of its part up to the renaming, and writes once it has it: an empty part may be in use.
    Another host may not see the lock, so that a part also has to be old.
    On Windows, where no lock shows that a process lives, parts stay.
    """
    if fcntl is None:
        return
    with suppress(OSError):  # a folder that cannot be listed
        for path in folder.iterdir():
            if PART.fullmatch(path.name) and not path.is_symlink():
                with suppress(OSError), path.open("r+b") as file:  # in use, or another user's
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    status = os.fstat(file.fileno())
                    if status.st_size and time.time() - status.st_mtime > PART_LIVES_S:
                        path.unlink()
