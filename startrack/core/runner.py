"""Many independent tasks on processes of this machine or on a Dask cluster; results come in the order of completion."""

from __future__ import annotations

import logging
import os
import signal
import threading
from collections.abc import Callable, Collection, Generator, Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    CancelledError,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from concurrent.futures.process import BrokenProcessPool
from contextvars import copy_context
from dataclasses import dataclass
from functools import partial
from itertools import islice
from multiprocessing import active_children, get_context, parent_process
from multiprocessing.process import BaseProcess
from typing import TYPE_CHECKING, Any, Generic, Self, TypeVar, cast

from startrack.core.errors import BadInput
from startrack.core.limits import check_time

if TYPE_CHECKING:
    from distributed import Client
    from tornado.platform.asyncio import BaseAsyncIOLoop

CONNECT_S = 10.0
CLOSE_S = CONNECT_S / 2  # for the tasks in progress to end, when no more results are wanted
TASK_LIMIT_S = 900.0  # without any result: far above the slowest image, reached only by a blocked process
TASKS_PER_THREAD = 4  # of a cluster, handed out at a time: it is far away. A process gets one, which can be finished
DIED = "the process that worked on it died (out of memory?) or stood still, alone as it did beside others"
DIED_ON_CLUSTER = "the Dask workers that worked on it died, one after the other (out of memory?)"
SIGNALS = (signal.SIGINT, signal.SIGTERM)
THREAD_LIMITS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
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
    """Results of `work` for the `tasks`, in their order, from a thread a core; the first exception is raised.

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
    """Executor of `work` on tasks, in `jobs` processes or on the workers of the Dask scheduler at `cluster`.

    `work` and the tasks must be picklable. With `in_process`, a single job runs in this process. As a context manager
    it connects to the cluster, and ends its processes; they are kept from one call of `results` to the next.
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
        self._pool: ProcessPoolExecutor | None = None
        self._others: list[BaseProcess] = []  # processes that are not of the pool
        self._client: Client | None = None

    def __enter__(self) -> Self:
        """This runner, connected to its cluster. Raises BadInput (no_cluster) if no scheduler answers."""
        if self.cluster is not None:
            self._client = _connect(self.cluster)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._end_pool(kill=kind is not None and not issubclass(kind, Exception))
        if self._client is not None:
            self._client.close()

    def stop(self) -> None:
        """Start no further task; `results` ends after those in progress. A signal handler may call this.

        On a cluster those that wait for a worker's thread are done too.
        """
        self._stopping = True

    def results(self, tasks: Iterable[Task]) -> Generator[tuple[Task, Result | Died], None, None]:
        """Pairs (task, result) in the order of completion. Exceptions of `work` are raised here.

        After a process has died or blocked, the tasks in progress are repeated one by one to find the cause. Dask
        repeats those of a lost worker on another. Raises RunStopped if the cluster fails.
        """
        coming = iter(tasks)
        if self._client is not None:
            threads = sum(self._client.nthreads().values())
            yield from self._run(coming, TASKS_PER_THREAD * max(threads, 1))
        elif self._in_process:
            yield from ((task, self.work(task)) for task in coming if not self._stopping)
        else:
            while suspects := (yield from self._run(coming, self.jobs)):
                alone = iter(suspects)
                while culprits := (yield from self._run(alone, 1)):
                    yield from ((task, Died(DIED)) for task in culprits)
                self._end_pool()

    def _run(self, coming: Iterator[Task], most: int) -> Generator[tuple[Task, Result | Died], None, list[Task]]:
        """Yield pairs (task, result), `most` tasks at a time; return those in progress when a process died or blocked.

        None are returned when all are done. The processes are killed after a death, and when the caller closes the
        generator: files are complete or absent, so that nothing is damaged.
        """
        waiting: dict[Future[Result], Task] = {}
        client, submit = self._client, self._way_to_submit(most)
        try:
            while True:
                for task in islice(coming, 0 if self._stopping else most - len(waiting)):
                    waiting[submit(self.work, task)] = task
                if not waiting:
                    return []
                finished, _ = wait(waiting, self.limit_s if client is None else CONNECT_S, FIRST_COMPLETED)
                if client is not None:
                    _check_connection(client, finished)
                has_failed = client is None and (not finished or any(map(_is_lost, finished)))
                if has_failed:
                    self._end_pool(kill=True)  # after it each future is lost or has its result
                for future in [one for one in waiting if one.done() and not _is_lost(one)]:
                    yield waiting.pop(future), future.result() if client is None else _cluster_result(future)
                if has_failed:
                    return list(waiting.values())
        except (KeyboardInterrupt, GeneratorExit):
            self._end_pool(kill=True)
            raise

    def _way_to_submit(self, most: int) -> Callable[[Callable[[Task], Result], Task], Future[Result]]:
        """The function that hands a task to the cluster, or to the pool, which is started with `most` processes."""
        if self._client is not None:
            return partial(_submit_to_cluster, self._client)
        return partial(_submit, self._start_pool(most))

    def _start_pool(self, jobs: int) -> ProcessPoolExecutor:
        """Pool of processes: the present one, else a new one of `jobs` processes with one thread each."""
        if self._pool is None:
            for name in THREAD_LIMITS:  # inherited when the processes load NumPy: the other cores do other tasks
                os.environ.setdefault(name, "1")
            rules = os.environ.get("PYTHONWARNINGS", "")
            if NO_TRACKER_WARNINGS not in rules:
                os.environ["PYTHONWARNINGS"] = f"{rules},{NO_TRACKER_WARNINGS}".strip(",")
            self._others = active_children()
            # New processes: a fork would copy the thread of the progress bar.
            self._pool = ProcessPoolExecutor(
                jobs, get_context("spawn"), _begin_process, (logging.getLogger("startrack").level,)
            )
        return self._pool

    def _end_pool(self, *, kill: bool = False) -> None:
        """End the processes of a pool: at once with `kill`, otherwise after the tasks in progress or CLOSE_S."""
        pool, self._pool = self._pool, None
        if pool is None:
            return
        processes = [process for process in active_children() if process not in self._others]
        limit = threading.Timer(0.0 if kill else CLOSE_S, _kill, [processes])
        limit.start()
        try:
            pool.shutdown(cancel_futures=not kill)
        finally:  # also by a Ctrl-C meanwhile
            limit.cancel()
            _kill(processes)


