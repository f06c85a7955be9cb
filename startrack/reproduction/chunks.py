"""Chunks of fixes: computed in parallel, kept on disk, the same for any number of workers."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from types import TracebackType
from typing import Protocol

import numpy as np

from startrack import __version__
from startrack.files import write_atomically
from startrack.reproduction.methods import Chunk, Task, compute_chunk
from startrack.runner import Died, Runner, RunStopped

FOLDER = ".chunks"
SOURCES = (  # their content is part of a chunk's key
    "localization/*.py", "terrain/cylinder.py", "reproduction/simulator.py", "reproduction/methods.py",
    "reproduction/bound.py",
)  # fmt: skip


class Bar(Protocol):
    """A progress bar."""

    def advance(self, steps: int = 1) -> None: ...


Progress = Callable[[str, int], AbstractContextManager[Bar]]  # text and number of fixes of a computation


class ChunkStore:
    """Computes tasks and keeps their chunks under `folder`; a context manager that ends its processes.

    Memory stays constant: a finished chunk goes to disk, and is read again when it is needed.
    """

    def __init__(self, folder: Path, *, jobs: int, progress: Progress, cluster: str | None = None) -> None:
        self.folder, self.progress = folder / FOLDER, progress
        self._runner: Runner[Task, Chunk] = Runner(compute_chunk, jobs=jobs, cluster=cluster, in_process=True)

    def __enter__(self) -> ChunkStore:
        return self

    def __exit__(self, kind: type[BaseException] | None, cause: BaseException | None, at: TracebackType | None) -> None:
        self._runner.__exit__(kind, cause, at)

    def connect(self) -> None:
        """Connect to the cluster now. Raises BadInput (no_cluster) if no scheduler answers."""
        self._runner.connect()

    def chunks(self, what: str, tasks: Sequence[Task]) -> Iterator[Chunk]:
        """The chunks of `what` in the order of the tasks; missing ones are computed. Raises RunStopped."""
        missing = [task for task in tasks if not self._path(task).exists()]
        with self.progress(what, sum(map(len, missing))) as bar:
            for task, chunk in self._runner.results(missing):
                if isinstance(chunk, Died):
                    raise RunStopped(f"{what}: {chunk.cause}")
                write_atomically(self._path(task), _pack_chunk(chunk), overwrite=True)
                bar.advance(len(task))
        for task in tasks:
            with np.load(self._path(task)) as stored:
                yield {key: stored[key] for key in stored.files}

    def _path(self, task: Task) -> Path:
        return self.folder / f"{_key(task)}.npz"


def _pack_chunk(chunk: Chunk) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **chunk)  # type: ignore[arg-type]
    return buffer.getvalue()


def _key(task: Task) -> str:
    settings = json.dumps([__version__, _source_digest(), asdict(task)], sort_keys=True)
    return hashlib.sha256(settings.encode()).hexdigest()[:24]


@lru_cache(maxsize=1)
def _source_digest() -> str:
    root, digest = Path(__file__).parent.parent, hashlib.sha256()
    for path in sorted(path for pattern in SOURCES for path in root.glob(pattern)):
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()
