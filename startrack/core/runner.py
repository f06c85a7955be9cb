"""Many independent tasks on processes of this machine or on a Dask cluster; results come in the order of completion."""

from __future__ import annotations

import logging
import os
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from contextvars import copy_context
from dataclasses import dataclass
from itertools import islice
from multiprocessing import active_children, get_context, parent_process
from multiprocessing.connection import wait as wait_for_sentinels
from types import TracebackType
from typing import TYPE_CHECKING, Any, Generic, Self, TypeVar

from startrack.core.errors import BadInput
from startrack.core.time_limit import check_time

if TYPE_CHECKING:
    from distributed import Client

CONNECT_S = 10.0
CLOSE_S = CONNECT_S / 2  # for idle processes to end by themselves
TASK_LIMIT_S = 900.0  # without any result: far above the slowest image, reached only by a blocked process
TASKS_PER_PROCESS = 2  # submitted at a time: one in progress and the next; twice as many far away, on a cluster
DIED = "the process that worked on it died (out of memory?) or stood still, alone as it did beside others"
DIED_ON_CLUSTER = "the Dask workers that worked on it died, one after the other (out of memory?)"
SIGNALS = (signal.SIGINT, signal.SIGTERM)
THREAD_LIMITS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
NO_TRACKER_WARNINGS = "ignore:resource_tracker"  # Python warns when it removes files of a killed process
LOG_OF_CLIENT = "distributed.client"

Task = TypeVar("Task")
Result = TypeVar("Result")


def count_cores() -> int:
    """Cores that this process may use; one in a process of a pool, as the others do other tasks."""
    if parent_process() is not None:
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def map_in_threads(work: Callable[..., Result], *tasks: Iterable[Any]) -> Iterator[Result]:
    """The results of `work` for the `tasks`, as of `map`, by a thread a core; the first exception is raised.

    For work on arrays, which numpy, OpenCV and the compiled kernels do beside other threads. The limit of time of
    the caller holds in the threads; each task begins with asking for it.
    """
    here = copy_context()

    def limited(*task: Any) -> Result:
        check_time()
        return work(*task)

    with ThreadPoolExecutor(count_cores()) as pool:
        yield from pool.map(lambda *task: here.copy().run(limited, *task), *tasks)


class RunStopped(Exception):
    """No further task can be done: the disk is full, the cluster is gone. The message has the cause."""


@dataclass(frozen=True)
class Died:
    """Result of a task that ended or blocked every process which worked on it."""

    cause: str


class Runner(Generic[Task, Result]):
    """Applies `work` to tasks, in `jobs` processes or on the workers of the Dask scheduler at `cluster`.

    `work` and the tasks must be picklable. With `in_process`, a single job runs in this process. As a context manager
    it ends its processes on exit; they are kept from one call of `results` to the next.
    """

    def __init__(
        self,
        work: Callable[[Task], Result],
        *,
        jobs: int = 1,
        cluster: str | None = None,
        in_process: bool = False,
        limit_s: float = TASK_LIMIT_S,
    ) -> None:
        self.work, self.jobs, self.cluster, self.limit_s = work, jobs, cluster, limit_s
        self._in_process = in_process and jobs == 1
        self._stopping = False
        self._pool: _Pool | None = None
        self._client: Client | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, cause: BaseException | None, at: TracebackType | None) -> None:
        if self._pool is not None:
            self._pool.close(kill=kind is not None and not issubclass(kind, Exception))
            self._pool = None
        if self._client is not None:
            self._client.close()
            self._client = None

    def stop(self) -> None:
        """Start no further task; `results` ends after the tasks in progress. A signal handler may call this."""
        self._stopping = True

    def connect(self) -> Client:
        """Connect to the cluster. Raises BadInput (no_cluster) if no scheduler answers."""
        if self._client is None:
            from distributed import Client

            logging.getLogger(LOG_OF_CLIENT).setLevel(logging.CRITICAL)  # a lost scheduler is reported by RunStopped
            try:
                self._client = Client(self.cluster, timeout=CONNECT_S)
            except (OSError, ValueError) as cause:
                raise BadInput("no_cluster", f"{self.cluster}: no Dask scheduler answers ({cause})") from cause
        return self._client

    def results(self, tasks: Iterable[Task]) -> Generator[tuple[Task, Result | Died], None, None]:
        """(task, result) in the order of completion. Exceptions of `work` are raised here.

        Raises BadInput (no_cluster) if no scheduler answers, RunStopped if the cluster fails.
        """
        if self.cluster is not None:
            yield from self._run_on_cluster(tasks)
        elif self._in_process:
            yield from ((task, self.work(task)) for task in tasks if not self._stopping)
        else:
            yield from self._run_in_pool(tasks)

    def _run_in_pool(self, tasks: Iterable[Task]) -> Generator[tuple[Task, Result | Died], None, None]:
        """After a process has died or blocked, the tasks in progress are repeated one by one to find the cause."""
        coming = iter(tasks)
        while True:
            self._pool = self._pool or _Pool(self.jobs)
            suspects = yield from self._run_until_failure(coming, self._pool, TASKS_PER_PROCESS * self.jobs)
            if not suspects:
                return
            self._pool = None
            alone, culprits = iter(suspects), suspects
            while culprits:
                single = _Pool(1)
                try:
                    culprits = yield from self._run_until_failure(alone, single, 1)
                finally:
                    single.close()
                yield from ((task, Died(DIED)) for task in culprits)

    def _run_until_failure(
        self, coming: Iterator[Task], pool: _Pool, most_submitted: int
    ) -> Generator[tuple[Task, Result | Died], None, list[Task]]:
        """Yield results; return the tasks in progress when a process died or blocked, none if all tasks are done.

        The pool is closed after a failure, and when the caller closes the generator.
        """
        waiting: dict[Future[Result], Task] = {}
        try:
            while True:
                for task in islice(coming, 0 if self._stopping else most_submitted - len(waiting)):
                    waiting[pool.submit(self.work, task)] = task
                if not waiting:
                    return []
                finished, _ = wait(waiting, timeout=self.limit_s, return_when=FIRST_COMPLETED)
                if self._stopping:
                    for future in [one for one in waiting if one.cancel()]:
                        del waiting[future]
                broken = any(map(_is_broken, finished & waiting.keys()))
                if broken:  # the executor then ends all other futures too, some of them with a result
                    finished, _ = wait(waiting, timeout=CLOSE_S)
                for future in [one for one in waiting if one in finished and not _is_broken(one)]:
                    yield waiting.pop(future), future.result()
                if broken or not finished:
                    pool.close(kill=True)
                    return list(waiting.values())
        except (KeyboardInterrupt, GeneratorExit):  # files are complete or absent, so that nothing is damaged
            pool.close(kill=True)
            self._pool = None
            raise
        finally:
            for future in waiting:
                future.cancel()

    def _run_on_cluster(self, tasks: Iterable[Task]) -> Iterator[tuple[Task, Result | Died]]:
        """The workers see the same folders. Dask repeats the tasks of a lost worker on another."""
        from distributed import as_completed

        client = self.connect()
        coming, running, submitted = iter(tasks), as_completed(), dict[Any, Task]()
        free = 2 * TASKS_PER_PROCESS * max(sum(client.nthreads().values()), 1)
        while True:
            for task in islice(coming, 0 if self._stopping else free):
                future = client.submit(self.work, task, pure=False)
                submitted[future.key] = task
                running.add(future)
            if not submitted:
                return
            future, free = next(running), 1
            yield submitted.pop(future.key), _cluster_result(future)


