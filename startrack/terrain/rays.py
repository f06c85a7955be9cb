"""Rays as the kernels take them, one by one or all azimuths of a point in a row; and kernels on all cores."""

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


def flatten_rays(points_m: Array, azimuths_rad: Array) -> tuple[tuple[int, ...], Array, Array]:
    """The shape of points (..., 2) broadcast with azimuths (...), and its n points (n, 2) and azimuths (n,)."""
    shape = np.broadcast_shapes(np.shape(points_m)[:-1], np.shape(azimuths_rad))
    return shape, flatten(points_m, (*shape, 2)).reshape(-1, 2), flatten(azimuths_rad, shape).ravel()


def rows_of_rays(points_m: Array, azimuths_rad: Array) -> tuple[tuple[int, ...], Array, Array]:
    """The same shape, and its points (n, 2) and azimuths: (1, m) those of all points, else (n, 1)."""
    if np.ndim(points_m) > 1 and np.shape(points_m)[-2] == 1 and np.ndim(azimuths_rad) == 1:
        shape = (*np.shape(points_m)[:-2], len(azimuths_rad))
        return shape, flatten(points_m, np.shape(points_m)).reshape(-1, 2), np.array(azimuths_rad, np.float64)[None]
    shape, points, azimuths = flatten_rays(points_m, azimuths_rad)
    return shape, points, azimuths[:, None]


def flatten(a: Any, shape: tuple[int, ...]) -> Array:
    """The values of `a`, broadcast to the shape, in one contiguous array of their own: kernels have one layout."""
    return np.array(np.broadcast_to(np.asarray(a, dtype=np.float64), shape), order="C")


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
