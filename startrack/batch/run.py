"""Many tasks on the machine's cores or on a Dask cluster: the same function, the same results, in any order."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from itertools import chain, count, islice
from typing import TYPE_CHECKING, Any

from startrack.batch.processes import Process, kill_children, pool_of
from startrack.batch.task import BatchStopped, Task, locate_image, lost
from startrack.errors import BadInput

if TYPE_CHECKING:
    from distributed import Client

CONNECT_S = 10.0
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

    def results(self, tasks: Sequence[Task]) -> Generator[Outcome, None, None]:
        """In the order of completion.

        Raises BadInput (no_cluster) where no scheduler answers, BatchStopped where no task can be done any more.
        """
        yield from self._on_cluster(tasks) if self.cluster is not None else self._here(tasks)

    def _here(self, tasks: Sequence[Task]) -> Iterator[Outcome]:
        """In processes. When one dies (out of memory, killed), what they were at is done again, one at a time."""
        coming: Iterator[Task] = iter(tasks)
        jobs = min(self.jobs, len(tasks))
        while True:
            suspects, queued = yield from self._until_one_dies(coming, jobs, AHEAD * jobs)
            if not suspects:
                return
            coming, alone = chain(queued, coming), iter(suspects)
            while culprits := (yield from self._until_one_dies(alone, 1, 1))[0]:
                yield lost(culprits[0], DIED), False

    def _until_one_dies(
        self, coming: Iterator[Task], jobs: int, ahead: int
    ) -> Generator[Outcome, None, tuple[list[Task], list[Task]]]:
        """Returns the tasks that processes were at when one died, and those that were queued; none when all is done."""
        pool, at = pool_of(jobs)
        numbers = count()
        waiting: dict[Future[Outcome], tuple[int, Task]] = {}
        undone: dict[int, Task] = {}
        try:
            while True:
                more = 0 if undone or self._stopping else ahead - len(waiting)
                for number, task in zip(numbers, islice(coming, more), strict=False):
                    waiting[_submitted(pool, self.work, number, task)] = number, task
                if not waiting:
                    return _suspects(undone, set(at))
                finished, _ = wait(waiting, return_when=FIRST_COMPLETED)
                if self._stopping:
                    for future in [one for one in waiting if one.cancel()]:
                        del waiting[future]
                for future in finished & waiting.keys():
                    number, task = waiting.pop(future)
                    if isinstance(future.exception(), BrokenProcessPool):
                        undone[number] = task
                    else:
                        yield future.result()
        except (KeyboardInterrupt, GeneratorExit):  # results are whole or not there, so that nothing is spoilt
            kill_children()
            raise
        finally:
            if undone:  # the pool asks the other processes to end by a signal that they ignore
                kill_children()
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

        logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # that a scheduler has gone is said below
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
        raise BatchStopped(f"the Dask scheduler has gone ({str(cause).partition(chr(10))[0]})") from cause
    except ImportError as cause:
        raise BatchStopped(f"the workers cannot load startrack ({cause})") from cause
    return outcome


def _suspects(undone: dict[int, Task], at: set[int]) -> tuple[list[Task], list[Task]]:
    """Tasks that processes were at, and the others; all are suspects where a process died before it was at any."""
    queued = [task for number, task in undone.items() if number not in at]
    if len(queued) == len(undone):
        return queued, []
    return [task for number, task in undone.items() if number in at], queued


def _submitted(pool: ProcessPoolExecutor, work: Work, number: int, task: Task) -> Future[Outcome]:
    try:
        return pool.submit(Process.do, work, number, task)
    except BrokenProcessPool as cause:  # since the last look
        broken: Future[Outcome] = Future()
        broken.set_exception(cause)
        return broken
