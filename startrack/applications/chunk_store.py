"""Results of many tasks as chunks of arrays: computed in parallel, kept on disk, the same for any number of workers."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Callable, Iterable, Iterator, Sequence, Sized
from contextlib import AbstractContextManager
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from startrack.core import __version__
from startrack.core.files import PACKAGE, remove_file
from startrack.core.runner import TASK_LIMIT_S, Died, Runner, RunStopped
from startrack.core.stored import read_sealed, write_sealed
from startrack.kernels.build import source_key

Chunk = dict[str, np.ndarray]  # the result of one task, by name


class Bar(Protocol):
    """A progress bar."""

    def advance(self, steps: int = 1) -> None: ...


Task = TypeVar("Task", bound=Sized)  # its length: the number of its steps on the progress bar
Progress = Callable[[str, int], AbstractContextManager[Bar]]  # text and number of steps of a computation


class ChunkStore(Runner[Task, Chunk]):
    """Runner of `work` on tasks that keeps their chunks in `folder`; as a context manager it ends its processes.

    `key` is the name of a task's chunk: it must differ where the result may. Memory stays constant: a finished chunk
    goes to disk, and is read again when it is needed.
    """

    def __init__(
        self,
        folder: Path,
        work: Callable[[Task], Chunk],
        key: Callable[[Task], str],
        *,
        jobs: int,
        progress: Progress,
        cluster: str | None = None,
        limit_s: float = TASK_LIMIT_S,
    ) -> None:
        super().__init__(work, jobs=jobs, cluster=cluster, in_process=True, limit_s=limit_s)
        self.folder, self.key, self.progress = folder, key, progress

    def chunks(self, what: str, tasks: Sequence[Task]) -> Iterator[Chunk]:
        """The chunks of `what` in the order of the tasks; missing ones are computed. Raises RunStopped."""
        missing = [task for task in tasks if read_sealed(self._path(task)) is None]
        with self.progress(what, sum(map(len, missing))) as bar:
            for task, chunk in self.results(missing):
                if isinstance(chunk, Died):
                    raise RunStopped(f"{what}: {chunk.cause}")
                buffer = io.BytesIO()
                np.savez_compressed(buffer, **chunk)  # type: ignore[arg-type]
                write_sealed(self._path(task), buffer.getvalue())
                bar.advance(len(task))
        for task in tasks:
            data = read_sealed(self._path(task))
            if data is None:
                raise RunStopped(f"{what}: {self._path(task)} was removed or changed meanwhile")
            with np.load(io.BytesIO(data)) as stored:
                yield {key: stored[key] for key in stored.files}

    def discard(self, tasks: Iterable[Task]) -> None:
        """Remove the chunks of tasks. Raises BadOutput."""
        for task in tasks:
            remove_file(self._path(task))

    def _path(self, task: Task) -> Path:
        return self.folder / f"{self.key(task)}.npz"


def settings_digest(sources: tuple[str, ...], settings: Any) -> str:
    """Hash of `settings` (JSON values), version, kernels and the package's files that match `sources`: a chunk's key.

    Raises ValueError for a pattern that no file matches.
    """
    whole = json.dumps([__version__, source_key(), _source_digest(sources), settings], sort_keys=True, default=str)
    return hashlib.sha256(whole.encode()).hexdigest()[:24]


@lru_cache(maxsize=8)
def _source_digest(patterns: tuple[str, ...]) -> str:
    """SHA-256 of the names and contents of the package's files that match the `patterns`."""
    found = [path for pattern in patterns for path in sorted(PACKAGE.glob(pattern)) or [PACKAGE / pattern]]
    missing = [path for path in found if not path.is_file()]
    if missing:
        raise ValueError(f"no source of startrack matches {missing[0].relative_to(PACKAGE)}")
    return hashlib.sha256(b"".join(path.name.encode() + path.read_bytes() for path in sorted(found))).hexdigest()