class _Pool:
    """Processes with one thread each that ignore Ctrl-C and SIGTERM and end with this process."""

    def __init__(self, jobs: int) -> None:
        for name in THREAD_LIMITS:  # inherited when the processes load NumPy: the other cores do other tasks
            os.environ.setdefault(name, "1")
        rules = os.environ.get("PYTHONWARNINGS", "")
        if NO_TRACKER_WARNINGS not in rules:
            os.environ["PYTHONWARNINGS"] = f"{rules},{NO_TRACKER_WARNINGS}".strip(",")
        self._others = set(active_children())
        # New processes: a fork would copy the thread of the progress bar.
        context = get_context("spawn")
        given = (logging.getLogger("startrack").level,)
        self._executor = ProcessPoolExecutor(jobs, mp_context=context, initializer=_begin_process, initargs=given)

    def submit(self, work: Callable[[Task], Result], task: Task) -> Future[Result]:
        """The future result; in a broken pool a future with BrokenProcessPool."""
        try:
            with _block_signals():  # processes start in here, and inherit this from their first instruction on
                return self._executor.submit(work, task)
        except BrokenProcessPool as cause:
            broken: Future[Result] = Future()
            broken.set_exception(cause)
            return broken

    def close(self, *, kill: bool = False) -> None:
        """End the processes: at once with `kill`, otherwise when they are idle; a blocked one is killed."""
        self._executor.shutdown(wait=False, cancel_futures=True)
        alive = [process for process in active_children() if process not in self._others]
        deadline_s = time.monotonic() + (0.0 if kill else CLOSE_S)
        while alive and (left_s := deadline_s - time.monotonic()) > 0:
            ended = wait_for_sentinels([process.sentinel for process in alive], left_s)
            alive = [process for process in alive if process.sentinel not in ended]
        for process in alive:
            process.kill()
        self._executor.shutdown(wait=True)


@contextmanager
def _block_signals() -> Iterator[None]:
    """Block SIGINT and SIGTERM: a process started in the block never gets them, this one gets them after the block."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin_process(log_level: int) -> None:
    """The first call in a new process, whose logs are as quiet as the parent's."""
    logging.getLogger("startrack").setLevel(log_level)
    for number in SIGNALS:  # sent to the whole process group: the tasks in progress are finished
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    import cv2

    cv2.setNumThreads(1)


def _end_with_parent() -> None:
    """End this process when its parent has ended, also by kill -9: a resumed run must not find it at work."""
    parent = parent_process()
    if parent is not None:
        wait_for_sentinels([parent.sentinel])
    os._exit(1)


def _is_broken(future: Future[Any]) -> bool:
    """Whether the future ended because a process of its pool died."""
    return future.done() and not future.cancelled() and isinstance(future.exception(), BrokenProcessPool)


def _cluster_result(future: Any) -> Any:
    """The result of a Dask future. Raises RunStopped if the scheduler or the installation is at fault."""
    from distributed import KilledWorker

    try:
        return future.result()
    except KilledWorker:
        return Died(DIED_ON_CLUSTER)
    except (OSError, CancelledError) as cause:
        raise RunStopped(f"the Dask scheduler has gone ({str(cause).partition(chr(10))[0]})") from cause
    except ImportError as cause:
        raise RunStopped(f"the workers cannot load startrack ({cause})") from cause
