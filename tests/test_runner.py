"""Tasks in processes and on Dask: some kill or block their process, and the others are still done."""

from __future__ import annotations

import json
import logging
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import active_children

import pytest
from batch_helpers import task_of

from startrack.applications.batch import locate_images
from startrack.core.runner import Died, Runner, RunStopped

JOBS = 2


def work(name: str) -> tuple[str, int]:
    """A short task; by its name the process is killed, or blocked for ever."""
    time.sleep(0.02)
    if "deadly" in name:
        os._exit(9)
    if "stopping" in name:
        os.kill(os.getpid(), signal.SIGSTOP)
    if "failing" in name:
        raise RunStopped("the disk is full")
    return name, os.getpid()


@contextmanager
def limit_of_s(limit_s: float) -> Iterator[None]:
    """TimeoutError in the block after `limit_s` seconds: a test of what may hang fails instead."""

    def end(*_: object) -> None:
        raise TimeoutError(f"not finished in {limit_s} s")

    before = signal.signal(signal.SIGALRM, end)
    signal.setitimer(signal.ITIMER_REAL, limit_s)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def outcomes(runner: Runner[str, tuple[str, int]], names: list[str]) -> dict[str, tuple[str, int] | Died]:
    with runner:
        done = list(runner.results(names))
    assert sorted(name for name, _ in done) == sorted(names)
    return dict(done)


@pytest.mark.slow
def test_a_task_that_kills_its_process_costs_the_others_nothing():
    names = [f"{number:02d}" for number in range(60)]
    names[5], names[40] = "05-deadly", "40-deadly"
    done = outcomes(Runner(work, jobs=JOBS), names)
    assert [name for name in names if isinstance(done[name], Died)] == ["05-deadly", "40-deadly"]
    # Tasks in progress at a death are done one at a time, by one process until it dies and by one after it; then the
    # processes work in parallel again.
    processes = {outcome[1] for outcome in done.values() if not isinstance(outcome, Died)}
    assert len(processes) <= 3 * JOBS + 2 * 2


def noted_work(task: tuple[str, str]) -> None:
    """As `work`, after a line in the file that the task names."""
    file, name = task
    with open(file, "a", encoding="ascii") as notes:
        notes.write(f"{name}\n")
    work(name)


def test_few_tasks_are_repeated_after_a_death(tmp_path):
    """Those that were handed out, one after the other."""
    names = [f"{number:02d}" for number in range(12)]
    names[3] = "03-deadly"
    notes = str(tmp_path / "notes")
    with Runner(noted_work, jobs=JOBS) as runner:
        done = {name: outcome for (_, name), outcome in runner.results([(notes, name) for name in names])}
    assert [name for name in names if isinstance(done[name], Died)] == ["03-deadly"]
    started = (tmp_path / "notes").read_text().splitlines()
    assert started.count("03-deadly") == 2
    assert len(started) <= len(names) + JOBS


@pytest.mark.slow
def test_a_stopped_process_does_not_block_the_end():
    done = outcomes(Runner(work, jobs=JOBS, limit_s=10.0), ["0", "1-stopping", "2", "3"])
    assert [name for name, outcome in done.items() if isinstance(outcome, Died)] == ["1-stopping"]


def test_an_exception_of_the_work_reaches_the_caller():
    with Runner(work, jobs=JOBS) as runner, pytest.raises(RunStopped, match="the disk is full"):
        list(runner.results(["0", "1-failing", "2"]))


def test_the_end_does_not_wait_for_a_blocked_process(monkeypatch):
    monkeypatch.setattr("startrack.core.runner.CLOSE_S", 0.5)
    with limit_of_s(60), Runner(work, jobs=JOBS) as runner, pytest.raises(RunStopped, match="the disk is full"):
        list(runner.results(["0-stopping", "1-failing"]))
    assert not active_children()


def test_an_interrupted_end_leaves_no_process(monkeypatch):
    """A Ctrl-C while it waits for a blocked process."""
    monkeypatch.setattr("startrack.core.runner.CLOSE_S", 60.0)
    ctrl_c = threading.Timer(1.0, os.kill, [os.getpid(), signal.SIGINT])
    with limit_of_s(30), pytest.raises(KeyboardInterrupt), Runner(work, jobs=JOBS) as runner:
        stop_beside_a_blocked_process(runner, ctrl_c.start)
    deadline_s = time.monotonic() + 10.0
    while active_children() and time.monotonic() < deadline_s:
        time.sleep(0.05)
    assert not active_children()


def stop_beside_a_blocked_process(runner: Runner[str, tuple[str, int]], then: Callable[[], None]) -> None:
    with pytest.raises(RunStopped):
        list(runner.results(["0-stopping", "1-failing"]))
    then()


def test_after_a_stop_only_the_tasks_in_progress_are_finished():
    with Runner(work, jobs=JOBS) as runner:
        results = runner.results([str(number) for number in range(20)])
        next(results)
        runner.stop()
        assert len(list(results)) == JOBS - 1


