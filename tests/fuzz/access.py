"""Guard of the files that a read may touch, by Python's audit events."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


class Broken(Exception):
    """The outcome is neither an answer nor a proper refusal."""


_allowed: Path | None = None
_written: tuple[str, ...] = ()
_violations: list[str] = []
WRITING = {"os.remove", "os.rename", "os.mkdir", "os.rmdir", "os.symlink", "os.link", "os.truncate", "shutil.rmtree"}
NEVER = {"socket.connect", "subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "os.fork"}


@contextmanager
def no_access_beside(folder: Path, written: tuple[Path, ...] | None = None) -> Iterator[None]:
    """In the block only files below `folder`, of Python and of the repository are opened.

    Only those below the folders `written` are written (None: below `folder`). Python's audit events show it; a
    library's own reading in C is not seen. Raises Broken at the end of the block.
    """
    global _allowed, _written
    if not _hooked:
        sys.addaudithook(_audit)
        _hooked.append(True)
    _violations.clear()
    _allowed = folder.resolve()
    _written = tuple(str(one.resolve()) for one in written or (folder,))
    try:
        yield
    finally:
        _allowed = None
    if _violations:
        raise Broken(f"touched {_violations[:3]}")


_hooked: list[bool] = []
_READABLE = tuple({sys.prefix, sys.base_prefix, str(Path(__file__).resolve().parents[2]), "/proc", "/dev", "/sys",
                   "/usr", "/etc", *(path for path in sys.path if path)})  # fmt: skip


def _audit(event: str, args: tuple[Any, ...]) -> None:
    if _allowed is None:
        return
    if event in NEVER:
        _violations.append(event)
    elif event in WRITING or (event == "open" and isinstance(args[0], str | bytes)):
        path = str(Path(args[0] if isinstance(args[0], str) else args[0].decode("utf-8", "replace")).absolute())
        writes = event in WRITING or bool(args[1] and set(str(args[1])) & set("wax+"))
        is_code = "__pycache__" in path  # where Python stores compiled code
        if not is_code and not (_below(path, *_written) if writes else _below(path, str(_allowed), *_READABLE)):
            _violations.append(f"{event} {path}")


def _below(path: str, *folders: str) -> bool:
    real = os.path.normpath(path)
    return any(real == folder or real.startswith(folder.rstrip("/") + "/") for folder in folders)
