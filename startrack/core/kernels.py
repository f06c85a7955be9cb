"""numba's compiler for the package's kernels, once its cache has a folder and holds no kernels of other sources."""

from __future__ import annotations

from startrack.core.compilation import choose_cache_folder, discard_stale_kernels

choose_cache_folder()
discard_stale_kernels()

from numba import njit  # noqa: E402 - numba reads where its cache lies when it loads

REORDERED_SUMS = {"reassoc", "contract", "nsz"}  # as `fastmath`: lets the compiler sum several pixels at a time

__all__ = ["REORDERED_SUMS", "njit"]
