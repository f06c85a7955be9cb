"""Kernels over many rays or boxes, on all cores."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np

from startrack.core.runner import count_cores
from startrack.core.types import Array

MIN_RAYS_FOR_THREADS = 1500  # fewer take less time than starting threads
MAX_THREADS = 8


def run_in_threads(function: Any, fixed: tuple[Any, ...], arrays: tuple[Array, ...]) -> None:
    """Call the function with the fixed arguments and parts of the arrays, on all cores where rays are many."""
    n, cores = len(arrays[-1]), min(count_cores(), MAX_THREADS)
    if arrays[-1].size < MIN_RAYS_FOR_THREADS or cores == 1:
        function(*fixed, *arrays)
        return
    ends = np.linspace(0, n, cores + 1).astype(int)
    own, *others = [[a[i:j] for a in arrays] for i, j in pairwise(ends)]
    running = [_thread_pool().submit(function, *fixed, *part) for part in others]
    function(*fixed, *own)
    for future in running:
        future.result()


@cache
def _thread_pool() -> ThreadPoolExecutor:
    """Threads beside the calling one, kept: each start takes as long as a thousand rays."""
    return ThreadPoolExecutor(MAX_THREADS)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_thread_pool.cache_clear)  # threads are not copied