def _kill(processes: Iterable[BaseProcess]) -> None:
    for process in processes:
        process.kill()


def _connect(cluster: str) -> Client:
    """A client of the Dask scheduler at the address `cluster`. Raises BadInput (no_cluster) if none answers."""
    from distributed import Client

    logging.getLogger(LOG_OF_CLIENT).setLevel(logging.CRITICAL)  # a lost scheduler is reported by RunStopped
    try:
        return Client(cluster, timeout=CONNECT_S)
    except (OSError, ValueError) as cause:
        raise BadInput("no_cluster", f"{cluster}: no Dask scheduler answers ({cause})") from cause


def _submit(pool: ProcessPoolExecutor, work: Callable[[Task], Result], task: Task) -> Future[Result]:
    """Future of the result of `work` on `task`; in a broken pool a future with BrokenProcessPool.

    SIGINT and SIGTERM are blocked meanwhile: a process that starts in here never gets them, this one gets them after.
    """
    has_mask = hasattr(signal, "pthread_sigmask")  # not on Windows
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS) if has_mask else ()
    try:
        return pool.submit(work, task)
    except BrokenProcessPool as cause:
        broken: Future[Result] = Future()
        broken.set_exception(cause)
        return broken
    finally:
        if has_mask:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _submit_to_cluster(client: Client, work: Callable[[Task], Result], task: Task) -> Future[Result]:
    """Future of the result of `work` on `task`, or of the exception of the work, its transfer or a lost connection."""
    import asyncio

    from distributed import Future as FarFuture

    async def fetched(far: FarFuture[Result]) -> Result:
        return await far

    # Not by the executor of the client: a future of it stays without an end when the transfer of its result fails.
    far = client.submit(work, task, pure=False)
    return asyncio.run_coroutine_threadsafe(fetched(far), cast("BaseAsyncIOLoop", client.loop).asyncio_loop)


def _begin_process(log_level: int) -> None:
    """Begin a new process: its logs are as quiet as the parent's, and it ends with the parent alone."""
    logging.getLogger("startrack").setLevel(log_level)
    for number in SIGNALS:  # sent to the whole process group: the tasks in progress are finished
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this process when its parent has ended, also by kill -9: a resumed run must not find it at work."""
    parent = parent_process()
    if parent is not None:
        parent.join()
    os._exit(1)


def _is_lost(future: Future[Any]) -> bool:
    """Whether the finished future has no result because a process of its pool died."""
    return not future.cancelled() and isinstance(future.exception(), BrokenProcessPool)


def _check_connection(client: Client, finished: Collection[Future[Any]]) -> None:
    """Raise RunStopped if the scheduler has gone; not beside `finished` futures, which have results or the cause."""
    if not finished and client.status != "running":
        raise RunStopped(f"the Dask scheduler has gone (the client is {client.status})")


def _cluster_result(future: Future[Any]) -> Any:
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
