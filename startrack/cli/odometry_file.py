"""The odometry of one run of `startrack track`, whose file may grow."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from startrack.core.errors import BadInput

if TYPE_CHECKING:
    from startrack.applications.tracking import Odometry


class OdometryFile:
    """A file of odometry that is read again where it has changed."""

    def __init__(self, path: str, topic: str | None, is_followed: bool) -> None:
        """Of a `path`, and of a bag the `topic`; `is_followed`: its last line may be incomplete."""
        self.path, self.topic, self.is_followed = path, topic, is_followed
        self._has_ended = False
        self._read: tuple[object, Odometry] | None = None  # with the stamp of the file

    @property
    def has_changed(self) -> bool:
        """Whether the file is another one than was read."""
        return self._read is None or self._read[0] != self._stamp()

    def read(self) -> Odometry:
        """The odometry as it is now. Raises BadInput as `read_odometry`."""
        stamp = self._stamp()
        if self._read is None or self._read[0] != stamp:
            self._read = stamp, self._parse()
        return self._read[1]

    def end(self) -> None:
        """The file grows no more: its last line counts too, if it can be read."""
        self._has_ended, self._read = True, None

    def _parse(self) -> Odometry:
        from startrack.applications.tracking import read_odometry

        if self._has_ended:
            with suppress(BadInput):
                return read_odometry(self.path, self.topic)
        return read_odometry(self.path, self.topic, growing=self.is_followed)

    def _stamp(self) -> object:
        with suppress(OSError):
            found = Path(self.path).stat()
            return found.st_size, found.st_mtime_ns
        return None
