"""A path whose open file reads no more at a time than it holds: for readers that trust the lengths in a file."""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import Any


class BoundedPath(type(Path())):  # type: ignore[misc]  # the path of this system
    """A path that opens a file in mode "rb" as one that makes room for no more than its own size."""

    def open(self, mode: str = "r", *given: Any, **more: Any) -> Any:
        """The open file; of other modes than "rb" as `Path.open`, with the same arguments."""
        return _BoundedReader(io.FileIO(self)) if mode == "rb" else super().open(mode, *given, **more)


class _BoundedReader(io.BufferedReader):
    def __init__(self, file: io.FileIO) -> None:
        super().__init__(file)
        self._most = os.fstat(file.fileno()).st_size

    def read(self, size: int | None = -1, /) -> bytes:
        """At most `size` bytes (None or negative: all); a length beyond the file gives what there is."""
        return super().read(size if size is None else min(size, self._most))
