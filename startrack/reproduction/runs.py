"""Many chunks of work: in parallel, kept on disk, taken up again where they were left, the same for any workers."""

from __future__ import annotations

import hashlib
import io
import json
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from concurrent.futures import as_completed as completed_here
from contextlib import AbstractContextManager
from dataclasses import asdict
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from startrack import __version__
from startrack.files import write_atomically
from startrack.reproduction.methods import Chunk, Task, done

FOLDER = ".chunks"
CONNECT_S = 10.0
SOURCES = (  # what computes a chunk: other sources make other chunks
    "localize/*.py", "terrain/cylinder.py", "reproduce/simulator.py", "reproduce/fixes.py", "reproduce/cell.py",
)  # fmt: skip
Progress = Callable[[str, int], AbstractContextManager[Callable[[int], None]]]  # (what, of how many) -> call per step


class Runs:
    """Runs tasks and remembers their chunks under `folder`; a context manager that ends its workers.

    Memory stays flat: a finished chunk goes to disk, and is read again when it is its turn.
    """

    def __init__(self, folder: Path, *, jobs: int, progress: Progress, cluster: str | None = None) -> None:
        self.folder, self.jobs, self.progress, self.cluster = folder / FOLDER, jobs, progress, cluster
        self._executor: Any = None

    def __enter__(self) -> Runs:
        return self

    def __exit__(self, kind: type[BaseException] | None, cause: BaseException | None, at: TracebackType | None) -> None:
        if isinstance(self._executor, Executor):
            self._executor.shutdown(wait=True, cancel_futures=True)
        elif self._executor is not None:
            self._executor.close()

    def connect(self) -> None:
        """Reach the cluster now. Raises OSError where no scheduler answers, ImportError without Dask."""
        from distributed import Client

        self._executor = Client(self.cluster, timeout=CONNECT_S)

    def chunks(self, what: str, tasks: Sequence[Task]) -> Iterator[Chunk]:
        """The chunks in the tasks' order, computing those that are not there yet."""
        missing = [task for task in tasks if not self._path(task).exists()]
        with self.progress(what, sum(map(len, missing))) as advance:
            for task, chunk in self._computed(missing):
                write_atomically(self._path(task), _packed(chunk), overwrite=True)
                advance(len(task))
        for task in tasks:
            with np.load(self._path(task)) as stored:
                yield {key: stored[key] for key in stored.files}

    def _path(self, task: Task) -> Path:
        return self.folder / f"{_key(task)}.npz"

    def _computed(self, tasks: Sequence[Task]) -> Iterator[tuple[Task, Chunk]]:
        if self.cluster is not None and tasks:
            from distributed import as_completed

            if self._executor is None:
                self.connect()
            futures = {future: task for task, future in zip(tasks, self._executor.map(done, tasks), strict=True)}
            for future in as_completed(futures):
                yield futures.pop(future), future.result()
        elif self.jobs > 1 and len(tasks) > 1:
            self._executor = self._executor or _pool(self.jobs)
            waiting = {self._executor.submit(done, task): task for task in tasks}
            for finished in completed_here(waiting):
                yield waiting.pop(finished), finished.result()
        else:
            yield from ((task, done(task)) for task in tasks)


def _pool(jobs: int) -> ProcessPoolExecutor:
    # Fresh processes (a fork would copy the progress bar's thread), which leave Ctrl-C to the one that waits for them.
    ignore = (signal.SIGINT, signal.SIG_IGN)
    return ProcessPoolExecutor(jobs, mp_context=get_context("spawn"), initializer=signal.signal, initargs=ignore)


def _packed(chunk: Chunk) -> bytes:
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
