"""Many tasks on the machine's cores or on a Dask cluster: the same function, the same results, in any order."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from multiprocessing import active_children, get_context
from typing import TYPE_CHECKING, Any

from startrack.batch.task import BatchStopped, Task, locate_image, lost
from startrack.errors import BadInput

if TYPE_CHECKING:
    from distributed import Client

CONNECT_S = 10.0
ORPHAN_CHECK_S = 1.0
ONE_THREAD = "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"
AHEAD = 4  # tasks per worker that wait in the queue: 100,000 images take no more memory than a hundred
DIED = "internal error: the process that worked on it died (out of memory?), alone as it did beside others"
DIED_ON_CLUSTER = "internal error: the Dask workers that worked on it died, one after the other (out of memory?)"
Counts = Counter[str]  # images by outcome: ok, ambiguous, refused, error
Outcome = tuple[dict[str, Any], bool]  # record, whether it was there already
Work = Callable[[Task], Outcome]


class Batch:
    """Runs tasks and yields (record, whether it was there already) as they are done."""

    def __init__(self, *, jobs: int = 1, cluster: str | None = None, work: Work = locate_image) -> None:
        self.jobs, self.cluster, self.work = jobs, cluster, work
        self._stopping = False

    def stop(self) -> None:
        """Begin no other task; `results` ends when those in hand are done. May be called by a signal's handler."""
        self._stopping = True

    def results(self, tasks: Sequence[Task]) -> Iterator[Outcome]:
        """In the order of completion.

        Raises BadInput (no_cluster) where no scheduler answers, BatchStopped where no task can be done any more.
        """
        yield from self._on_cluster(tasks) if self.cluster is not None else self._here(tasks)

    def _here(self, tasks: Sequence[Task]) -> Iterator[Outcome]:
        """In processes. When one dies (out of memory, killed), what was in hand is done again, one at a time."""
        coming, jobs = iter(tasks), min(self.jobs, len(tasks))
        while suspects := (yield from self._until_one_dies(coming, jobs, AHEAD * jobs)):
            alone = iter(suspects)
            while culprits := (yield from self._until_one_dies(alone, 1, 1)):
                yield lost(culprits[0], DIED), False

    def _until_one_dies(self, coming: Iterator[Task], jobs: int, ahead: int) -> Generator[Outcome, None, list[Task]]:
        """Returns the tasks that were in hand when a process died, none when all is done."""
        pool = _pool(jobs)
        waiting: dict[Future[Outcome], Task] = {}
        suspects: list[Task] = []
        try:
            while True:
                more = 0 if suspects or self._stopping else ahead - len(waiting)
                waiting |= {_submitted(pool, self.work, task): task for task in islice(coming, more)}
                if not waiting:
                    return suspects
                finished, _ = wait(waiting, return_when=FIRST_COMPLETED)
                if self._stopping:
                    for future in [one for one in waiting if one.cancel()]:
                        del waiting[future]
                for future in finished & waiting.keys():
                    task = waiting.pop(future)
                    if isinstance(future.exception(), BrokenProcessPool):
                        suspects.append(task)
                    else:
                        yield future.result()
        except KeyboardInterrupt:  # a second Ctrl-C: results are whole or not there, so that nothing is spoilt
            for process in active_children():
                process.kill()
            raise
        finally:
            pool.shutdown(wait=True, cancel_futures=True)

    def _on_cluster(self, tasks: Sequence[Task]) -> Iterator[Outcome]:
        """On Dask's workers, which see the same folders. A lost worker's images are done by another."""
        from distributed import as_completed

        with self._client() as client:
            coming, running, handed_out = iter(tasks), as_completed(), {}
            more = AHEAD * max(sum(client.nthreads().values()), 1)
            while True:
                for task in islice(coming, 0 if self._stopping else more):
                    future = client.submit(self.work, task, pure=False)
                    handed_out[future.key] = task
                    running.add(future)
                if not handed_out:
                    return
                future, more = next(running), 1
                yield _outcome_on_cluster(future, handed_out.pop(future.key))

    def _client(self) -> Client:
        from distributed import Client

        try:
            return Client(self.cluster, timeout=CONNECT_S)
        except OSError as cause:
            raise BadInput("no_cluster", f"{self.cluster}: no Dask scheduler answers ({cause})") from cause


def _outcome_on_cluster(future: Any, task: Task) -> Outcome:
    from distributed import KilledWorker

    try:
        outcome: Outcome = future.result()
    except KilledWorker:
        return lost(task, DIED_ON_CLUSTER), False
    except (OSError, CancelledError) as cause:
        raise BatchStopped(f"the Dask scheduler has gone ({cause})") from cause
    except ImportError as cause:
        raise BatchStopped(f"the workers cannot load startrack ({cause})") from cause
    return outcome


def _submitted(pool: ProcessPoolExecutor, work: Work, task: Task) -> Future[Outcome]:
    try:
        return pool.submit(work, task)
    except BrokenProcessPool as cause:  # since the last look
        broken: Future[Outcome] = Future()
        broken.set_exception(cause)
        return broken


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