def test_a_killed_run_leaves_no_warnings_of_semaphores():
    code = """
        import os, signal
        from startrack.core.runner import Runner
        if __name__ == "__main__":
            with Runner(abs, jobs=2) as runner:
                results = runner.results(range(8))
                next(results)
                os.kill(os.getpid(), signal.SIGKILL)
    """
    process = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, timeout=120,
        env={name: value for name, value in os.environ.items() if name != "PYTHONWARNINGS"},
    )  # fmt: skip
    assert (process.returncode, process.stderr) == (-signal.SIGKILL, "")


def test_processes_are_kept_between_calls():
    with Runner(work, jobs=1) as runner:
        (first,), (second,) = ([outcome for _, outcome in runner.results([name])] for name in "ab")
    assert first[1] == second[1] != os.getpid()
    assert next(Runner(work, in_process=True).results(["a"]))[1] == ("a", os.getpid())


def test_a_signal_while_processes_start_neither_hangs_nor_kills_them():
    """Sent to the process group while its processes start, as a terminal sends Ctrl-C."""
    code = """
        import os, signal, sys, threading
        from startrack.core.runner import Runner
        if __name__ == "__main__":
            seen = []
            signal.signal(signal.SIGINT, lambda *_: seen.append(1))
            for delay_s in (0.02, 0.1, 0.3):
                threading.Timer(delay_s, lambda: os.killpg(0, signal.SIGINT)).start()
            with Runner(abs, jobs=2) as runner:
                done = sorted(outcome for _, outcome in runner.results(range(8)))
            print(done, 1 <= len(seen) <= 3)  # signals that come while they are blocked arrive as one
    """
    process = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, start_new_session=True,
        timeout=120,
    )  # fmt: skip
    assert process.stdout == f"{list(range(8))} True\n", process.stderr


@pytest.mark.slow
def test_an_image_that_kills_dask_workers_is_given_up_and_the_others_are_done(tmp_path):
    distributed = pytest.importorskip("distributed")
    dask = pytest.importorskip("dask")
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 1}),
        distributed.LocalCluster(1, processes=True, threads_per_worker=1, dashboard_address=None) as cluster,
    ):
        done = outcomes(Runner(work, cluster=cluster.scheduler_address), ["00", "01-deadly", "02", "03"])
    died = [outcome for outcome in done.values() if isinstance(outcome, Died)]
    assert done["01-deadly"] in died and "workers that worked on it died" in died[0].cause


def test_a_task_that_died_is_an_internal_error_of_its_image(tmp_path):
    class Dying(Runner):
        def results(self, tasks):
            yield from ((task, Died("gone")) for task in tasks)

    task = task_of(tmp_path / "05.png", tmp_path / "out")
    ((record, kept),) = locate_images(Dying(work), [task])
    assert (record["reason"], record["message"], kept) == ("internal_error", "internal error: gone", False)
    assert json.loads((tmp_path / "out" / "05.fix.json").read_text())["reason"] == "internal_error"


def test_a_scheduler_that_goes_stops_the_run():
    """For the client it ends after the first outcome."""
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(1, processes=True, threads_per_worker=1, dashboard_address=None) as cluster,
        Runner(work, cluster=cluster.scheduler_address) as runner,
    ):
        results = runner.results([str(number) for number in range(200)])
        next(results)
        cluster.close()
        with pytest.raises(RunStopped, match=r"the Dask scheduler has gone [^\n]*$"):
            list(results)
    assert not logging.getLogger("distributed.client").isEnabledFor(logging.ERROR)  # it would add tracebacks


class Unreadable:
    """A result that a worker sends and that its receiver cannot read."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return fail_to_read, ("no such result",)


def fail_to_read(why: str) -> None:
    raise OSError(why)


def unreadable(_: str) -> Unreadable:
    return Unreadable()


def test_a_result_that_cannot_be_fetched_stops_the_run():
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(1, processes=True, threads_per_worker=1, dashboard_address=None) as cluster,
        Runner(unreadable, cluster=cluster.scheduler_address) as runner,
        limit_of_s(60),
        pytest.raises(RunStopped),
    ):
        list(runner.results(["0", "1"]))


RELEASE = threading.Event()


def wait_for_release(_: str) -> bool:
    return RELEASE.wait(60.0)


def test_a_lost_connection_stops_a_run_without_any_result(monkeypatch):
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr("startrack.core.runner.CONNECT_S", 0.5)
    with (
        distributed.LocalCluster(1, processes=False, threads_per_worker=1, dashboard_address=None) as cluster,
        Runner(wait_for_release, cluster=cluster.scheduler_address) as runner,
        limit_of_s(30),
    ):
        distributed.default_client().status = "connecting"
        with pytest.raises(RunStopped, match="the Dask scheduler has gone"):
            list(runner.results(["0"]))
        RELEASE.set()
