"""The processes of a batch: each says which task it is at, ignores signals, and ends with its parent."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from ctypes import c_longlong
from multiprocessing import active_children, get_context, parent_process
from multiprocessing.connection import wait
from typing import Any, TypeVar

ONE_THREAD = "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"
QUIET_TRACKER = "ignore:resource_tracker"  # after kill -9 Python tidies up, and would warn that it had to
NOTHING = -1  # in place of the number of the task that a process is at
Given = TypeVar("Given")
Found = TypeVar("Found")


def pool_of(jobs: int) -> tuple[ProcessPoolExecutor, Any]:
    """Processes that leave signals to the one that waits for them, and an array of the task that each of them is at.

    Fresh ones: a fork would copy the progress bar's thread.
    """
    for name in ONE_THREAD:  # inherited when they load NumPy: the cores are taken by other images
        os.environ.setdefault(name, "1")
    rules = os.environ.get("PYTHONWARNINGS", "")
    if QUIET_TRACKER not in rules:
        os.environ["PYTHONWARNINGS"] = f"{rules},{QUIET_TRACKER}".strip(",")
    context = get_context("spawn")
    at, taken = context.RawArray(c_longlong, [NOTHING] * jobs), context.Value(c_longlong)
    return ProcessPoolExecutor(jobs, mp_context=context, initializer=Process.begin, initargs=(at, taken)), at


def kill_children() -> None:
    """End this process's children at once: results are whole or not there, so that nothing is spoilt."""
    for process in active_children():
        process.kill()


class Process:
    """What a process of the pool knows of itself: where it says which task it is at, for whoever finds it dead."""

    at: Any
    place: int

    @classmethod
    def begin(cls, at: Any, taken: Any) -> None:
        """The first thing in a new process: the array of all, and how many places in it are taken."""
        for number in (signal.SIGINT, signal.SIGTERM):  # sent to the whole group: the images in hand are finished
            signal.signal(number, signal.SIG_IGN)
        threading.Thread(target=_end_with_parent, daemon=True).start()
        with taken:
            cls.at, cls.place = at, taken.value
            taken.value += 1
        import cv2

        cv2.setNumThreads(1)

    @classmethod
    def do(cls, work: Callable[[Given], Found], number: int, task: Given) -> Found:
        """`work` on a task; its `number` stands in the array until it is done, and after if the process dies of it."""
        cls.at[cls.place] = number
        try:
            return work(task)
        finally:
            cls.at[cls.place] = NOTHING


def _end_with_parent() -> None:
    """End this process when its parent is gone: killed, it cannot tell, and a resumed run must find nobody at work."""
    parent = parent_process()
    if parent is not None:
        wait([parent.sentinel])
    os._exit(1)
