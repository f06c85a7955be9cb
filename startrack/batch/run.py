"""Many tasks on the machine's cores or on a Dask cluster: the same function, the same results, in any order."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from multiprocessing import get_context
from typing import Any

from startrack.batch.task import Task, locate_image, lost

CONNECT_S = 10.0
MOST_RESTARTS = 2
ORPHAN_CHECK_S = 1.0
ONE_THREAD = "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"
AHEAD = 4  # tasks per worker that wait in the queue: 100,000 images take no more memory than a hundred
Counts = Counter[str]  # images by outcome: ok, ambiguous, refused, error


class Batch:
    """Runs tasks and yields (record, whether it was there already) as they are done."""

    def __init__(self, *, jobs: int = 1, cluster: str | None = None) -> None:
        self.jobs, self.cluster = jobs, cluster

    def results(self, tasks: Sequence[Task]) -> Iterator[tuple[dict[str, Any], bool]]:
        """In the order of completion. Raises OSError where no scheduler answers, ImportError without Dask."""
        if self.cluster is not None:
            yield from self._on_cluster(tasks)
        else:
            yield from self._here(tasks)

    def _here(self, tasks: Sequence[Task]) -> Iterator[tuple[dict[str, Any], bool]]:
        """In processes. One that dies (out of memory, killed) is replaced, and its images are tried once more."""
        left, tries = list(tasks), 0
        while left:
            done: set[int] = set()
            try:
                for number, outcome in self._once(left):
                    done.add(number)
                    yield outcome
                return
            except BrokenProcessPool:
                left = [task for number, task in enumerate(left) if number not in done]
                tries += 1
                if tries > MOST_RESTARTS:
                    yield from self._one_by_one(left)
                    return

    def _one_by_one(self, tasks: Sequence[Task]) -> Iterator[tuple[dict[str, Any], bool]]:
        """Each in a process of its own: the image that kills its worker is found, and told as such."""
        for task in tasks:
            try:
                yield from (outcome for _, outcome in self._once([task]))
            except BrokenProcessPool:
                yield lost(task, "internal error: the process that worked on it died (out of memory?)"), False

    def _once(self, tasks: Sequence[Task]) -> Iterator[tuple[int, tuple[dict[str, Any], bool]]]:
        pool = _pool(min(self.jobs, len(tasks)))
        coming = iter(enumerate(tasks))
        waiting: dict[Future[tuple[dict[str, Any], bool]], int] = {}
        try:
            while True:
                for number, task in islice(coming, AHEAD * self.jobs - len(waiting)):
                    waiting[pool.submit(locate_image, task)] = number
                if not waiting:
                    return
                finished, _ = wait(waiting, return_when=FIRST_COMPLETED)
                for future in finished:
                    yield waiting.pop(future), future.result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)

    def _on_cluster(self, tasks: Sequence[Task]) -> Iterator[tuple[dict[str, Any], bool]]:
        """On Dask's workers, which see the same folders. A lost worker's images are done by another."""
        from distributed import Client, as_completed

        with Client(self.cluster, timeout=CONNECT_S) as client:
            coming = iter(tasks)
            ahead = AHEAD * max(sum(client.nthreads().values()), 1)
            running = as_completed([client.submit(locate_image, task, pure=False) for task in islice(coming, ahead)])
            for future in running:
                yield future.result()
                for task in islice(coming, 1):
                    running.add(client.submit(locate_image, task, pure=False))


def _pool(jobs: int) -> ProcessPoolExecutor:
    # Fresh processes (a fork would copy the progress bar's thread), which leave Ctrl-C to the one that waits for them.
    # They inherit these when they load NumPy: the cores are taken by other images.
    for name in ONE_THREAD:
        os.environ.setdefault(name, "1")
    return ProcessPoolExecutor(jobs, mp_context=get_context("spawn"), initializer=_begin, initargs=(os.getpid(),))


def _begin(parent: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    import cv2

    cv2.setNumThreads(1)


def _end_with(parent: int) -> None:
    """End this process when its parent is gone: killed, it cannot tell, and a resumed run must find nobody at work."""
    while os.getppid() == parent:
        time.sleep(ORPHAN_CHECK_S)
    os._exit(1)
